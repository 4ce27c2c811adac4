"""BlendedMVS, as published (`<id>/` with `blended_images/`, `cams/`, `rendered_depth_maps/`) or as NeuS and VolSDF
give some of it (`bmvs_bear/` with `image/`, `mask/`, `cameras_sphere.npz`).

There is no agreed split or score: all photos train; of the published form the rendered depth maps are the truth.
"""

from __future__ import annotations

from pathlib import Path

from stages.evaluation.protocols.blendedmvs import DEPTHS
from stages.evaluation.suites.scene import SuiteScene, Truth, Wanted, every_nth, folders_with, photo_names
from stages.posing import mvsnet, neus

MASKED = "_masked"  # pictures with black where the model has a hole


def find_scenes(folder: Path, wanted: Wanted) -> list[SuiteScene]:
    """Scenes in `folder`, or `folder` itself if it is one."""
    published = [_published(place, wanted) for place in folders_with(folder, mvsnet.IMAGES[0], mvsnet.CAMERAS)]
    prepared = {place: name for name in reversed(neus.FILES) for place in folders_with(folder, neus.IMAGES, name)}
    return [*published, *(_prepared(place, place / name, wanted) for place, name in sorted(prepared.items()))]


def _published(place: Path, wanted: Wanted) -> SuiteScene:
    photos = place / mvsnet.IMAGES[0]
    names = [name for name in photo_names(photos) if MASKED not in name]
    depth = (place / DEPTHS).is_dir()
    return SuiteScene(
        name=place.name,
        photos=photos,
        poses=place / mvsnet.CAMERAS,
        views=every_nth(photos, names, place / mvsnet.CAMERAS, wanted.hold_out),
        truth=Truth("depth maps", place) if depth else None,
        lacking=() if depth else (f"no distance: {place.name} has no {DEPTHS}",),
    )


def _prepared(place: Path, poses: Path, wanted: Wanted) -> SuiteScene:
    photos = place / neus.IMAGES
    return SuiteScene(
        name=place.name,
        photos=photos,
        poses=poses,
        masks=wanted.masks_in(place / neus.MASKS),
        views=every_nth(photos, photo_names(photos), poses, wanted.hold_out),
        lacking=(f"no distance: {place.name} comes without a surface in this layout",),
    )
