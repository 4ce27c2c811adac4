"""Masks that the network of `ingest.auto_mask=salient` makes: how good they are, and whether bad ones are told.

python -m benchmarks.auto_masks DATA/synth_plaster ...      a set with true cameras and masks
python -m benchmarks.auto_masks WORKSPACE ...               a run of real photos, done up to `undistort`
python -m benchmarks.auto_masks --table-only                only rewrite the tables of docs/benchmarks/auto-masks.md

Results go to benchmarks/results/auto_masks/NAME.json, where NAME is the folder's.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.pages import NOT_MEASURED, markdown_table
from benchmarks.run_sets import RESULTS as ALL_RESULTS
from benchmarks.run_sets import machine, measure_folders, photos_of
from configs.params import CleanupParams
from stages import artifacts
from stages.geometry.cameras import PinholeCameras

RESULTS = ALL_RESULTS / "auto_masks"
SURFACE_POINTS, TABLE_SIDE = 20_000, 200
TABLE_REACH, BESIDE = 1.5, 0.03  # of the object's extent, which is 1: the table that is looked at
PARTS = (0.15, 0.3, 0.5)  # of the photos, off whose masks a face must lie to be dropped


def measure(folder: Path) -> dict[str, Any]:
    """One set or workspace."""
    import cv2

    from stages.capture.salient import SalientNetwork
    from stages.geometry.silhouettes import agreeing, silhouette_agreement

    known = (folder / "transforms.json").is_file()
    cameras, pictures = _true_set(folder) if known else _workspace(folder)
    network, started = SalientNetwork(), time.process_time()
    masks = [network.mask(cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)) for path in pictures]
    looked, started = time.process_time() - started, time.process_time()
    scores = silhouette_agreement(cameras, masks)
    compared = time.process_time() - started
    result = {
        "name": folder.resolve().name,
        "photos": len(masks),
        "agreement": [None if np.isnan(score) else round(float(score), 3) for score in scores],
        "used": int(agreeing(scores).sum()),
        "network_cpu_s": round(looked, 1),
        "agreement_cpu_s": round(compared, 1),
        "machine": machine(),
    }
    return {**result, **_against_truth(folder, cameras, masks, agreeing(scores))} if known else result


def _true_set(folder: Path) -> tuple[PinholeCameras, list[Path]]:
    from stages.evaluation.reading import read_cameras

    cameras = read_cameras(folder / "transforms.json").pinhole
    return cameras, [photos_of(folder) / Path(name).name for name in cameras.names]


def _workspace(folder: Path) -> tuple[PinholeCameras, list[Path]]:
    undistorted = folder / "undistort"
    cameras = artifacts.FIRST_SCENE.load(undistorted).cameras
    return cameras, [artifacts.PINHOLE_PHOTOS.load(undistorted).path(name) for name in cameras.names]


def _against_truth(
    folder: Path, cameras: PinholeCameras, masks: Sequence[np.ndarray | None], used: np.ndarray
) -> dict[str, Any]:
    """IoU with the true masks; what the masks in use, and the true ones, cut off the object and leave of the table."""
    from stages.evaluation.reading import read_masks

    truth = [mask for _, mask in read_masks(folder / "masks", cameras)]
    ious = [
        0.0 if mask is None else float((mask & true).sum() / (mask | true).sum())
        for mask, true in zip(masks, truth, strict=True)
    ]
    # a set whose masks are not used is cut by none; what all of them would do shows why
    guesses = [(i, m) for i, m in enumerate(masks) if m is not None and (used[i] or not used.any())]
    return {
        "iou": [round(iou, 3) for iou in ious],
        "cut": _cut(folder / "gt_mesh.ply", cameras, guesses),
        "cut_by_truth": _cut(folder / "gt_mesh.ply", cameras, list(enumerate(truth))),
    }


def _cut(mesh: Path, cameras: PinholeCameras, masks: Sequence[tuple[int, np.ndarray]]) -> list[list[float]]:
    """Percent of the object's surface that is cut off and of the table beside it that is left, for each of `PARTS`."""
    import trimesh
    from scipy.spatial import cKDTree

    from stages.surface.selection import outside_hull, widened

    surface = np.asarray(trimesh.sample.sample_surface(trimesh.load(mesh, process=False), SURFACE_POINTS, seed=0)[0])
    side = np.linspace(-TABLE_REACH, TABLE_REACH, TABLE_SIDE)
    table = np.stack([*np.meshgrid(side, side), np.zeros((TABLE_SIDE, TABLE_SIDE))], -1).reshape(-1, 3)
    table += [*surface.mean(0)[:2], 0]
    table = table[cKDTree(surface[:, :2]).query(table[:, :2])[0] > BESIDE]
    margin = CleanupParams().mask_margin
    grown = [(i, widened(mask, margin)) for i, mask in masks]
    return [
        [
            round(100 * float(outside_hull(surface, cameras, grown, part).mean()), 2),
            round(100 * float((~outside_hull(table, cameras, grown, part)).mean()), 2),
        ]
        for part in PARTS
    ]


def agreement_table(results: Sequence[dict[str, Any]]) -> str:
    """A row a set: do the masks agree, and are those that do the good ones?"""
    from stages.geometry.silhouettes import MIN_IOU

    rows = []
    for result in results:
        scores = np.array([np.nan if score is None else score for score in result["agreement"]])
        fit, cells = scores >= MIN_IOU, ["-"] * 3
        if "iou" in result:
            ious = np.array(result["iou"])
            extremes = (ious[fit].min() if fit.any() else None, ious[~fit].max() if not fit.all() else None)
            cells = [f"{np.median(ious):.2f}", *("-" if value is None else f"{value:.2f}" for value in extremes)]
        cost = (result["network_cpu_s"] + result["agreement_cpu_s"]) / result["photos"]
        row = [result["name"], str(result["photos"]), str(fit.sum()), str(result["used"]), *cells, f"{cost:.2f}"]
        rows.append(row)
    header = ["set", "photos", "masks that fit", "used", "true IoU: median", "least that fits", "best that does not"]
    return markdown_table([*header, "CPU s a photo"], rows)


def cut_table(results: Sequence[dict[str, Any]]) -> str:
    """A row a set and kind of mask: what is lost of the object, what is left of the table."""
    rows = []
    for result in results:
        for key, what in (("cut", "made" if result["used"] else "made, all of them"), ("cut_by_truth", "true")):
            if key in result:
                cells = [f"{lost:.1f} / {left:.1f}" for lost, left in result[key]]
                rows.append([f"{result['name']}, {what}", *cells])
    return markdown_table(["set, masks", *(f"off in {part:.0%} of the photos" for part in PARTS)], rows)


def load_results() -> list[dict[str, Any]]:
    """All results, by name."""
    return [artifacts.read_json(path) for path in sorted(RESULTS.glob("*.json"))]


def tables() -> dict[str, str]:
    """Both tables, from the result files."""
    results = load_results()
    made = {"auto-masks": agreement_table(results), "auto-masks-cut": cut_table(results)}
    return made if results else dict.fromkeys(made, NOT_MEASURED)


def main() -> int:
    return measure_folders(__doc__, "sets with true cameras, or workspaces", "masks", RESULTS, measure, tables)


if __name__ == "__main__":
    sys.exit(main())
