"""How near a model comes to the truth, by the protocol of Synthetic4Relight as far as it goes here.

Pixels count that the object covers wholly, in all held-out views of an object. A photo cannot tell a light of twice
the power from a surface twice as bright, so colours are compared after one scale a channel over all views of an object:
the median of truth over result among the pixels that count, for the base colour and for the pictures under the unseen
lights (one scale for both lights) each. Then base colours, and radiances exposed so that the truth's 90th percentile is
`WHITE_POINT`, are clipped to [0, 1], coded by the tone curve of sRGB in 8 bits, and compared.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.synthetic.capture import WHITE_POINT
from stages.drawing.view_scores import psnr, ssim
from stages.light.srgb import as_bytes
from stages.scenes.room import sphere_directions

WHOLE = 0.999  # coverage
DARK = 1e-4  # below which a quotient says nothing
LOBE_DEG = 15.0  # lamps are hardly larger, and a learned map is coarse
SHIFTS = 50
SOURCE_ROWS = 32


def counted(coverage: np.ndarray) -> np.ndarray:
    """Which pixels count."""
    return coverage > WHOLE


def channel_scale(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """[3] by which [P, 3] found ones are multiplied: the median of truth over found."""
    return np.array(
        [
            np.median(truth[lit, c] / found[lit, c]) if (lit := found[:, c] > DARK).any() else 1.0
            for c in range(3)
        ]
    )  # fmt: skip


def exposure(truths: np.ndarray, masks: np.ndarray) -> float:
    """Of truths [N, H, W, 3] inside masks [N, H, W], as a photographer would set it."""
    return float(WHITE_POINT / np.percentile(truths[masks], 90))


def coded(linear: np.ndarray) -> np.ndarray:
    """8-bit sRGB of linear values.

    Raises:
        ValueError: a value is not finite. Cast to 8 bits, two such pictures would agree perfectly.
    """
    if not np.isfinite(linear).all():
        raise ValueError(f"expected finite values, got {int((~np.isfinite(linear)).sum())} that are not")
    return as_bytes(np.clip(linear, 0, 1))


def picture_scores(found: np.ndarray, truth: np.ndarray, masks: np.ndarray) -> dict[str, float]:
    """Mean PSNR and SSIM of 8-bit pictures [N, H, W, 3] inside masks [N, H, W]."""
    pairs = list(zip(found, truth, masks, strict=True))
    return {
        "psnr": float(np.mean([psnr(*pair) for pair in pairs])),
        "ssim": float(np.mean([ssim(*pair) for pair in pairs])),
    }


def lit_scores(found: Sequence[np.ndarray], truths: Sequence[np.ndarray], masks: np.ndarray) -> dict[str, float]:
    """Of radiances [N, H, W, 3] under each of several lights; one scale a channel for all of them."""
    scale, exposures = lit_scales(found, truths, masks)
    scores = [
        picture_scores(coded(scale * e * image), coded(e * truth), masks)
        for image, truth, e in zip(found, truths, exposures, strict=True)
    ]
    return {key: float(np.mean([score[key] for score in scores])) for key in scores[0]}


def lit_scales(
    found: Sequence[np.ndarray], truths: Sequence[np.ndarray], masks: np.ndarray
) -> tuple[np.ndarray, list[float]]:
    """The scale [3] of radiances under all lights, and the exposure under each."""
    both = [np.concatenate([picture[masks] for picture in pictures]) for pictures in (found, truths)]
    return channel_scale(*both), [exposure(truth, masks) for truth in truths]


def map_scores(found: Sequence[dict[str, np.ndarray]], truths: Sequence[dict[str, np.ndarray]]) -> dict[str, float]:
    """Of `base_color`, `roughness`, `metallic` maps; what the model does not cover counts as it is, 0."""
    masks = np.stack([counted(truth["coverage"]) for truth in truths])
    pairs = {
        key: (np.stack([one[key] for one in found]), np.stack([one[key] for one in truths]))
        for key in ("base_color", "roughness", "metallic")
    }
    color, true_color = pairs["base_color"]
    scale = channel_scale(color[masks], true_color[masks])
    base = picture_scores(coded(color * scale), coded(true_color), masks)
    roughness, metallic = (np.abs(np.subtract(*pairs[key]))[masks].mean() for key in ("roughness", "metallic"))
    is_metal, said_metal = pairs["metallic"][1][masks] > 0.5, pairs["metallic"][0][masks] > 0.5
    return {
        "base_color_psnr": base["psnr"],
        "roughness_mae": float(roughness),
        "metallic_mae": float(metallic),
        "told_apart": float((is_metal == said_metal).mean()),
    }


# ---------------------------------------------------------------- light
def main_source(light: np.ndarray) -> np.ndarray:
    """Unit direction [3] of the main source of a light that is given as `Scene.sky` is.

    Where the light that is brighter than the map's median, blurred by a lobe of `LOBE_DEG`, is brightest: the best
    pixel of a coarse map, then by mean shift (Fukunaga and Hostetler 1975).
    """
    from stages.light.environment import resized, solid_angles

    small = resized(light.astype(np.float32), SOURCE_ROWS)
    brightness = small.mean(2)
    power = (np.maximum(brightness - np.median(brightness), 0) * solid_angles(SOURCE_ROWS)).ravel()
    directions = sphere_directions(SOURCE_ROWS).reshape(-1, 3)

    def lobe(direction: np.ndarray) -> np.ndarray:
        return power * np.exp((directions @ direction - 1) / np.radians(LOBE_DEG) ** 2)

    best = max(directions, key=lambda direction: lobe(direction).sum())
    for _ in range(SHIFTS):
        middle = lobe(best) @ directions
        best = middle / max(np.linalg.norm(middle), 1e-12)
    return best


def source_error_deg(found: np.ndarray, truth: np.ndarray) -> float:
    """Angle between the main sources of two lights."""
    return float(np.degrees(np.arccos(np.clip(main_source(found) @ main_source(truth), -1, 1))))
