"""The surface that BlendedMVS' rendered depth maps show, as points."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.errors import InputError
from stages.evaluation.suites.blendedmvs import DEPTHS
from stages.posing import mvsnet

STRIDE = 2  # of the pixels that are looked at: all of them would be tens of millions
SPACING = 0.002  # of the extent: near views are not to outvote far ones


def true_points(folder: Path) -> np.ndarray:
    """Points [P, 3] of all depth maps of a scene, in the frame of its cameras, evenly thinned.

    Depth is along the axis, 0 where the model has no surface.

    Raises:
        InputError: the maps show nothing, or cannot be read.
    """
    import open3d as o3d

    parts = []
    for camera in mvsnet.read_mvsnet(folder / mvsnet.CAMERAS).cameras:
        file = folder / DEPTHS / f"{Path(camera.name).stem}.pfm"
        if file.is_file():
            parts.append(_points(_read(file), np.array(camera.params), camera.cam_from_world, camera.size))
    points = np.concatenate(parts) if parts else np.zeros((0, 3))
    if not len(points):
        raise InputError(f"{folder / DEPTHS} shows no surface.", "It needs 00000000.pfm, ... as published.")
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    return np.asarray(cloud.voxel_down_sample(SPACING * float(np.ptp(points, axis=0).max())).points)


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
    import cv2

    depth = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    if depth is None or depth.ndim != 2:
        raise InputError(f"The depth map {file} cannot be read.", "It needs to be a PFM of one channel.")
    return depth
