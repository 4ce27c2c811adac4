"""`hineus evaluate`: reads the files and says what was done; the measuring is in `stages.evaluation`.

Each function takes a mesh file, a cloud of points or a workspace (its exported PLY, in the frame of its poses), and
returns plain values: the numbers, and under "done" a sentence for each step that a reader must know of to repeat them.
"""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stages.errors import InputError
from stages.evaluation.surfaces import Keep, Sampling, Surface
from stages.evaluation.truths import (
    Cameras,
    read_cameras,
    read_dtu,
    read_glossy,
    read_masks,
    read_matrix,
    read_prediction,
    read_surface,
    read_tanks,
    workspace_cameras,
)

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
    """

    thresholds: tuple[float, ...] = ()
    threshold_parts: tuple[float, ...] = ()
    samples: int | None = None
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


# ---------------------------------------------------------------- surfaces
def evaluate_mesh(predicted: Path, truth: Path, options: MeshOptions) -> dict[str, Any]:
    """A surface against a true one: numbers of `stages.evaluation.surfaces.SurfaceScores`, and what was done.

    Raises:
        InputError: a file cannot be read, or nothing is left to measure.
    """
    from stages.evaluation.surfaces import SAMPLES, measure

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
        sampling = Sampling(options.samples or SAMPLES, options.spacing, options.seed)
        thresholds = [*(part * true.extent for part in options.threshold_parts), *options.thresholds]
        found = measure(ours, true, thresholds or None, sampling, *selections)
    except ValueError as error:
        raise InputError(
            f"{path} cannot be held against {truth}: {error}.", "Are the two in one frame? See `--true-cameras`."
        ) from error
    done += _said(options, cameras, sampling, ours, true)
    return {
        "predicted": str(path),
        "truth": str(truth),
        "unit": "the truth's",
        **found.as_dict(),
        "matrix": matrix.tolist(),
        "done": done,
    }


def _aligned(
    ours: Surface, true: Surface, predicted: Path, options: MeshOptions, cameras: Cameras | None, done: list[str]
) -> tuple[Surface, np.ndarray]:
    """The surface in the truth's frame and the [4, 4] matrix that took it there; what was done is added to `done`."""
    from stages.evaluation.alignment import by_cameras, by_icp

    matrix = np.eye(4)
    if options.matrix is not None:
        matrix = read_matrix(options.matrix)
        done.append(f"alignment: by the matrix of {options.matrix}")
    known = None if cameras is None else _own_cameras(predicted, options.cameras)
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


def _own_cameras(predicted: Path, given: Path | None) -> Cameras | None:
    """Cameras in the prediction's frame: those that were given, or a workspace's own."""
    if given is not None:
        return read_cameras(given)
    return workspace_cameras(predicted) if predicted.is_dir() else None


def _selection(surface: Surface, true: Surface, options: MeshOptions, cameras: Cameras | None) -> Keep | None:
    """What says which of a surface's points count; None: all do."""
    from stages.evaluation import culling

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
    used = true.points if true.faces is None else true.points[np.unique(true.faces)]
    margin = options.box_margin * true.extent
    return np.stack([used.min(0) - margin, used.max(0) + margin])


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


# ---------------------------------------------------------------- benchmarks' own protocols
def evaluate_dtu(predicted: Path, data: Path, scan: int, seed: int = 0) -> dict[str, Any]:
    """Numbers of `stages.evaluation.dtu.DtuScore` and what was done, from `data` in the published layout.

    Args:
        predicted: in the frame of the data set's cameras, mm: as `hineus run --poses cameras_sphere.npz` makes it.
        data: folder with `ObsMask/ObsMask24_10.mat`, `ObsMask/Plane24.mat` and `Points/stl/stl024_total.ply`.

    Raises:
        InputError: a file cannot be read, or nothing is left to measure.
    """
    from stages.evaluation.dtu import DENSITY, MAX_DISTANCE, PATCH, dtu_score

    truth, (path, ours) = read_dtu(data, scan), read_prediction(predicted)
    try:
        found = dtu_score(ours, truth, seed)
    except ValueError as error:
        raise InputError(
            f"{path} cannot be held against scan {scan}: {error}.",
            "Reconstruct with the data set's own poses: `hineus run PHOTOS --poses cameras_sphere.npz`.",
        ) from error
    return {
        "predicted": str(path),
        "truth": str(data),
        "scan": scan,
        "unit": "mm",
        **asdict(found),
        "done": [
            "protocol: DTU, as in DTUeval-python",
            "alignment: none, the frame of the data set's cameras",
            f"sampling: a point each {DENSITY:g} mm, thinned to that in random order, seed {seed}",
            f"cut: {PATCH:g} mm below to {2 * PATCH:g} mm above ObsMask's box, observed cells; scan above the ground",
            f"distances of {MAX_DISTANCE:g} mm and more are left out of both means",
        ],
    }


