"""Whether the GPS positions of a set of photos can be."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping

import numpy as np

from stages.capture.exif import Gps
from stages.capture.listing import name_some
from stages.geometry.earth import earth_centred, middle_position

# A position further from the middle of all is of another place: metres, and times the median distance.
FAR_M, FAR_TIMES = 20e3, 20.0
SAME_M = 0.01  # positions as near as this are one
ON_THE_SHORE_M = 30.0  # lower photos may well be at 0, which programs write for an altitude that they do not know
MIN_SAME = 4  # fewer photos may well have been taken from one place


def gps_warnings(found: Mapping[str, Gps]) -> list[str]:
    """What is wrong with the positions of a set of photos, by their names, a sentence each."""
    faults: dict[str, list[str]] = defaultdict(list)
    for name, gps in found.items():
        if gps.fault:
            faults[gps.fault].append(name)
    sentences = [f"GPS is not used of {name_some(names)}: {fault}." for fault, names in faults.items()]
    names = [name for name, gps in found.items() if gps.position is not None]
    if len(names) < MIN_SAME:
        return sentences
    positions = np.array([found[name].position for name in names])
    middle = earth_centred(np.array([middle_position(positions)]))
    away = np.linalg.norm(earth_centred(positions) - middle, axis=1)
    if away.max() < SAME_M:
        sentences.append(f"All {len(names)} photos carry the same GPS position, which tells neither scale nor place.")
    level = float(np.median(positions[:, 2]))
    if abs(level) > ON_THE_SHORE_M and (at_zero := [names[i] for i in np.flatnonzero(positions[:, 2] == 0)]):
        sentences.append(
            f"GPS has {name_some(at_zero)} at an altitude of 0, the other photos at about {level:.0f} m: where these "
            "agree, such positions do not count."
        )
    far = np.flatnonzero(away > max(FAR_M, FAR_TIMES * float(np.median(away))))
    if far.size:
        sentences.append(
            f"GPS puts {name_some([names[i] for i in far])} {away[far].max() / 1e3:,.0f} km from the other photos: "
            "such positions do not count."
        )
    return sentences
