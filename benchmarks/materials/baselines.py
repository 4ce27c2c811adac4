"""What a reconstruction without the stage `materials` offers: its baked texture as the base colour.

The second baseline is given the true light of the photos, more than any method has, and chooses the roughness, and one
scale of the texture, with which the training photos come out best.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.materials.glb_model import Model, linear
from benchmarks.materials.held_out import Views
from benchmarks.materials.judge import Judge
from stages import artifacts
from stages.evaluation.protocols.known_object import TRUTH_CAMERAS

ROUGHNESSES = (0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8, 1.0)
PHOTOS, SHRINK, SPP = 4, 4, 16
FULL = 0.98  # of the sensor: beyond, a photo is clipped


def baked_model(model: Model, baked: np.ndarray) -> Model:
    """Matte, as the file was before."""
    return model.of(baked, 1.0, 0.0)


def fitted_model(model: Model, baked: np.ndarray, folder: Path, light: np.ndarray, variant: str) -> tuple[Model, float]:
    """The texture, scaled, with the constant roughness that fits the photos in `folder` best; and that roughness.

    A picture is linear in the texture's scale but for light between its own surfaces: one is drawn with the texture
    and one with black, and the scale is what least squares say.
    """
    views, photos, masks = _photos(folder)
    judge = Judge(views, variant)
    fits = []
    for roughness in ROUGHNESSES:
        shine, whole = (
            judge.lit(model.of(color, roughness, 0.0), light, SPP)[masks] for color in (np.zeros_like(baked), baked)
        )
        paint, rest = whole - shine, photos[masks] - shine
        fits_here = np.clip((paint * rest).sum() / max((paint * paint).sum(), 1e-12), 0.05, 20.0)
        fits.append((float(np.mean((paint * fits_here - rest) ** 2)), roughness, float(fits_here)))
    _, roughness, scale = min(fits)
    return model.of(np.clip(baked * scale, 0, 1), roughness, 0.0), roughness


def _photos(folder: Path) -> tuple[Views, np.ndarray, np.ndarray]:
    """A few training photos, smaller: cameras, radiance [N, H, W, 3] and the pixels that tell of it [N, H, W]."""
    import cv2

    truth = artifacts.read_json(folder / TRUTH_CAMERAS)
    size = (truth["w"] // SHRINK, truth["h"] // SHRINK)
    frames: Sequence[dict] = truth["frames"][:: max(len(truth["frames"]) // PHOTOS, 1)][:PHOTOS]
    views = Views(np.array([frame["w2c_opencv"] for frame in frames]), truth["fl_x"] / SHRINK, size)
    photos, masks = [], []
    for frame in frames:
        path = folder / frame["file_path"]
        photo = linear(cv2.imread(str(path))[..., ::-1])
        mask = cv2.imread(str(folder / "masks" / path.with_suffix(".png").name), cv2.IMREAD_GRAYSCALE)
        told = ((mask > 127) & (photo < FULL).all(2)).astype(np.float32)
        photos.append(cv2.resize(photo, size, interpolation=cv2.INTER_AREA) / frame["exposure"])
        masks.append(cv2.resize(told, size, interpolation=cv2.INTER_AREA) == 1)
    return views, np.stack(photos), np.stack(masks)
