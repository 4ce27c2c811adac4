"""GlossySynthetic's evaluation, as NeRO's `eval_synthetic_shape.py` has it (Liu et al. 2023).

Truth and prediction are both what the test cameras see: depth maps turned into points, thinned to one a cube of
`VOXEL`. The number is the mean of the mean distances both ways; the object lies in the unit sphere.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stages.drawing.rasterizing import depth_map
from stages.errors import InputError
from stages.evaluation.reading import read_cameras, read_prediction
from stages.evaluation.surfaces import Surface, measure_points
from stages.evaluation.thinning import one_a_cube
from stages.geometry.cameras import PinholeCameras
from stages.inputs.depth import DEPTH, read_depth
from stages.posing import nero
from stages.posing.known import reading

VOXEL = 0.01


@dataclass(frozen=True)
class GlossyScore:
    """In the data set's unit: the object lies in the unit sphere.

    Attributes:
        accuracy: mean distance from the predicted to the true points.
        completeness: mean distance from the true to the predicted points.
        chamfer: mean of the two, the number in papers' tables.
        predicted_points, true_points: how many.
    """

    accuracy: float
    completeness: float
    chamfer: float
    predicted_points: int
    true_points: int


def visible_points(cameras: PinholeCameras, depths: Iterable[np.ndarray]) -> np.ndarray:
    """Points [P, 3] of depth maps [H, W] (along the axis; 0 or infinite: nothing there), one a camera, thinned.

    As NeRO does, pixel (x, y) stands for the place (x, y) and not for its centre (x + .5, y + .5): half a pixel off,
    the same for truth and prediction.
    """
    found = []
    for i, depth in enumerate(depths):
        rows, columns = np.nonzero(np.isfinite(depth) & (depth > 0))
        found.append(cameras.unproject(i, np.stack([columns, rows], 1).astype(float), depth[rows, columns]))
    points = np.concatenate(found)
    return one_a_cube(points, VOXEL)


def glossy_score(predicted: Surface, cameras: PinholeCameras, true_points: np.ndarray) -> GlossyScore:
    """Hold a mesh against the true points [P, 3] of `visible_points`.

    Args:
        predicted: a mesh in the data set's frame; its depth is drawn from the cameras.

    Raises:
        ValueError: it has no faces, or no camera sees it.
    """
    if predicted.faces is None:
        raise ValueError(f"a mesh is expected, got {len(predicted.points)} points and no faces")
    vertices, faces = predicted.points, predicted.faces
    points = visible_points(cameras, (drawn_depth(cameras, i, vertices, faces) for i in range(len(cameras))))
    if not len(points):
        raise ValueError(f"none of {len(cameras)} cameras sees the mesh; is it in their frame?")
    ours, true = Surface(points), Surface(true_points)
    found = measure_points(ours, true, ours, true)
    return GlossyScore(
        found.accuracy.mean, found.completeness.mean, found.chamfer, found.accuracy.points, found.completeness.points
    )


def drawn_depth(cameras: PinholeCameras, index: int, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Depth [H, W] of a mesh along a camera's axis, infinite where there is none."""
    _, inverse = depth_map(cameras, index, vertices, faces)
    return np.divide(1.0, inverse, out=np.full(inverse.shape, np.inf), where=inverse > 0)


# ---------------------------------------------------------------- files
def evaluate_glossy(predicted: Path, data: Path, split: Path | None = None) -> dict[str, Any]:
    """Numbers of `GlossyScore` and what was done, from an object's folder.

    Args:
        predicted: in the frame of the data set's cameras.
        data: folder with `7.png`, `7-camera.pkl` and `7-depth.png`.
        split: NeRO's `synthetic_split_128.pkl`, which names the test views; None: all views are.

    Raises:
        InputError: a file cannot be read, or nothing is left to measure.
    """
    (cameras, depths), (path, ours) = read_glossy(data, split), read_prediction(predicted)
    try:
        found = glossy_score(ours, cameras, visible_points(cameras, depths))
    except ValueError as error:
        raise InputError(
            f"{path} cannot be held against {data}: {error}.",
            f"Reconstruct with the data set's own poses: `hineus run {data} --poses {data}`.",
        ) from error
    views = f"all {len(cameras)} views" if split is None else f"the {len(cameras)} test views of {split}"
    return {
        "predicted": str(path),
        "truth": str(data),
        "unit": "the data set's (the object lies in the unit sphere)",
        **asdict(found),
        "views": len(cameras),
        "done": [
            "protocol: GlossySynthetic, as NeRO's eval_synthetic_shape.py",
            "alignment: none, the frame of the data set's cameras",
            f"points: what {views} see of truth and mesh, thinned to one a cube of {VOXEL:g}",
            "chamfer: mean of the two mean distances",
        ],
    }


def read_glossy(data: Path, split: Path | None) -> tuple[PinholeCameras, list[np.ndarray]]:
    """Cameras of an object's test views (all without a split), and the depth of each, [H, W], infinite off the object.

    Raises:
        InputError: cameras or depth images are missing or cannot be read.
    """
    if not data.is_dir() or not nero.has_cameras(data):
        raise InputError(
            f"{data} holds no *{nero.CAMERA}.", "`--data` takes an object's folder of GlossySynthetic, e.g. `bell`."
        )
    found = read_cameras(data).pinhole
    stems = [Path(name).stem for name in found.names]
    wanted = stems if split is None else nero.read_split(split)
    missing = [stem for stem in wanted if stem not in stems or not (data / f"{stem}{DEPTH}").is_file()]
    if missing or not wanted:
        raise InputError(
            f"{len(missing)} of {len(wanted)} views have no camera or no depth in {data}, e.g. "
            f"{(missing or ['-'])[0]}{DEPTH}.",
            "Unpack GlossySynthetic again, or name the split that belongs to it.",
        )
    cameras = found.select([stems.index(stem) for stem in wanted])
    with reading(f"A depth image in {data}", "16 bits a pixel"):
        return cameras, [read_depth(data / f"{stem}{DEPTH}") for stem in wanted]
