"""Any surface against any true one: which points count, how the two are aligned, and a sentence for each step.

What is judged is a mesh file, a cloud of points or a workspace (its exported PLY, in the frame of its poses). What
comes back are plain values: the numbers, and under "done" what a reader must know of to repeat them.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stages.errors import InputError
from stages.evaluation import culling
from stages.evaluation.alignment import by_cameras, by_icp
from stages.evaluation.distance_map import write_distance_map
from stages.evaluation.reading import (
    Cameras,
    own_cameras,
    read_cameras,
    read_masks,
    read_matrix,
    read_prediction,
    read_surface,
)
from stages.evaluation.surfaces import SAMPLES, Keep, Sampling, Surface, Target, measure

MOTIONS = ("rigid", "similarity")


@dataclass(frozen=True)
class MeshOptions:
    """How a surface is held against the truth.

    Attributes:
        thresholds, threshold_parts: of the F-scores, in the truth's unit and as parts of its extent; both empty: as
            `stages.evaluation.surfaces.DEFAULT_THRESHOLDS`.
        samples, spacing, seed: see `stages.evaluation.surfaces.Sampling`.
        matrix: file with 4 x 4 numbers, truth from prediction.
        cameras: of the prediction, a file of poses; those of a workspace are known.
        true_cameras: of the truth, a file of poses. The prediction is aligned by the centres of the two.
        icp: "rigid" or "similarity", after the other alignments.
        visible: only what one of `true_cameras` sees counts.
        masks: folder of masks named like the photos of `true_cameras`: what lies beside them does not count.
        grow: pixels by which masks are widened first.
        box: lowest and highest corner of what counts, in the truth's frame; or the truth's own box, grown by
            `box_margin` of its extent.
        distance_map: PLY to write: the prediction, aligned, coloured by its distance to the truth.
    """

    thresholds: tuple[float, ...] = ()
    threshold_parts: tuple[float, ...] = ()
    samples: int = SAMPLES
    spacing: float | None = None
    seed: int = 0
    matrix: Path | None = None
    cameras: Path | None = None
    true_cameras: Path | None = None
    icp: str | None = None
    visible: bool = False
    masks: Path | None = None
    grow: int = 0
    box: tuple[float, ...] | None = None
    box_margin: float | None = None
    distance_map: Path | None = None


def evaluate_mesh(predicted: Path, truth: Path, options: MeshOptions) -> dict[str, Any]:
    """A surface against a true one: numbers of `stages.evaluation.surfaces.SurfaceScores`, and what was done.

    Raises:
        InputError: a file cannot be read or written, or nothing is left to measure.
    """
    (path, ours), true = read_prediction(predicted), read_surface(truth)
    if (options.visible or options.masks) and options.true_cameras is None:
        raise InputError(
            "Nothing says where the photos were taken from.", "Name the truth's cameras with `--true-cameras`."
        )
    cameras = None if options.true_cameras is None else read_cameras(options.true_cameras)
    done: list[str] = []
    try:
        ours, matrix = _aligned(ours, true, predicted, options, cameras, done)
        selections = [_selection(each, true, options, cameras) for each in (ours, true)]
        sampling = Sampling(options.samples, options.spacing, options.seed)
        thresholds = [*(part * true.extent for part in options.threshold_parts), *options.thresholds]
        found = measure(ours, true, thresholds or None, sampling, *selections)
    except ValueError as error:
        raise InputError(
            f"{path} cannot be held against {truth}: {error}.", "Are the two in one frame? See `--true-cameras`."
        ) from error
    done += _said(options, cameras, sampling, ours, true)
    if options.distance_map is not None:
        write_distance_map(options.distance_map, ours, Target(true).nearest(ours.points).distances, found.accuracy.p95)
        done.append(f"map: {options.distance_map}, red is {found.accuracy.p95:.5g} and more")
    return {
        "predicted": str(path),
        "truth": str(truth),
        "unit": "the truth's",
        **asdict(found),
        "matrix": matrix.tolist(),
        "done": done,
    }


def _aligned(
    ours: Surface, true: Surface, predicted: Path, options: MeshOptions, cameras: Cameras | None, done: list[str]
) -> tuple[Surface, np.ndarray]:
    """The surface in the truth's frame and the [4, 4] matrix that took it there; what was done is added to `done`."""
    matrix = np.eye(4)
    if options.matrix is not None:
        matrix = read_matrix(options.matrix)
        done.append(f"alignment: by the matrix of {options.matrix}")
    known = None if cameras is None else own_cameras(predicted, options.cameras)
    if cameras is not None and known is not None:
        centers = {name: matrix[:3, :3] @ center + matrix[:3, 3] for name, center in known.centers.items()}
        motion, paired = by_cameras(centers, cameras.centers)
        matrix = motion.matrix() @ matrix
        done.append(f"alignment: similarity by {paired} camera centres of {known.origin} and {cameras.origin}")
    ours = ours.moved(matrix)
    if options.icp is not None:
        counted = _selection(ours, true, options, cameras)
        motion = by_icp(ours, true, options.icp == "similarity", counted)
        ours, matrix = ours.moved(motion.matrix()), motion.matrix() @ matrix
        done.append(f"alignment: {options.icp} point-to-plane ICP of what counts, on the nearest 90 % of pairs")
    if not done:
        done.append("alignment: none, taken to be in one frame")
    return ours, matrix


