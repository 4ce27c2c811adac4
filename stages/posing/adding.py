"""Photos that came or went after a model was made: what is known of the others is kept.

Photos are known by their contents, whatever they are called now. Of each known photo the features, the matches with
other known photos and the pose are taken over; new photos are matched and placed beside them.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stages.artifacts import Lens
from stages.geometry.similarity import Similarity, align_points
from stages.posing.joining import view_distance

if TYPE_CHECKING:
    from jaxtyping import Float

log = logging.getLogger(__name__)

MIN_PLACED = 3  # known photos with a pose: fewer fix no frame
MIN_SHARE = 0.5  # of the photos of now that must be placed already, or poses are found anew from all
# Known photos that moved by more than this in the median, in distances from a camera to what it sees, are not where
# they were: neither is the region, nor what was learned in it. A bundle adjustment with seven more photos moves 40 by
# 0.0002.
STAYED = 0.003


@dataclass(frozen=True)
class KnownPhotos:
    """An earlier model, and which of its photos are those of now.

    Attributes:
        names: photo now -> the same photo's name then, placed or not.
        new: photos that were not there. gone: names then of photos that no longer are.
        model: pycolmap reconstruction of then; it stays as it is.
        features: the database it was found on.
        lenses: of its cameras, in the order of `camera_ids`; none where nothing was tried on them.
    """

    names: Mapping[str, str]
    new: tuple[str, ...]
    gone: tuple[str, ...]
    model: Any
    features: Path
    lenses: tuple[Lens, ...] = ()

    @cached_property
    def poses(self) -> dict[str, Any]:
        """Photo now -> its image in the earlier model, where it has a pose."""
        images = (self.model.images[i] for i in self.model.reg_image_ids())
        then = {image.name: image for image in images}
        return {now: then[name] for now, name in self.names.items() if name in then}

    @property
    def changed(self) -> bool:
        """Whether photos came or went; else some have other names at most."""
        return bool(self.new or self.gone)

    @property
    def enough(self) -> bool:
        """Whether so many of the photos have a pose that the others are placed beside them."""
        return enough_placed(len(self.poses), len(self.names) + len(self.new))

    def describe(self) -> str:
        """For people: "40 photos known (2 by another name), 7 new, 2 gone"."""
        renamed = sum(now != then for now, then in self.names.items())
        other = f" ({renamed} by another name)" if renamed else ""
        return f"{len(self.names)} photos known{other}, {len(self.new)} new, {len(self.gone)} gone"


def enough_placed(placed: int, total: int) -> bool:
    """Whether so many known photos of all have a pose that the others are placed beside them."""
    return placed >= MIN_PLACED and placed > MIN_SHARE * total


# ---------------------------------------------------------------- features and matches
def copy_features(before: Path, database: Path, names: Mapping[str, str]) -> None:
    """Features, matches and their verification of known photos (name now -> name then) from one database to another.

    Photos that have features there already are left as they are.
    """
    import pycolmap

    with pycolmap.Database.open(before) as old, pycolmap.Database.open(database) as new:
        then = {image.name: image.image_id for image in old.read_all_images()}
        now = {image.name: image.image_id for image in new.read_all_images()}
        new_id = {then[was]: now[name] for name, was in names.items() if was in then and name in now}
        with pycolmap.DatabaseTransaction(new):
            copy_keypoints(old, new, new_id)
            for i, j in old_pairs(old, set(new_id)):
                pair = new_id[i], new_id[j]
                if not new.exists_matches(*pair):
                    new.write_matches(*pair, old.read_matches(i, j))
                    new.write_two_view_geometry(*pair, old.read_two_view_geometry(i, j))


def copy_keypoints(old: Any, new: Any, new_id: Mapping[int, int]) -> None:
    """Features of images (id in `new` by id in `old`, both open) that have none in the new database."""
    for i, j in new_id.items():
        if not new.exists_keypoints(j):
            new.write_keypoints(j, old.read_keypoints(i))
            new.write_descriptors(j, old.read_descriptors(i))


def old_pairs(database: Any, images: set[int]) -> list[tuple[int, int]]:
    """Pairs of these images that were matched and verified, those without a match among them."""
    ids = sorted(images)
    return [
        (i, j)
        for k, i in enumerate(ids)
        for j in ids[k + 1 :]
        if database.exists_matches(i, j) and database.exists_two_view_geometry(i, j)
    ]


# ---------------------------------------------------------------- the model
def renamed_model(known: KnownPhotos) -> Any:
    """The earlier model with the names of now, where no photo came or went."""
    import pycolmap

    model, now = pycolmap.Reconstruction(known.model), {then: name for name, then in known.names.items()}
    for image_id in model.reg_image_ids():
        model.images[image_id].name = now[model.images[image_id].name]
    return model


def known_model(known: KnownPhotos, database: Path, min_num_matches: int) -> Any:
    """The known photos of a database with their poses and points; the others without a pose."""
    import pycolmap

    options = pycolmap.DatabaseCacheOptions()
    options.min_num_matches = min_num_matches
    with pycolmap.Database.open(database) as opened:
        cache = pycolmap.DatabaseCache.create(opened, options)
    model = pycolmap.Reconstruction()
    model.load(cache)
    for camera_id, then in cameras_then(known, model).items():
        earlier, camera = known.model.cameras[then], model.cameras[camera_id]
        camera.model = earlier.model
        camera.params = list(earlier.params)
    new_id = {}
    for image in sorted(model.images.values(), key=lambda image: image.image_id):
        if image.name in known.poses:
            earlier = known.poses[image.name]
            frame = model.frames[image.frame_id]
            if not frame.has_pose():
                frame.set_cam_from_world(image.camera_id, earlier.cam_from_world())
                model.register_frame(image.frame_id)
            new_id[earlier.image_id] = image.image_id
    for _, point in sorted(known.model.points3D.items()):
        elements = [
            pycolmap.TrackElement(new_id[element.image_id], element.point2D_idx)
            for element in point.track.elements
            if element.image_id in new_id
        ]
        if len(elements) >= 2:
            model.add_point3D(point.xyz, pycolmap.Track(elements), point.color)
    return model


def cameras_then(known: KnownPhotos, model: Any) -> dict[int, int]:
    """Camera of a model of now -> the camera of the earlier model that took most of its known photos."""
    votes: dict[int, Counter[int]] = {}
    for image in model.images.values():
        if image.name in known.poses:
            votes.setdefault(image.camera_id, Counter())[known.poses[image.name].camera_id] += 1
    return {camera_id: max(sorted(of), key=of.__getitem__) for camera_id, of in sorted(votes.items())}


def camera_ids(model: Any) -> list[int]:
    """Of a model's photos, in the order of the photos' ids: the order in which lenses are described."""
    return list(dict.fromkeys(model.images[i].camera_id for i in sorted(model.reg_image_ids())))


def known_lenses(known: KnownPhotos, model: Any) -> dict[int, Lens]:
    """Camera of a model of now -> what was found of its lens."""
    if not known.lenses:
        return {}
    of_then = dict(zip(camera_ids(known.model), known.lenses, strict=True))
    return {now: of_then[then] for now, then in cameras_then(known, model).items()}


# ---------------------------------------------------------------- whether poses stayed
def put_back(known: KnownPhotos, model: Any) -> float | None:
    """Move a model so that known photos are where they were, as well as a similarity can.

    Returns:
        How far their centres are from there in the median, in distances from a camera to what it sees. None, and the
        model is as it was, where fewer than `MIN_PLACED` photos are in both or they stand in a line.
    """
    import pycolmap

    now, then = common_centers(known, model)
    if len(now) < MIN_PLACED:
        return None
    try:
        then_from_now: Similarity = align_points(now, then)
    except ValueError:
        return None
    rotation = pycolmap.Rotation3d(then_from_now.rotation)
    model.transform(pycolmap.Sim3d(then_from_now.scale, rotation, then_from_now.translation))
    return float(np.median(np.linalg.norm(then_from_now.apply(now) - then, axis=1))) / view_distance(known.model)


def common_centers(known: KnownPhotos, model: Any) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"]]:
    """Centres of the known photos that a model has a pose of: in it, and in the earlier one."""
    images = (model.images[i] for i in sorted(model.reg_image_ids()))
    common = [image for image in images if image.name in known.poses]
    now = [image.projection_center() for image in common]
    then = [known.poses[image.name].projection_center() for image in common]
    return np.array(now).reshape(-1, 3), np.array(then).reshape(-1, 3)
