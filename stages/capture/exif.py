"""What a photo's EXIF says: focal length in pixels, place, and which photos were taken with one lens."""

from __future__ import annotations

import math
from pathlib import PurePosixPath
from typing import Any

DIAGONAL_35MM = math.hypot(36.0, 24.0)  # CIPA defines the 35 mm equivalent by the frame's diagonal

ORIENTATION, MAKE, MODEL, EXIF_IFD = 0x0112, 0x010F, 0x0110, 0x8769
FOCAL_LENGTH, FOCAL_LENGTH_35MM, LENS_MODEL = 0x920A, 0xA405, 0xA434
EXIF_WIDTH, EXIF_HEIGHT = 0xA002, 0xA003
FOCAL_PLANE_X_RESOLUTION, FOCAL_PLANE_UNIT = 0xA20E, 0xA210
GPS_IFD = 0x8825
GPS_LATITUDE_REF, GPS_LATITUDE, GPS_LONGITUDE_REF, GPS_LONGITUDE, GPS_ALTITUDE_REF, GPS_ALTITUDE = range(1, 7)
FOCAL_PLANE_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}


def _number(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def focal_px(exif: Any, size: tuple[int, int]) -> float | None:
    """Focal length in pixels of the stored image of `size`, or None.

    From the sensor's pixel pitch where the 35 mm equivalent does not contradict it (that one is rounded to
    whole millimetres), else from the 35 mm equivalent.
    """
    tags = exif.get_ifd(EXIF_IFD)
    equivalent, candidates = _number(tags.get(FOCAL_LENGTH_35MM)), []
    from_35mm = equivalent / DIAGONAL_35MM * math.hypot(*size) if equivalent else None
    focal_mm, pitch = _number(tags.get(FOCAL_LENGTH)), _number(tags.get(FOCAL_PLANE_X_RESOLUTION))
    unit_mm = FOCAL_PLANE_UNIT_MM.get(tags.get(FOCAL_PLANE_UNIT, 2))
    if focal_mm and pitch and unit_mm:
        # the pitch belongs to the picture as it was taken; it may have been reduced since, and turned (HEIF)
        width, height = (_number(tags.get(tag)) for tag in (EXIF_WIDTH, EXIF_HEIGHT))
        part = size[0] / (width or size[0]) if height is None or width is None else max(size) / max(width, height)
        from_pitch = focal_mm * pitch / unit_mm * part
        if from_35mm is None or abs(from_pitch / from_35mm - 1) < 0.05:
            candidates.append(from_pitch)
    if from_35mm is not None:
        candidates.append(from_35mm)
    plausible = [focal for focal in candidates if 0.2 < focal / max(size) < 20]
    return plausible[0] if plausible else None


def gps_position(exif: Any) -> tuple[float, float, float] | None:
    """Latitude, longitude (degrees) and altitude (metres), or None where one of them is missing or no number."""
    tags = exif.get_ifd(GPS_IFD)
    try:
        latitude, longitude = (
            sum(float(part) / 60**k for k, part in enumerate(tags[tag])) for tag in (GPS_LATITUDE, GPS_LONGITUDE)
        )
        altitude = float(tags[GPS_ALTITUDE])
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    south, west = (str(tags.get(tag, "")).upper().startswith(side) for tag, side in (
        (GPS_LATITUDE_REF, "S"), (GPS_LONGITUDE_REF, "W")
    ))  # fmt: skip
    below_sea = tags.get(GPS_ALTITUDE_REF) in (1, b"\x01")
    found = (-latitude if south else latitude, -longitude if west else longitude, -altitude if below_sea else altitude)
    # 0, 0 is what cameras write that have no fix
    return found if all(map(math.isfinite, found)) and max(map(abs, found[:2])) > 0 else None


def camera_key(exif: Any, size: tuple[int, int], source: str) -> str:
    """Photos with this in common share one camera's intrinsics: body, lens, zoom, upright size.

    Where EXIF names no camera, the folder of `source` stands for it: people sort by camera, if they sort. Portrait
    and landscape of one lens are told apart, since COLMAP's cameras have one width and height.
    """
    tags = exif.get_ifd(EXIF_IFD)
    named = [exif.get(MAKE), exif.get(MODEL), tags.get(LENS_MODEL)]
    text = [str(value).replace("\0", "").strip() for value in named if value]
    if not any(text):
        text = [f"folder {PurePosixPath(source).parent}"]
    # a phone's digital zoom changes the 35 mm equivalent only
    focal, equivalent = _number(tags.get(FOCAL_LENGTH)), _number(tags.get(FOCAL_LENGTH_35MM))
    text += [f"{focal:g} mm"] if focal else []
    text += [f"{equivalent:g} mm equivalent"] if equivalent else []
    return " | ".join([*text, f"{size[0]} x {size[1]}"])