def _selection(surface: Surface, true: Surface, options: MeshOptions, cameras: Cameras | None) -> Keep | None:
    """What says which of a surface's points count; None: all do."""
    keeps: list[Keep] = []
    box = _box(true, options)
    if box is not None:
        keeps.append(lambda points: culling.inside_box(points, box))
    if cameras is not None and options.masks is not None:
        masks = list(read_masks(options.masks, cameras.pinhole))
        keeps.append(lambda points: culling.inside_masks(points, cameras.pinhole, masks, options.grow))
    if cameras is not None and options.visible:
        occluder = None if surface.faces is None else (surface.points, surface.faces)
        keeps.append(lambda points: culling.seen(points, cameras.pinhole, occluder))

    def all_of(points: np.ndarray) -> np.ndarray:
        kept = np.ones(len(points), dtype=bool)
        for keep in keeps:
            if kept.any():
                kept[kept] = keep(points[kept])
        return kept

    return all_of if keeps else None


def _box(true: Surface, options: MeshOptions) -> np.ndarray | None:
    """[2, 3] or None."""
    if options.box is not None:
        return np.array(options.box, dtype=np.float64).reshape(2, 3)
    if options.box_margin is None:
        return None
    margin = options.box_margin * true.extent
    return true.box + np.array([[-margin], [margin]])


def _said(options: MeshOptions, cameras: Cameras | None, sampling: Sampling, ours: Surface, true: Surface) -> list[str]:
    """A sentence for each thing that was done to get the numbers."""
    said = []
    for name, surface in (("prediction", ours), ("truth", true)):
        if surface.faces is not None:
            size, how = f"mesh of {len(surface.faces)} faces", f"{sampling.count} points, uniform by area"
            if sampling.spacing is not None:
                how = f"one point a square of {sampling.spacing:g}, uniform by area"
        else:
            size, how = f"cloud of {len(surface.points)} points", f"at most {sampling.count} of them"
            if sampling.spacing is not None:
                how = f"one a cube of {sampling.spacing:g}"
        said.append(f"{name}: {size}, {how}, seed {sampling.seed}")
    box = _box(true, options)
    if box is not None:
        corners = " to ".join(" ".join(f"{value:.6g}" for value in corner) for corner in box)
        said.append(f"cut: only what lies in the box {corners} counts, of both")
    if cameras is not None and options.masks is not None:
        said.append(f"cut: what a photo shows beside its mask ({options.masks}, + {options.grow} px) counts on no side")
    if cameras is not None and options.visible:
        hidden = "each hides itself" if ours.faces is not None and true.faces is not None else "a cloud hides nothing"
        said.append(f"cut: only what one of {len(cameras.pinhole)} cameras of {cameras.origin} sees counts, {hidden}")
    if cameras is not None and cameras.distorted:
        said.append(f"cameras: the distortion of {cameras.distorted} is left out")
    said.append("chamfer: mean of the two mean distances (not squared); chamfer_sum: their sum")
    return said
