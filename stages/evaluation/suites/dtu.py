"""DTU as NeuS and IDR give it: `dtu_scan24/` (or `scan24/`) with `image/`, `mask/`, `cameras_sphere.npz`.

All photos train, as in the papers, and the mesh is scored with DTU's own evaluation data (`SampleSet/MVS Data` with
`ObsMask/` and `Points/stl/`), in millimetres. The figures of most papers are without masks, so that is the default.
"""

from __future__ import annotations

import re
from pathlib import Path

from stages.evaluation.protocols.dtu import truth_files
from stages.evaluation.suites.scene import SuiteScene, Truth, Wanted, every_nth, folders_with, photo_names
from stages.posing import neus

PLACES = ("", "SampleSet/MVS Data", "MVS Data", "DTU", "dtu_eval")


def find_scenes(folder: Path, wanted: Wanted) -> list[SuiteScene]:
    """Scans in `folder`, or `folder` itself if it is one."""
    places = folders_with(folder, neus.IMAGES, neus.FILES[0])
    return [_scene(place, number, wanted) for place in places if (number := _number(place)) is not None]


def _scene(place: Path, number: int, wanted: Wanted) -> SuiteScene:
    photos, poses = place / neus.IMAGES, place / neus.FILES[0]
    views = every_nth(photos, photo_names(photos), poses, wanted.hold_out)
    data = evaluation_data([wanted.truth, place.parent, place.parent.parent], number)
    lacking = []
    if data is None:
        observed, _, scanned = truth_files(Path(), number)
        lacking.append(
            f"no distance: DTU's evaluation data ({observed.as_posix()} and {scanned.as_posix()} of SampleSet) is not "
            "beside the scans; name its folder with --truth"
        )
    if views is None:
        lacking.append("no view synthesis: all photos train, as in the papers; --hold-out 8 holds out every 8th")
    return SuiteScene(
        name=str(number),
        photos=photos,
        poses=poses,
        masks=wanted.masks_in(place / neus.MASKS),
        views=views,
        truth=None if data is None else Truth("dtu", data, number),
        lacking=tuple(lacking),
    )


def evaluation_data(places: list[Path | None], number: int) -> Path | None:
    """The folder with `ObsMask/` and `Points/stl/` for a scan, in or below one of the places."""
    for place in filter(None, places):
        for inner in PLACES:
            observed, _, scanned = truth_files(place / inner, number)
            if observed.is_file() and scanned.is_file():
                return place / inner
    return None


def _number(place: Path) -> int | None:
    found = re.search(r"scan_?(\d+)$", place.name)
    return int(found[1]) if found else None