def evaluate_glossy(predicted: Path, data: Path, split: Path | None = None) -> dict[str, Any]:
    """Numbers of `stages.evaluation.glossy.GlossyScore` and what was done, from an object's folder.

    Args:
        predicted: in the frame of the data set's cameras.
        data: folder with `7.png`, `7-camera.pkl` and `7-depth.png`.
        split: NeRO's `synthetic_split_128.pkl`, which names the test views; None: all views are.

    Raises:
        InputError: a file cannot be read, or nothing is left to measure.
    """
    from stages.evaluation.glossy import VOXEL, glossy_score, visible_points

    truth, (path, ours) = read_glossy(data, split), read_prediction(predicted)
    try:
        found = glossy_score(ours, truth.cameras, visible_points(truth.cameras, truth.depths))
    except ValueError as error:
        raise InputError(
            f"{path} cannot be held against {data}: {error}.",
            f"Reconstruct with the data set's own poses: `hineus run {data} --poses {data}`.",
        ) from error
    views = f"all {len(truth.cameras)} views" if split is None else f"the {len(truth.cameras)} test views of {split}"
    return {
        "predicted": str(path),
        "truth": str(data),
        "unit": "the data set's (the object lies in the unit sphere)",
        **asdict(found),
        "views": len(truth.cameras),
        "done": [
            "protocol: GlossySynthetic, as NeRO's eval_synthetic_shape.py",
            "alignment: none, the frame of the data set's cameras",
            f"points: what {views} see of truth and mesh, thinned to one a cube of {VOXEL:g}",
            "chamfer: mean of the two mean distances",
        ],
    }


def evaluate_tanks(
    predicted: Path,
    data: Path,
    cameras: Path | None = None,
    tau: float | None = None,
    refine: bool = True,
    matrix: Path | None = None,
    seed: int = 0,
) -> dict[str, Any]:
    """Numbers of `stages.evaluation.tanks.TanksScore` and what was done, from a scene's folder.

    Args:
        data: folder with `SCENE.ply`, `SCENE.json` and, to align by cameras, `SCENE_COLMAP_SfM.log` and
            `SCENE_trans.txt`.
        cameras: of the prediction, a file of poses whose photos are numbered from 1; those of a workspace are known.
        tau: metres; None: the toolbox's for this scene.
        refine: follow the toolbox's rounds of ICP.
        matrix: file with 4 x 4 numbers, scan from prediction, instead of the cameras.

    Raises:
        InputError: a file cannot be read, tau is not known, or nothing is left to measure.
    """
    from stages.evaluation.tanks import TAU, tanks_score

    truth, (path, ours) = read_tanks(data), read_prediction(predicted)
    tau = tau or TAU.get(truth.name)
    if tau is None:
        raise InputError(
            f"The scene {truth.name} is none of {', '.join(TAU)}: its tau is not known.", "Say it: `--tau 0.005`."
        )
    start, how = np.eye(4), "none, taken to be in the scan's frame"
    if matrix is not None:
        start, how = read_matrix(matrix), f"by the matrix of {matrix}"
    elif truth.centers is not None and (known := _own_cameras(predicted, cameras)) is not None:
        start, paired = _by_numbers(known, truth.centers, data)
        how = f"similarity by {paired} camera centres of {known.origin} and of the scene's trajectory"
    try:
        found = tanks_score(ours, truth.points, truth.crop, tau, start, refine, seed)
    except ValueError as error:
        raise InputError(
            f"{path} cannot be held against {data}: {error}.", "Align it: see `--cameras` and `--matrix`."
        ) from error
    return {
        "predicted": str(path),
        "truth": str(data),
        "unit": "m",
        **asdict(found),
        "matrix": found.matrix.tolist(),
        "done": [
            "protocol: Tanks and Temples, as its Python toolbox",
            f"alignment: {how}" + (", then three rounds of ICP with scale" if refine else ""),
            f"cut: the crop volume of {truth.name}.json; thinned to one point a cube of {tau / 2:g} m",
            "sampling: "
            + ("the cloud's points" if ours.faces is None else f"four points a square of {tau / 2:g} m, seed {seed}"),
        ],
    }


def _by_numbers(known: Cameras, true_centers: np.ndarray, data: Path) -> tuple[np.ndarray, int]:
    """Scan from prediction [4, 4] by cameras whose photos' names are numbers from 1, and how many were paired."""
    from stages.evaluation.alignment import by_cameras

    numbered = {}
    for stem, center in known.centers.items():
        digits = re.search(r"(\d+)\D*$", stem)
        if digits:
            numbered[str(int(digits[1]) - 1)] = center
    try:
        motion, paired = by_cameras(numbered, {str(i): center for i, center in enumerate(true_centers)})
    except ValueError as error:
        raise InputError(
            f"The cameras of {known.origin} cannot be paired with the {len(true_centers)} of {data}: {error}.",
            "Their photos are numbered from 1 as in the data set (000001.jpg); or align with `--matrix`.",
        ) from error
    return motion.matrix(), paired
