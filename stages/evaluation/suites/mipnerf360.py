"""Mip-NeRF 360: `garden/` with `images/`, `images_2/`, `images_4/`, `sparse/0`.

As published: every 8th photo from the first is a test, outdoor scenes at a quarter and indoor ones at half the size.
"""

from __future__ import annotations

from pathlib import Path

from stages.evaluation.suites.scene import SuiteScene, Wanted, every_nth, folders_with, photo_names

INDOOR = ("room", "counter", "kitchen", "bonsai")
EVERY = 8
MODEL = "sparse/0"


def find_scenes(folder: Path, wanted: Wanted) -> list[SuiteScene]:
    """Scenes in `folder`, or `folder` itself if it is one."""
    return [_scene(place) for place in folders_with(folder, MODEL)]


def _scene(place: Path) -> SuiteScene:
    sizes = ("images_2", "images_4") if place.name in INDOOR else ("images_4", "images_2")
    published, *others = [place / name for name in (sizes[0], "images", sizes[1])]
    photos = next((folder for folder in (published, *others) if folder.is_dir()), published)
    views = every_nth(photos, photo_names(photos), place / MODEL, EVERY) if photos.is_dir() else None
    lacking = (f"photos of {photos.name}: the papers' figures are of {sizes[0]}",) if photos != published else ()
    return SuiteScene(place.name, photos, place / MODEL, views=views, lacking=lacking)
