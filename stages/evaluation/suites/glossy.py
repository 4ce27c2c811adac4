"""GlossySynthetic of NeRO: `bell/` with `0.png`, `0-camera.pkl`, `0-depth.png`, ...

All photos train. The truth is what the depth images show, in the test views that NeRO's `synthetic_split_128.pkl`
names; it comes with its code, not with the data. Depth images are the masks, too, where masks are wanted; NeRO trains
without.
"""

from __future__ import annotations

from pathlib import Path

from stages.evaluation.suites.scene import SuiteScene, Truth, Wanted, every_nth, places_in
from stages.inputs.depth import DEPTH
from stages.posing import nero

SPLIT = "synthetic_split_128.pkl"


def find_scenes(folder: Path, wanted: Wanted) -> list[SuiteScene]:
    """Scenes in `folder`, or `folder` itself if it is one."""
    return [_scene(place, wanted) for place in places_in(folder) if nero.has_cameras(place)]


def _scene(place: Path, wanted: Wanted) -> SuiteScene:
    cameras = sorted(place.glob(f"*{nero.CAMERA}"), key=lambda path: (len(path.name), path.name))
    names = [f"{path.name.removesuffix(nero.CAMERA)}.png" for path in cameras]
    depth = all((place / name.replace(".png", DEPTH)).is_file() for name in names)
    split = next((p / SPLIT for p in (wanted.truth, place.parent) if p is not None and (p / SPLIT).is_file()), None)
    lacking = []
    if not depth:
        lacking.append(f"no distance: {place.name} lacks depth images ({names[0][:-4]}{DEPTH}, ...)")
    elif split is None:
        lacking.append(f"distance over all views: {SPLIT} of NeRO's code is not there; name its folder with --truth")
    return SuiteScene(
        name=place.name,
        photos=place,
        poses=place,
        masks=place if wanted.masks and depth else None,
        views=every_nth(place, names, place, wanted.hold_out),
        truth=Truth("glossy", place, split=split) if depth else None,
        lacking=tuple(lacking),
    )
