"""What a photo's EXIF says: focal length in pixels, place, and which photos were taken with one lens."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Any

DIAGONAL_35MM = math.hypot(36.0, 24.0)  # CIPA defines the 35 mm equivalent by the frame's diagonal

ORIENTATION, MAKE, MODEL, EXIF_IFD = 0x0112, 0x010F, 0x0110, 0x8769
FOCAL_LENGTH, FOCAL_LENGTH_35MM, LENS_MODEL = 0x920A, 0xA405, 0xA434
EXIF_WIDTH, EXIF_HEIGHT = 0xA002, 0xA003
FOCAL_PLANE_X_RESOLUTION, FOCAL_PLANE_UNIT = 0xA20E, 0xA210
GPS_IFD = 0x8825
LATITUDE_REF, LATITUDE, LONGITUDE_REF, LONGITUDE, ALTITUDE_REF, ALTITUDE = range(1, 7)
# below sea level, and since EXIF 3.0 below the ellipsoid; Pillow gives bytes, or numbers of damaged files
BELOW = (1, 3, b"\x01", b"\x03")
MOST_NAME = 80  # characters of a camera's name; damaged files have thousands
NO_FIX_DEG = 1e-6  # 0, 0 is what cameras write that have no fix
FOCAL_PLANE_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}


def _finite(value: Any) -> float | None:
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) else None


def _number(value: Any) -> float | None:
    number = _finite(value)
    return number if number is not None and number > 0 else None


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


@dataclass(frozen=True)
class Gps:
    """What the GPS tags of a photo say.

    Attributes:
        position: latitude and longitude in degrees (WGS 84) and altitude in metres; None where they cannot be used.
        fault: why not, in words; empty where they can, and where there are none.
    """

    position: tuple[float, float, float] | None = None
    fault: str = ""


NO_GPS = Gps()


def read_gps(exif: Any) -> Gps:
    """The GPS tags of Pillow's EXIF."""
    try:
        tags = exif.get_ifd(GPS_IFD)
    except Exception:  # damaged directories raise nearly anything
        return Gps(fault="its tags are damaged")
    if LATITUDE not in tags and LONGITUDE not in tags:
        return NO_GPS
    latitude, longitude = _degrees(tags.get(LATITUDE)), _degrees(tags.get(LONGITUDE))
    if latitude is None or longitude is None:
        return Gps(fault="its latitude or longitude is no number")
    if abs(latitude) > 90 or abs(longitude) > 180:
        return Gps(fault="its latitude or longitude is beyond 90 or 180 degrees")
    if max(abs(latitude), abs(longitude)) < NO_FIX_DEG:
        return Gps(fault="it says 0, 0, as cameras do without a fix")
    altitude = _finite(tags.get(ALTITUDE))
    if altitude is None:
        return Gps(fault="it has no altitude")
    return Gps(
        (
            -latitude if _begins(tags.get(LATITUDE_REF), "S") else latitude,
            -longitude if _begins(tags.get(LONGITUDE_REF), "W") else longitude,
            -altitude if tags.get(ALTITUDE_REF) in BELOW else altitude,
        )
    )


def _degrees(value: Any) -> float | None:
    """Degrees, minutes and seconds, or degrees alone, which some programs write."""
    parts = value if isinstance(value, (tuple, list)) else (value,)
    numbers = [_finite(part) for part in parts]
    if not numbers or None in numbers:
        return None
    return sum(number / 60**k for k, number in enumerate(numbers) if number is not None)


def _begins(value: Any, side: str) -> bool:
    text = value.decode("latin-1") if isinstance(value, bytes) else str(value or "")
    return text.strip().upper().startswith(side)


def camera_key(exif: Any, size: tuple[int, int], source: str) -> str:
    """Photos with this in common share one camera's intrinsics: body, lens, zoom, upright size.

    Where EXIF names no camera, the folder of `source` stands for it: people sort by camera, if they sort. Portrait
    and landscape of one lens are told apart, since COLMAP's cameras have one width and height.
    """
    tags = exif.get_ifd(EXIF_IFD)
    named = [exif.get(MAKE), exif.get(MODEL), tags.get(LENS_MODEL)]
    text = [str(value).replace("\0", "").strip()[:MOST_NAME] for value in named if value]
    if not any(text):
        text = [f"folder {PurePosixPath(source).parent}"]
    # a phone's digital zoom changes the 35 mm equivalent only
    focal, equivalent = _number(tags.get(FOCAL_LENGTH)), _number(tags.get(FOCAL_LENGTH_35MM))
    text += [f"{focal:g} mm"] if focal else []
    text += [f"{equivalent:g} mm equivalent"] if equivalent else []
    return " | ".join([*text, f"{size[0]} x {size[1]}"])
