"""Whether the region's border cuts what the photos are about, as the mesh shows it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from stages.geometry.attention import MIN_LOOKING, NEAR_QUANTILE
from stages.geometry.cameras import PinholeCameras
from stages.geometry.plane import Plane
from stages.geometry.region import merged_spheres
from stages.surface.triangle_mesh import raycaster, vertex_normals

# A mesh that reaches this close to the border of the region (the unit sphere) is cut there.
NEAR_BORDER = 0.93
# The middle of a photo: this part of its width and height.
MIDDLE = 0.5
# The border cuts where this part of the photos have it in their middle, and not behind what they are about: a wall goes
# on beyond the border, too, and slanting photos have its far side in their middle. What is nearest in the middle is as
# far away as `NEAR_QUANTILE` of it; background is farther by this factor.
MANY_PHOTOS, MAX_BEHIND = 0.1, 1.4
RAYS = 12  # across the middle, to look how far that is
# The ground goes on, too: what is not this high above it (in radii of the region) does not count.
ABOVE_GROUND = 0.06
# What is cut goes on for about this many radii of the region.
GROWTH = 0.5
# So many places along the border are looked at; so few that seem to be cut may be wrong.
MAX_PLACES, MAX_WRONG, MAX_MERGED = 1500, 30, 100
# A photo shows the cut if it shows this part of the places: the far side of a subject is always hidden.
MIN_SHOWN = 0.1


@dataclass(frozen=True)
class BorderCut:
    """Where the region's border cuts a subject.

    Attributes:
        places: [K, 3] on the mesh near the border, scene frame.
        photos: number of photos with some of them in the middle.
    """

    places: np.ndarray
    photos: int


def border_cut(
    vertices: np.ndarray, faces: np.ndarray, cameras: PinholeCameras, ground: Plane | None
) -> BorderCut | None:
    """Where a mesh of the scene ends at the region's border in the middle of many photos; None: nowhere."""
    rows = np.flatnonzero(off_ground(vertices, faces, ground) & (np.linalg.norm(vertices, axis=1) > NEAR_BORDER))
    rows = rows[:: max(1, -(-len(rows) // MAX_PLACES))]
    if not len(rows):
        return None
    views = _in_the_middle(vertices, faces, rows, cameras)
    cut = views.sum(1) >= max(MIN_LOOKING, MANY_PHOTOS * len(cameras))
    if cut.sum() <= MAX_WRONG:
        return None
    return BorderCut(vertices[rows[cut]], int((views[cut].mean(0) > MIN_SHOWN).sum()))


def off_ground(vertices: np.ndarray, faces: np.ndarray, ground: Plane | None) -> np.ndarray:
    """Which vertices [V] bool are of the surface, that is of a face, and not of the ground."""
    surface = np.zeros(len(vertices), dtype=bool)
    surface[faces] = True
    if ground is not None:
        surface &= ground.heights(vertices) > ABOVE_GROUND
    return surface


def region_without_cut(cut: BorderCut) -> tuple[np.ndarray, float]:
    """Centre [3] and radius, in the frame of the region, of the smallest one that goes on wherever this one cuts."""
    sphere = np.zeros(3), 1.0
    for place in cut.places[:: max(1, len(cut.places) // MAX_MERGED)].astype(np.float64):
        sphere = merged_spheres(sphere, (place / np.linalg.norm(place), GROWTH))
    return sphere


def _in_the_middle(vertices: np.ndarray, faces: np.ndarray, rows: np.ndarray, cameras: PinholeCameras) -> np.ndarray:
    """Which cameras [N] have which of the vertices `rows` [K] in the middle of their photo, not far behind; [K, N]."""
    import open3d as o3d

    scene = raycaster(vertices, faces)
    places, normals = vertices[rows].astype(np.float64), vertex_normals(vertices, faces)[rows]
    seen = np.zeros((len(rows), len(cameras)), dtype=bool)
    for i, center in enumerate(cameras.centers):
        pixels, depth = cameras.project(i, places)
        off = 2 * np.abs(pixels / cameras.sizes[i] - 0.5).max(1)
        here = (depth > 0) & (depth < MAX_BEHIND * _near_depth(scene, cameras, i)) & (off < MIDDLE)
        chosen = np.flatnonzero(here & (((center - places) * normals).sum(1) > 0))
        # From the camera: at 1 it meets the place itself.
        rays = np.concatenate([np.broadcast_to(center, (len(chosen), 3)), places[chosen] - center], axis=1)
        hidden = scene.test_occlusions(o3d.core.Tensor(rays.astype(np.float32)), tnear=0.0, tfar=0.98).numpy()
        seen[chosen[~hidden], i] = True
    return seen


def _near_depth(scene: Any, cameras: PinholeCameras, index: int) -> float:
    """Depth of what is nearest in the middle of a photo; infinite where there is nothing."""
    import open3d as o3d

    across = 0.5 + MIDDLE * (np.linspace(0, 1, RAYS) - 0.5)
    pixels = np.stack(np.meshgrid(across, across), -1).reshape(-1, 2) * cameras.sizes[index]
    origins, directions = cameras.rays(index, pixels)
    rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
    depth = scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy() * (directions @ cameras.forward[index])
    met = np.isfinite(depth)
    return float(np.quantile(depth[met], NEAR_QUANTILE)) if met.any() else np.inf
