"""BlendedMVS (Yao et al. 2020): its makers published no program to score surfaces.

The truth is what its rendered depth maps show, as points. Plain distances and F-scores, at thresholds of our own; they
are parts of the true surface's extent, as its scenes have no unit.
"""

from __future__ import annotations

import re
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from stages.errors import InputError
from stages.evaluation.reading import read_surface
from stages.evaluation.surfaces import Sampling, Surface, SurfaceScores, measure
from stages.evaluation.thinning import one_a_cube
from stages.inputs.bounded import read_bytes, reason
from stages.posing import mvsnet

DEPTHS = "rendered_depth_maps"
THRESHOLDS = (0.005, 0.01, 0.02)  # of the truth's extent
STRIDE = 2  # of the pixels that are looked at: all of them would be tens of millions
PFM = re.compile(rb"Pf\s(\d{1,6})\s(\d{1,6})\s(-?)[\d.]+\s")  # width, height; minus: little-endian
MOST_BYTES = 1 << 30
SPACING = 0.002  # of the extent: near views are not to outvote far ones


def evaluate_blended(predicted: Path, data: Path) -> dict[str, Any]:
    """Numbers of `SurfaceScores`, and Chamfer in percent of the extent, of a mesh in the frame of the scene's cameras.

    Raises:
        InputError: a file cannot be read.
        ValueError: the mesh has no area.
    """
    scores = blended_score(read_surface(predicted), Surface(true_points(data)))
    return {**asdict(scores), "chamfer_percent": 100 * scores.chamfer / scores.extent}


def blended_score(predicted: Surface, truth: Surface, sampling: Sampling | None = None) -> SurfaceScores:
    """Hold a surface against a scene of BlendedMVS, in its frame. Raises ValueError as `measure` does."""
    return measure(predicted, truth, [part * truth.extent for part in THRESHOLDS], sampling)


# ---------------------------------------------------------------- the truth
def true_points(folder: Path) -> np.ndarray:
    """Points [P, 3] of all depth maps of a scene, in the frame of its cameras, evenly thinned.

    Depth is along the axis, 0 where the model has no surface.

    Raises:
        InputError: the maps show nothing, or cannot be read.
    """
    parts = []
    for camera in mvsnet.read_mvsnet(folder / mvsnet.CAMERAS).cameras:
        file = folder / DEPTHS / f"{Path(camera.name).stem}.pfm"
        if file.is_file():
            parts.append(_points(_read(file), np.array(camera.params), camera.cam_from_world, camera.size))
    points = np.concatenate(parts) if parts else np.zeros((0, 3))
    if not len(points):
        raise InputError(f"{folder / DEPTHS} shows no surface.", "It needs 00000000.pfm, ... as published.")
    return one_a_cube(points, SPACING * float(np.ptp(points, axis=0).max()))


def _points(depth: np.ndarray, params: np.ndarray, cam_from_world: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """World points [P, 3] of a depth map [H, W], which may be smaller than the image of `size`."""
    height, width = depth.shape
    y, x = np.mgrid[STRIDE // 2 : height : STRIDE, STRIDE // 2 : width : STRIDE]
    z = depth[y, x]
    seen = np.isfinite(z) & (z > 0)
    u, v = (x[seen] + 0.5) * size[0] / width, (y[seen] + 0.5) * size[1] / height
    rays = np.stack([(u - params[2]) / params[0], (v - params[3]) / params[1], np.ones_like(u)], 1)
    in_cam = rays * z[seen][:, None]
    return (in_cam - cam_from_world[:, 3]) @ cam_from_world[:, :3]


def _read(file: Path) -> np.ndarray:
    """A depth map [H, W] float32.

    Raises:
        InputError: it is no PFM of one channel, or has fewer bytes than it says.
    """
    try:
        data = read_bytes(file, MOST_BYTES)
        head = PFM.match(data)
        if head is None:
            raise ValueError("it is no PFM of one channel")
        width, height, kind = int(head[1]), int(head[2]), "<f4" if head[3] else ">f4"
        if not 0 < 4 * width * height <= len(data) - head.end():
            raise ValueError(f"it has {len(data) - head.end()} bytes for {width} x {height} numbers")
    except (OSError, ValueError) as error:
        raise InputError(f"The depth map {file} cannot be read ({reason(error)}).", "Copy it again.") from error
    depth = np.frombuffer(data, kind, width * height, head.end()).reshape(height, width)
    return depth[::-1].astype(np.float32)  # its first row is the lowest
