"""The files of a made-up set: photos as a camera writes them, and, last, the truth that says how they were made."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np

from stages import artifacts
from stages.evaluation.protocols.known_object import TRUTH_CAMERAS

OPENGL_FROM_OPENCV = np.diag([1.0, -1, -1, 1])
SECONDS_DIGITS = 4  # of latitude and longitude: 3 mm


def photo_exif(picture: Any, index: int, model: str, focal_35mm: int, position: Sequence[float] | None = None) -> Any:
    """What a camera would note: maker, model, time, and the focal length SfM starts from (35 mm equivalent).

    Args:
        position: latitude and longitude in degrees (WGS 84) and altitude in metres, of a camera with GPS.
    """
    from PIL import ExifTags

    exif = picture.getexif()
    taken = datetime(2025, 6, 1, 12, 0, 0) + timedelta(seconds=5 * index)
    exif[ExifTags.Base.Make] = "HiNeuS"
    exif[ExifTags.Base.Model] = model
    exif[ExifTags.Base.DateTime] = taken.strftime("%Y:%m:%d %H:%M:%S")
    details = exif.get_ifd(ExifTags.IFD.Exif)
    details[ExifTags.Base.FocalLength] = float(focal_35mm)
    details[ExifTags.Base.FocalLengthIn35mmFilm] = focal_35mm
    if position is not None:
        exif.get_ifd(ExifTags.IFD.GPSInfo).update(_gps_tags(*position))
    return exif


def _gps_tags(latitude: float, longitude: float, altitude: float) -> dict[int, Any]:
    from PIL.ExifTags import GPS

    return {
        GPS.GPSLatitudeRef: "S" if latitude < 0 else "N",
        GPS.GPSLatitude: _sexagesimal(abs(latitude)),
        GPS.GPSLongitudeRef: "W" if longitude < 0 else "E",
        GPS.GPSLongitude: _sexagesimal(abs(longitude)),
        GPS.GPSAltitudeRef: b"\1" if altitude < 0 else b"\0",
        GPS.GPSAltitude: round(abs(altitude), 3),
    }


def _sexagesimal(degrees: float) -> tuple[float, float, float]:
    """Degrees, minutes and seconds to `SECONDS_DIGITS`."""
    seconds = round(3600 * degrees, SECONDS_DIGITS)
    return seconds // 3600, seconds // 60 % 60, round(seconds % 60, SECONDS_DIGITS)


def write_truth(
    folder: Path,
    names: Sequence[str],
    cam_from_world: np.ndarray,
    size: tuple[int, int],
    focal: float,
    made_with: Mapping[str, Any],
    notes: Sequence[Mapping[str, Any]] | None = None,
) -> None:
    """Write `transforms.json`, which says that the set is complete.

    Args:
        names: of the photos, relative to the folder.
        cam_from_world: [N, 4, 4]; each is written as `transform_matrix` (camera to world, OpenGL axes), and as
            `w2c_opencv` as it is.
        focal: pixels; the principal point is the middle.
        made_with: the recipe.
        notes: more to say of each photo.
    """
    frames = [
        {
            "file_path": name,
            **note,
            "transform_matrix": (np.linalg.inv(pose) @ OPENGL_FROM_OPENCV).tolist(),
            "w2c_opencv": pose.tolist(),
        }
        for name, pose, note in zip(names, cam_from_world, notes or [{}] * len(names), strict=True)
    ]
    width, height = size
    truth = {
        "camera_model": "PINHOLE",
        "w": width,
        "h": height,
        "fl_x": focal,
        "fl_y": focal,
        "cx": width / 2,
        "cy": height / 2,
        "made_with": made_with,
        "frames": frames,
    }
    partial = (folder / TRUTH_CAMERAS).with_suffix(".partial")
    artifacts.write_json(partial, truth)
    os.replace(partial, folder / TRUTH_CAMERAS)


def is_complete(folder: Path, made_with: Mapping[str, Any]) -> bool:
    """Whether a set made with this recipe is there, to the last photo."""
    try:
        truth = artifacts.read_json(folder / TRUTH_CAMERAS)
    except (OSError, ValueError):
        return False
    return truth.get("made_with") == made_with and all(
        (folder / frame["file_path"]).is_file() for frame in truth["frames"]
    )
