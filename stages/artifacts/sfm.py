"""What sfm publishes: the COLMAP model, what became of each photo, and what given poses say of the scene."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from pydantic import Field

from stages.artifacts.artifact import Artifact, place_artifact
from stages.artifacts.json_files import Array, Record, read_record, record_artifact, write_record
from stages.artifacts.place import PlaceRecord

_GIVEN_POSES = "known_poses.json"


class Unregistered(Record):
    """A photo that has no pose, and why, in words."""

    name: str
    reason: str


class LensTrial(Record):
    """A part of the lens that the last adjustment tried to free.

    Attributes:
        freedom: what, in words.
        held_out_px: mean error of the held-out observations without and with it, pixels.
        refused: why it was not kept, in words; empty where it was.
    """

    freedom: str
    held_out_px: tuple[float, float]
    refused: str


class Lens(Record):
    """The intrinsics of one camera.

    Attributes:
        photos: how many it took. size: width and height of its frame, pixels.
        model: COLMAP's name. params: its parameters by COLMAP's names.
        standard_errors: of those that were adjusted; none where they could not be told.
        trials: what the last adjustment tried on it.
    """

    photos: int
    size: tuple[int, int]
    model: str
    params: dict[str, float]
    standard_errors: dict[str, float]
    trials: tuple[LensTrial, ...] = ()

    @property
    def focal(self) -> float:
        """Pixels; the horizontal one, where there are two."""
        return next(value for name, value in self.params.items() if name in ("f", "fx"))

    @property
    def focal_error(self) -> float:
        """Its standard error; infinite where it cannot be told."""
        return next((value for name, value in self.standard_errors.items() if name in ("f", "fx")), math.inf)

    @property
    def freed(self) -> tuple[str, ...]:
        """What was freed for good."""
        return tuple(trial.freedom for trial in self.trials if not trial.refused)


class PoseError(Record):
    """How exact the poses are, from their covariance; what all photos err alike is not in it.

    Attributes:
        residual_px: a-posteriori standard deviation of a feature's coordinate, pixels.
        center: median over the photos of their centres' expected error (root mean square, after alignment by a
            similarity), in the frame of the poses.
        distance: median distance from a photo to a point it sees, in the same unit.
    """

    residual_px: float
    center: float
    distance: float


class Registration(Record):
    """How the photos were placed.

    Attributes:
        registered: names of the photos that have a pose.
        mean_reprojection_error_px, mean_track_length: of the model; 0 where it has no points.
        num_points, num_models: points of the model; models that mapping gave.
        mapper, matcher: how poses and pairs were found.
        kept: the attempt whose model this is; empty where the poses were given.
        ladder: the attempts, see `stages.posing.ladder.Step`.
        relaxed: whether photos were placed with relaxed thresholds, in this run or one that it goes on from.
        lenses: of the cameras; none where the poses were given. pose_error: None there, and where it cannot be told.
    """

    registered: tuple[str, ...] = ()
    unregistered: tuple[Unregistered, ...] = ()
    mean_reprojection_error_px: float = 0.0
    mean_track_length: float = 0.0
    num_points: int = 0
    num_models: int = 1
    mapper: str = ""
    matcher: str = ""
    kept: str = ""
    relaxed: bool = False
    ladder: tuple[dict[str, Any], ...] = ()
    lenses: tuple[Lens, ...] = ()
    pose_error: PoseError | None = None


class KnownSphere(Record):
    """The sphere that given poses say the object is in, in their own frame; `source`: from what, in words."""

    center: Array
    radius: float
    source: str


class GivenPoses(Record):
    """Poses that were given and not found.

    Attributes:
        origin: name of their file or folder.
        region: where they say one.
        place: where they lie in the world, where they are a part of a workspace that knows it.
    """

    origin: str
    region: KnownSphere | None = None
    place: PlaceRecord | None = None


class PhotoFile(Record):
    """A photo as ingest took it: see `ImageRecord`."""

    sha256: str
    camera: str
    focal_px: float | None


class PhotoContents(Record):
    """What photos the model was made of, for when some are added or removed.

    Attributes:
        lineage: models with the same one hold the same photos at the same places, as far as they share them: each but
            the first went on from one before it.
        contents: name -> digest of the photo and its mask, of all photos, placed or not.
        files: name -> what ingest said of it.
        seen: sha256 of all photos that this model, or one that it goes on from, may have been made of.
        background_moved: whether the background was found to move against the object, and left out.
    """

    lineage: str
    contents: dict[str, str]
    files: dict[str, PhotoFile] = Field(default_factory=dict)
    seen: tuple[str, ...] = ()
    background_moved: bool = False


def _save_given_poses(folder: Path, poses: GivenPoses | None) -> None:
    if poses is not None:
        write_record(folder / _GIVEN_POSES, poses)


def _load_given_poses(folder: Path) -> GivenPoses | None:
    path = folder / _GIVEN_POSES
    return read_record(path, GivenPoses) if path.exists() else None


# The COLMAP model (cameras.bin, images.bin, points3D.bin).
MODEL = place_artifact("sfm", "model", "model/*")
REGISTRATION = record_artifact("sfm", "registration.json", Registration)
PHOTO_CONTENTS = record_artifact("sfm", "contents.json", PhotoContents)
# The folder of COLMAP's database of features and matches that the model was found on, where more photos can be matched.
FEATURES = place_artifact("sfm", "features", "features/*", optional=True)
# None where the poses were found and not given.
GIVEN_POSES = Artifact("sfm", (_GIVEN_POSES,), _load_given_poses, _save_given_poses, optional=True)
