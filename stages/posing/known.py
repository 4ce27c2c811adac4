"""Camera poses that are known already: what every reader gives, and which photo belongs to which camera.

Cameras are COLMAP's: OpenCV axes (x right, y down, z forward), pixel centres at .5, a camera model by name.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath

import numpy as np

from stages.artifacts import KnownSphere
from stages.errors import HineusError, InputError
from stages.geometry.place import Place
from stages.inputs.bounded import reason
from stages.inputs.folders import readable, short_name
from stages.inputs.formats import open_image

# An image's suffix; "frame.0001" has none.
SUFFIX = re.compile(r"\.[A-Za-z]{3,5}$")
SEPARATORS = re.compile(r"[/\\]")
# Width and height may be scaled by factors that differ by this much: both were rounded.
MAX_STRETCH = 0.01
# A rotation written with a few digits only is taken for the nearest true one, within this.
ROTATION_TOLERANCE = 1e-2
# Cameras beyond these are no photos' (units: pixels; those of the poses; the longer side of the image).
MAX_SIDE, MAX_AWAY, MAX_PARAMETER = 100_000, 1e12, 1e4
LONGEST_NAME = 4096  # characters, as paths may have


@dataclass(frozen=True)
class KnownCamera:
    """One image's camera.

    Attributes:
        name: the image as the poses' file names it, a posix path; its suffix may be missing.
        size: width and height in pixels of the image that the parameters are for.
        model: COLMAP's name of the camera model.
        params: of that model, pixels.
        cam_from_world: [3, 4] rotation and translation.
    """

    name: str
    size: tuple[int, int]
    model: str
    params: tuple[float, ...]
    cam_from_world: np.ndarray


@dataclass(frozen=True)
class KnownPoses:
    """What a file of poses says.

    Attributes:
        origin: the file or folder.
        cameras: in the file's order; names are unique, and the numbers are those of cameras that can be.
        region: where the object is, if the file says so.
        masks: camera's name -> file of its mask, of formats that come with masks.
        place: where they lie in the world, where they are a part of one of our workspaces. Then `origin` is a COLMAP
            model whose points are theirs.
    """

    origin: Path
    cameras: tuple[KnownCamera, ...]
    region: KnownSphere | None = None
    masks: Mapping[str, Path] = field(default_factory=dict)
    place: Place | None = None

    def __post_init__(self) -> None:
        seen: set[str] = set()
        for camera in self.cameras:
            _check_camera(camera, self.origin)
            if camera.name in seen:
                raise InputError(f"{self.origin} has two poses for {camera.name}.", "Remove one of them.")
            seen.add(camera.name)
        if not self.cameras:
            raise InputError(f"{self.origin} has no poses.", "Name another file with `--poses`.")
        if self.region is not None and not (
            np.isfinite(self.region.center).all()
            and 0 < self.region.radius <= MAX_AWAY >= np.abs(self.region.center).max()
        ):
            raise InputError(f"{self.region.source} in {self.origin} is no sphere.", "Mend or remove it.")

    def names_of(self, photos: Iterable[str]) -> dict[str, str]:
        """Name of the camera of each photo that has one; raises as `match_photos`."""
        return {photo: camera.name for photo, camera in match_photos(self, photos).items()}

    def masks_of(self, cameras: Mapping[str, KnownCamera]) -> dict[str, Path]:
        """Mask of each photo whose camera has one; `cameras`: photo -> its camera."""
        return {photo: self.masks[camera.name] for photo, camera in cameras.items() if camera.name in self.masks}


# ---------------------------------------------------------------- photos and cameras
def match_photos(poses: KnownPoses, photos: Iterable[str]) -> dict[str, KnownCamera]:
    """The camera of each photo that has one.

    Names agree when their last part does, suffix aside, however their letters are encoded; where several do, the one
    with more of the path in common is meant, then the one with the same suffix.

    Args:
        photos: relative posix paths.

    Raises:
        InputError: there are no photos, none has a camera, or two photos fit one camera equally well.
    """
    photos = list(photos)
    by_stem: dict[str, list[str]] = {}
    for photo in photos:
        by_stem.setdefault(stem(photo), []).append(photo)
    cameras_of: dict[str, list[tuple[tuple[int, bool], KnownCamera]]] = {}
    for camera in poses.cameras:
        best, fitting = best_fits(camera.name, by_stem.get(stem(camera.name), []))
        if not fitting:
            continue
        if len(fitting) > 1:
            raise InputError(
                f"The pose of {camera.name} in {poses.origin} fits {len(fitting)} photos: {fitting[0]}, {fitting[1]}.",
                "Name the folder that only holds the photos.",
            )
        cameras_of.setdefault(fitting[0], []).append((best, camera))
    matched = {}
    for photo in photos:
        if photo in cameras_of:
            matched[photo] = max(cameras_of[photo], key=lambda scored: scored[0])[1]
    if not photos:
        raise InputError(
            f"There are no photos that the {len(poses.cameras)} poses in {poses.origin} could be of.",
            f"Name the folder that holds {poses.cameras[0].name} and the others.",
        )
    if not matched:
        raise InputError(
            f"None of the {len(photos)} photos has a pose in {poses.origin}: it names {len(poses.cameras)} images, "
            f"e.g. {poses.cameras[0].name}, photos are called e.g. {photos[0]}.",
            "Name the folder of the photos these poses belong to: `hineus run PHOTOS --poses FILE`.",
        )
    return matched


def best_fits(name: str, photos: Iterable[str]) -> tuple[tuple[int, bool], list[str]]:
    """How well photos fit a name that another program gave one, and those that fit it best: one where all is well.

    Args:
        photos: relative posix paths, of which only those count whose last part agrees, suffix aside.
    """
    scored = [(_likeness(name, photo), photo) for photo in photos]
    best = max((score for score, _ in scored), default=(0, False))
    return best, [photo for score, photo in scored if score == best and score[0] > 0]


def stem(name: str) -> str:
    """The last part of a posix path, suffix aside; "frame.0001" has none, and "/" has no part."""
    return next(reversed(_parts(name)), "")


def _parts(name: str) -> tuple[str, ...]:
    """Of a path with "/", or with "\\" as Windows has it; photos' names with that in them are cut alike.

    Blanks around a name are lost in texts, long names are those of our own exports.
    """
    parts = SEPARATORS.split(SUFFIX.sub("", short_name(readable(name))))
    return tuple(part.strip() for part in parts if part not in ("", "."))


def _likeness(first: str, second: str) -> tuple[int, bool]:
    """How many parts of two paths agree, from the end; whether the suffixes do."""
    common = 0
    for one, other in zip(reversed(_parts(first)), reversed(_parts(second)), strict=False):
        if one != other:
            break
        common += 1
    return common, PurePosixPath(first).suffix.lower() == PurePosixPath(second).suffix.lower()


def check_masks(masks: Mapping[str, Path], origin: Path) -> None:
    """
    Raises:
        InputError: a mask that the poses' file `origin` names is not there.
    """
    missing = sorted(str(file) for file in masks.values() if not file.is_file())
    if missing:
        raise InputError(
            f"{len(missing)} of {len(masks)} masks that {origin} names are not there, e.g. {missing[0]}.",
            "Put them there, name another folder with `--masks FOLDER`, or run without: `--no-masks`.",
        )


# ---------------------------------------------------------------- what readers share
@contextmanager
def reading(what: str, needs: str) -> Iterator[None]:
    """Whatever goes wrong within means that `what` cannot be read: damaged pickles and models raise nearly anything.

    Raises:
        InputError: with what the file `needs`.
    """
    try:
        with np.errstate(all="ignore"):  # numbers that overflow are refused by what comes of them
            yield
    except HineusError:
        raise
    except Exception as error:
        raise InputError(f"{what} cannot be read ({reason(error)}).", f"It needs {needs}.") from error


def pinhole(name: str, image: Path, intrinsics: np.ndarray, cam_from_world: np.ndarray, origin: Path) -> KnownCamera:
    """A camera without distortion or skew, of an `image` on the disk.

    Args:
        intrinsics: [3, 3] pixels.
        cam_from_world: [3, 4], its rotation perhaps rounded.
        origin: the file that says so.

    Raises:
        InputError: the image cannot be read, or the pose has no rotation.
    """
    params = tuple(float(intrinsics[at]) for at in ((0, 0), (1, 1), (0, 2), (1, 2)))
    rotation = nearest_rotation(cam_from_world[:, :3], name, origin)
    pose = np.concatenate([rotation, cam_from_world[:, 3:]], 1)
    return KnownCamera(name, image_size(image, origin), "PINHOLE", params, pose)


def nearest_rotation(matrix: np.ndarray, name: str, origin: Path) -> np.ndarray:
    """The rotation [3, 3] that a nearly orthonormal `matrix` [3, 3] stands for.

    Raises:
        InputError: it is none: mirrored, scaled or skewed.
    """
    if not np.isfinite(matrix).all():
        raise InputError(f"The pose of {name} in {origin} has numbers that are not finite.", "Mend the poses.")
    left, _, right = np.linalg.svd(matrix)
    rotation = left @ right
    if not np.allclose(rotation, matrix, atol=ROTATION_TOLERANCE) or np.linalg.det(rotation) < 0:
        raise InputError(
            f"The pose of {name} in {origin} has no rotation: its 3 x 3 part is off by "
            f"{np.abs(rotation - matrix).max():.3g} (determinant {np.linalg.det(matrix):.3g}, need 1).",
            "Poses must be rigid: no scale, no mirroring.",
        )
    return rotation


def image_size(file: Path, origin: Path) -> tuple[int, int]:
    """Width and height in pixels of an image that the poses name.

    Raises:
        InputError: it cannot be read.
    """
    try:
        if not file.is_file():  # pipes and devices are waited for
            raise FileNotFoundError(file)
        with open_image(file) as image:
            width, height = image.size
    except Exception as error:  # Pillow raises nearly anything on a damaged file
        raise InputError(
            f"{origin} does not say how large its images are, and {file} cannot be read.",
            "Keep the file of poses beside its images.",
        ) from error
    return width, height


def _check_camera(camera: KnownCamera, origin: Path) -> None:
    """
    Raises:
        InputError: it has no name, or numbers that no camera has.
    """
    import pycolmap

    name, size, model, pose = camera.name, camera.size, camera.model, camera.cam_from_world
    if len(name) > LONGEST_NAME or "\0" in name or not _parts(name):
        raise InputError(f"An image in {origin} is called {name[:40]!r}.", "Name the photos as their files are called.")
    if not all(1 <= side <= MAX_SIDE for side in size):
        raise InputError(
            f"The image {name} in {origin} is {size[0]} x {size[1]} pixels, each must be from 1 to {MAX_SIDE}.",
            "Mend the poses.",
        )
    known = model in pycolmap.CameraModelId.__members__ and model != "INVALID"
    lens = pycolmap.Camera(model=model, width=size[0], height=size[1], params=list(camera.params)) if known else None
    if lens is None or not lens.verify_params() or not lens.focal_length_idxs():
        raise InputError(
            f"The camera of {name} in {origin} is of model {model[:40]} with {len(camera.params)} parameters.",
            "Mend the poses: COLMAP's perspective and fisheye models are known.",
        )
    most = MAX_PARAMETER * max(size)
    focal = [camera.params[i] for i in lens.focal_length_idxs()]
    if not all(abs(value) <= most for value in camera.params) or min(focal) * most <= 1:
        params = ", ".join(f"{value:.6g}" for value in camera.params)
        raise InputError(f"The camera of {name} in {origin} cannot be: {model} with {params}.", "Mend the poses.")
    nearest_rotation(pose[:, :3], name, origin)
    if not (np.abs(pose[:, 3]) <= MAX_AWAY).all():
        raise InputError(
            f"The pose of {name} in {origin} is {np.abs(pose[:, 3]).max():.3g} away from the origin, at most "
            f"{MAX_AWAY:g} can be.",
            "Mend the poses.",
        )
