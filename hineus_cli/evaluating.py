"""`hineus evaluate`: reads the files and says what was done; the measuring is in `stages.evaluation`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any


@dataclass(frozen=True)
class MeshOptions:
    """How a mesh is held against the truth.

    Attributes:
        thresholds: of the F-scores, in the truth's unit; empty: parts of its extent.
        samples, spacing, seed: see `stages.evaluation.surfaces.Sampling`.
        icp: "rigid", "similarity" or None.
        matrix: file with 4 x 4 numbers, truth from prediction, or None.
        poses, true_poses: files of cameras; by their centres the prediction is aligned, where both are given.
        visible: only what a camera of `true_poses` sees counts.
        masks: folder of masks named like the photos of `true_poses`, or None.
        box: lowest and highest corner, or None.
    """

    thresholds: tuple[float, ...] = ()
    samples: int | None = None
    spacing: float | None = None
    seed: int = 0
    icp: str | None = None
    matrix: Path | None = None
    poses: Path | None = None
    true_poses: Path | None = None
    visible: bool = False
    masks: Path | None = None
    box: tuple[float, ...] | None = None


def evaluate_mesh(predicted: Path, truth: Path, options: MeshOptions) -> dict[str, Any]:
    """A mesh, cloud or workspace against a true mesh or cloud; numbers of `SurfaceScores` and what was done."""
    raise NotImplementedError


def evaluate_dtu(predicted: Path, data: Path, scan: int) -> dict[str, Any]:
    """Numbers of `DtuScore` and what was done, from `data` in the published layout:

    `ObsMask/ObsMask{scan}_10.mat`, `ObsMask/Plane{scan}.mat`, `Points/stl/stl{scan:03}_total.ply`.
    """
    raise NotImplementedError


def evaluate_glossy(predicted: Path, data: Path, split: Path | None = None) -> dict[str, Any]:
    """Numbers of `GlossyScore` and what was done, from an object's folder with `7.png`, `7-camera.pkl`, `7-depth.png`.

    Args:
        split: NeRO's `synthetic_split_128.pkl`; None: all views are test views, unless there is `eval_pts.ply`.
    """
    raise NotImplementedError


def evaluate_tanks(
    predicted: Path, data: Path, poses: Path | None = None, tau: float | None = None, refine: bool = True
) -> dict[str, Any]:
    """Numbers of `TanksScore` and what was done, from a scene's folder in the published layout:

    `SCENE.ply`, `SCENE.json`, and, where `poses` are given, `SCENE_COLMAP_SfM.log` and `SCENE_trans.txt`.
    """
    raise NotImplementedError


def evaluate_views(workspace: Path, renders: Path | None = None, device: str = "cpu") -> dict[str, Any]:
    """The held-out photos of a workspace against drawings of the field and of the final mesh.

    Returns:
        {"photos": [{"name", "pixels", "field": {"object": ImageScore or None, "whole": ..}, "mesh": {..}}],
        "mean": {"field": {"object": {"psnr", "ssim", "lpips"}, "whole": ..}, "mesh": {..}}, "counted", "lpips"}:
        "object" is the photo's mask, or the mesh's silhouette where there is none; "whole" the whole photo, on white
        where there is a mask; None where it cannot be said.

    Raises:
        InputError: the workspace holds no photos back, or a stage is missing.
    """
    raise NotImplementedError
