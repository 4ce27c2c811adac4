"""Sets of known objects: `<set>/` with `images/`, `masks/`, `transforms.json`, `gt_mesh.ply`.

Poses are found from the photos alone, as from anybody's; the truth meets the result by the camera centres. With masks
(`--masks`) the object is cut out. With `--hold-out` the photos come with their true poses, or nothing would say where
the test photos were taken from.
"""

from __future__ import annotations

from pathlib import Path

from stages.evaluation.protocols.known_object import TRUTH_CAMERAS, TRUTH_MESH
from stages.evaluation.suites.scene import SuiteScene, Truth, Wanted, every_nth, folders_with, photo_names

IMAGES, MASKS = "images", "masks"


def find_scenes(folder: Path, wanted: Wanted) -> list[SuiteScene]:
    """Sets in `folder`, or `folder` itself if it is one."""
    return [_scene(place, wanted) for place in folders_with(folder, IMAGES, TRUTH_MESH, TRUTH_CAMERAS)]


def _scene(place: Path, wanted: Wanted) -> SuiteScene:
    photos = place / IMAGES
    views = every_nth(photos, photo_names(photos), place / TRUTH_CAMERAS, wanted.hold_out)
    return SuiteScene(
        name=place.name,
        photos=photos,
        poses=None if views is None else views.poses,
        masks=wanted.masks_in(place / MASKS),
        views=views,
        truth=Truth("known", place),
    )
