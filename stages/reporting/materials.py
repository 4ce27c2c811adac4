"""What the surface is made of and the light it was photographed in, as pictures of the page."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from stages.drawing.tone_mapping import on_screen
from stages.errors import InputError
from stages.files.light_files import read_light
from stages.reporting.pictures import jpeg_uri, read_rgb, shrink

MAP_SIDE = 512
LIGHT_WIDTH = 512
MIDDLE_GREY = 0.18  # the light's mean in its picture


def describe_materials(color: Path, orm: Path, known: Path, light: Path) -> dict[str, Any] | None:
    """Maps of the material, and the light where there is one; None where the material is missing or damaged.

    Args:
        color, orm, known: pictures of the texture's layout, see `stages.artifacts.materials`.
        light: the environment map as a Radiance file.
    """
    try:
        packed = read_rgb(orm)
        maps = [("Base colour, without light in it", read_rgb(color))]
    except (OSError, ValueError):
        return None
    maps += [
        ("Roughness: black is polished, white is matt", packed[..., 1]),
        ("Metalness: white is metal", packed[..., 2]),
    ]
    if (told := _picture(known)) is not None:
        maps.append(("What the photos tell of it: the darker, the less", told))
    return {
        "maps": [{"label": label, "image": jpeg_uri(shrink(_rgb(image), MAP_SIDE))} for label, image in maps],
        "light": light_picture(light),
    }


def light_picture(file: Path) -> str | None:
    """An environment map, exposed by its mean and tone-mapped, as a data URI; None where it is missing or damaged."""
    import cv2

    try:
        found = read_light(file)
    except InputError:
        return None
    shown = (255 * on_screen(found, np.log2(MIDDLE_GREY / float(found.mean()))) + 0.5).astype(np.uint8)
    return jpeg_uri(cv2.resize(shown, (LIGHT_WIDTH, LIGHT_WIDTH // 2), interpolation=cv2.INTER_LINEAR))


def _picture(file: Path) -> np.ndarray | None:
    try:
        return read_rgb(file)
    except (OSError, ValueError):
        return None


def _rgb(image: np.ndarray) -> np.ndarray:
    """A grey image [H, W] in three channels."""
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, axis=2)
