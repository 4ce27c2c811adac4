"""UrbanScene3D: the photos of a real scene with GPS in EXIF (`Residence/photos/*.JPG`, or in the folder itself), or
with the poses that Mega-NeRF's authors refined (`residence-pixsfm/{train,val}/` with `metadata/` and `rgbs/`).

Of the second form `val` is the test. Of the first, poses are found. Its evaluation program reads a format of its own,
so no distance to its scans is measured here.
"""

from __future__ import annotations

from pathlib import Path

from stages.evaluation.suites.scene import SuiteScene, TestViews, Wanted, every_nth, photo_names, places_in
from stages.posing import colmap_model, meganerf

PHOTOS = ("photos", "images", "Photos", "Images", "")
NO_DISTANCE = "no distance: its scans are for its own evaluation program"


def find_scenes(folder: Path, wanted: Wanted) -> list[SuiteScene]:
    """Scenes in `folder`, or `folder` itself if it is one."""
    places = places_in(folder)
    refined = [_refined(place) for place in places if meganerf.has_metadata(place / "train")]
    if refined and refined[0].photos.parent.parent == folder:
        return refined
    raw = [(place, photos) for place in places if (photos := _photos(place)) and place.name not in ("train", "val")]
    if raw and raw[0][0] == folder:
        raw = raw[:1]
    return [*refined, *(_raw(place, photos, wanted) for place, photos in raw)]


def _refined(place: Path) -> SuiteScene:
    train, test = place / "train", place / "val"
    views, lacking = None, [NO_DISTANCE]
    if meganerf.has_metadata(test) and (test / meganerf.IMAGES).is_dir():
        views = TestViews(test / meganerf.IMAGES, tuple(photo_names(test / meganerf.IMAGES)), test)
    else:
        lacking.append(f"no view synthesis: {place.name} has no val/ with photos in it")
    return SuiteScene(place.name, train / meganerf.IMAGES, train, views=views, lacking=tuple(lacking))


def _raw(place: Path, photos: Path, wanted: Wanted) -> SuiteScene:
    poses = colmap_model.find_model(place)
    lacking = [NO_DISTANCE]
    views = every_nth(photos, photo_names(photos), poses, wanted.hold_out) if poses else None
    if poses is None:
        lacking.append("no view synthesis: without poses nothing says where test photos were taken from")
    return SuiteScene(place.name, photos, poses, views=views, lacking=tuple(lacking))


def _photos(place: Path) -> Path | None:
    return next((place / name for name in PHOTOS if (place / name).is_dir() and photo_names(place / name)), None)
