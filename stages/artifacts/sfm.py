"""What sfm publishes: the COLMAP model, what became of each photo, and what given poses say of the scene."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from stages.artifacts.artifact import Artifact, place_artifact
from stages.artifacts.json_files import Array, Record, read_record, record_artifact, write_record

_GIVEN_POSES = "known_poses.json"


class Unregistered(Record):
    """A photo that has no pose, and why, in words."""

    name: str
    reason: str


class Registration(Record):
    """How the photos were placed.

    Attributes:
        registered: names of the photos that have a pose.
        mean_reprojection_error_px, mean_track_length: of the model; 0 where it has no points.
        num_points, num_models: points of the model; models that mapping gave.
        mapper, matcher: how poses and pairs were found.
        kept: the attempt whose model this is; empty where the poses were given.
        ladder: the attempts, see `stages.posing.ladder.Step`.
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
    ladder: tuple[dict[str, Any], ...] = ()


class KnownSphere(Record):
    """The sphere that given poses say the object is in, in their own frame; `source`: from what, in words."""

    center: Array
    radius: float
    source: str


class GivenPoses(Record):
    """Poses that were given and not found: the name of their file or folder, and their region where they say one."""

    origin: str
    region: KnownSphere | None = None


def _save_given_poses(folder: Path, poses: GivenPoses | None) -> None:
    if poses is not None:
        write_record(folder / _GIVEN_POSES, poses)


def _load_given_poses(folder: Path) -> GivenPoses | None:
    path = folder / _GIVEN_POSES
    return read_record(path, GivenPoses) if path.exists() else None


# The COLMAP model (cameras.bin, images.bin, points3D.bin).
MODEL = place_artifact("sfm", "model", "model/*")
REGISTRATION = record_artifact("sfm", "registration.json", Registration)
# None where the poses were found and not given.
GIVEN_POSES = Artifact("sfm", (_GIVEN_POSES,), _load_given_poses, _save_given_poses, optional=True)
