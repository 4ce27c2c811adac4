"""Whether the region's border cuts what the photos are about, as the mesh shows it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.geometry.attention import MIN_LOOKING
from stages.geometry.cameras import PinholeCameras
from stages.geometry.plane import Plane
from stages.geometry.region import merged_spheres
from stages.surface.triangle_mesh import raycaster, vertex_normals

# A mesh that reaches this close to the border of the region (the unit sphere) is cut there.
NEAR_BORDER = 0.93
# The middle of a photo: this part of its width and height.
MIDDLE = 0.5
# The border cuts where this part of the photos have it in their middle. What a subject stands on or hangs at goes on
# beyond the border everywhere, but lies in the middle of few photos.
MANY_PHOTOS = 0.2
# The ground goes on, too: what is not this high above it (in radii of the region) does not count.
ABOVE_GROUND = 0.06
# What is cut goes on for about this many radii of the region.
GROWTH = 0.5
# So many places along the border are looked at; fewer than this part of them may be wrong.
MAX_PLACES, MIN_CUT, MAX_MERGED = 1500, 0.01, 100


@dataclass(frozen=True)
class BorderCut:
    """Where the region's border cuts a subject.

    Attributes:
        places: [K, 3] on the mesh near the border, scene frame.
        photos: number of photos with most of them in the middle.
    """

    places: np.ndarray
    photos: int


def border_cut(
    vertices: np.ndarray, faces: np.ndarray, cameras: PinholeCameras, ground: Plane | None
) -> BorderCut | None:
    """Where a mesh of the scene ends at the region's border in the middle of many photos; None: nowhere."""
    near = np.linalg.norm(vertices, axis=1) > NEAR_BORDER
    if ground is not None:
        near &= ground.heights(vertices) > ABOVE_GROUND
    rows = np.flatnonzero(near)
    rows = rows[:: max(1, -(-len(rows) // MAX_PLACES))]
    if not len(rows):
        return None
    views = _in_the_middle(vertices, faces, rows, cameras)
    cut = views.sum(1) >= max(MIN_LOOKING, MANY_PHOTOS * len(cameras))
    if cut.sum() <= MIN_CUT * MAX_PLACES:
        return None
    return BorderCut(vertices[rows[cut]], int((views[cut].mean(0) > 0.5).sum()))


def region_without_cut(cut: BorderCut) -> tuple[np.ndarray, float]:
    """Centre [3] and radius, in the frame of the region, of the smallest one that goes on wherever this one cuts."""
    sphere = np.zeros(3), 1.0
    for place in cut.places[:: max(1, len(cut.places) // MAX_MERGED)].astype(np.float64):
        sphere = merged_spheres(sphere, (place / np.linalg.norm(place), GROWTH))
    return sphere


def _in_the_middle(vertices: np.ndarray, faces: np.ndarray, rows: np.ndarray, cameras: PinholeCameras) -> np.ndarray:
    """Which cameras [N] see which of the vertices `rows` [K] in the middle of their photo; [K, N] bool."""
    import open3d as o3d

    scene = raycaster(vertices, faces)
    places, normals = vertices[rows].astype(np.float64), vertex_normals(vertices, faces)[rows]
    seen = np.zeros((len(rows), len(cameras)), dtype=bool)
    for i, center in enumerate(cameras.centers):
        pixels, depth = cameras.project(i, places)
        off = 2 * np.abs(pixels / cameras.sizes[i] - 0.5).max(1)
        chosen = np.flatnonzero((depth > 0) & (off < MIDDLE) & (((center - places) * normals).sum(1) > 0))
        # From the camera: at 1 it meets the place itself.
        rays = np.concatenate([np.broadcast_to(center, (len(chosen), 3)), places[chosen] - center], axis=1)
        hidden = scene.test_occlusions(o3d.core.Tensor(rays.astype(np.float32)), tnear=0.0, tfar=0.98).numpy()
        seen[chosen[~hidden], i] = True
    return seen
