"""What place publishes: how the frame of the poses lies in the world, and the region that the user gave."""

from __future__ import annotations

from pathlib import Path

from stages.artifacts.artifact import Artifact
from stages.artifacts.json_files import Array, Record, read_record, write_record
from stages.geometry.place import ControlPoint, GivenRegion, Place
from stages.geometry.similarity import Similarity

_PLACE = "place.json"
_REGION = "given_region.json"


class SimilarityRecord(Record):
    """See `Similarity`."""

    scale: float
    rotation: Array
    translation: Array

    def similarity(self) -> Similarity:
        return Similarity(self.scale, self.rotation, self.translation)


class PlaceRecord(Record):
    """See `Place`."""

    world_from_poses: SimilarityRecord
    metric: bool
    scale_from: str
    scale_error: float | None
    origin: tuple[float, float, float] | None
    gps_residual: float | None
    up: Array | None
    control: tuple[ControlPoint, ...] = ()
    control_residual: float | None = None
    crs: str = ""
    offset: tuple[float, float, float] | None = None

    def place(self) -> Place:
        return Place(**{**dict(self), "world_from_poses": self.world_from_poses.similarity()})


class _RegionRecord(Record):
    """Null throughout where the region is to be found."""

    center: Array | None = None
    radius: float | None = None
    box: Array | None = None
    world_from_poses: SimilarityRecord | None = None


def _save_place(folder: Path, place: Place) -> None:
    write_record(folder / _PLACE, PlaceRecord.model_validate(place))


def _load_place(folder: Path) -> Place:
    return read_record(folder / _PLACE, PlaceRecord).place()


def _save_given_region(folder: Path, region: GivenRegion | None) -> None:
    write_record(folder / _REGION, _RegionRecord() if region is None else _RegionRecord.model_validate(region))


def _load_given_region(folder: Path) -> GivenRegion | None:
    """None where none was given."""
    record = read_record(folder / _REGION, _RegionRecord)
    if record.center is None or record.radius is None or record.world_from_poses is None:
        return None
    return GivenRegion(record.center, record.radius, record.box, record.world_from_poses.similarity())


WORLD_PLACE = Artifact("place", (_PLACE,), _load_place, _save_place)
GIVEN_REGION = Artifact("place", (_REGION,), _load_given_region, _save_given_region)
