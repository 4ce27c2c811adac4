"""What is on a surface, seen from a place and without any light: by letting the surface shine with it."""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.synthetic.mitsuba_camera import pinhole

EMPTY = 1e-3  # coverage of a pixel below which there is nothing to say of it


def shining(shape: dict[str, Any], values: dict[str, Any]) -> dict[str, Any]:
    """A shape of Mitsuba that sends out three `values`, a texture or a colour, and reflects nothing."""
    dark = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    return {**shape, "bsdf": dark, "emitter": {"type": "area", "radiance": values}}


def numbers(*three: float) -> dict[str, Any]:
    """The same three numbers everywhere."""
    return {"type": "rgb", "value": list(three)}


def seen(mi: Any, scene: Any, cam_from_world: np.ndarray, focal: float, size: tuple[int, int], spp: int) -> np.ndarray:
    """What shines [H, W, 3], the mean over each pixel; 0 where nothing is."""
    integrator = mi.load_dict({"type": "path", "max_depth": 1})
    sensor = pinhole(mi, cam_from_world, focal, size, spp)
    return np.array(mi.render(scene, sensor=sensor, integrator=integrator, spp=spp, seed=0), dtype=np.float32)


def of_covered(values: np.ndarray, coverage: np.ndarray) -> np.ndarray:
    """Values [H, W, C] or [H, W] of the covered share of each pixel [H, W]; 0 where there is none."""
    share = coverage if values.ndim == 2 else coverage[..., None]
    return np.where(share > EMPTY, values / np.maximum(share, EMPTY), 0).astype(np.float32)
