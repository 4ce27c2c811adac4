"""How large a texture the photos can fill: from what a pixel covers of the surface."""

from __future__ import annotations

import numpy as np

from stages.drawing.rasterizing import NO_FACE, depth_map
from stages.geometry.cameras import PinholeCameras
from stages.surface.triangle_mesh import face_normals

SMALLEST, LARGEST = 1024, 8192
# A texture this much too small (of its side) is still preferred to one of twice the side.
SHORT_OF = 0.15


def pixels_per_area(vertices: np.ndarray, faces: np.ndarray, cameras: PinholeCameras) -> tuple[np.ndarray, np.ndarray]:
    """Pixels that the best view spends on a unit of each face's area [F], 0 where none shows it; the areas [F].

    focal^2 cos(angle) / depth^2 at the face's centre, for the faces that a camera's depth map shows.
    """
    centers = vertices[faces].astype(np.float64).mean(1)
    normals = face_normals(vertices, faces)
    length = np.linalg.norm(normals, axis=1)
    normals /= np.maximum(length, 1e-30)[:, None]
    best = np.zeros(len(faces))
    for index in range(len(cameras)):
        face_map, _ = depth_map(cameras, index, vertices, faces)
        shown = np.unique(face_map)
        shown = shown[shown != NO_FACE]
        _, depth = cameras.project(index, centers[shown])
        towards = cameras.centers[index] - centers[shown]
        cos = (normals[shown] * towards).sum(1) / np.maximum(np.linalg.norm(towards, axis=1), 1e-30)
        K = cameras.intrinsics[index]
        density = K[0, 0] * K[1, 1] * np.maximum(cos, 0) / np.maximum(depth, 1e-9) ** 2
        best[shown] = np.maximum(best[shown], density)
    return best, length / 2


def texels_needed(density: np.ndarray, areas: np.ndarray) -> float:
    """Texels on the whole surface at which one covers what a pixel does in the best view; 0 where no photo shows it.

    The median over the surface that photos show decides, so that neither close-ups of a small part nor faces no photo
    shows call for a texture that the others cannot fill.

    Args:
        density: [F] pixels per unit of area, see `pixels_per_area`.
        areas: [F].
    """
    return float(areas.sum() * _typical(density, areas))


def ground_sampling(density: np.ndarray, areas: np.ndarray) -> float:
    """Length on the surface that a pixel of the best view covers (the median); 0 where no photo shows it.

    Args:
        density: [F] pixels per unit of area, see `pixels_per_area`.
        areas: [F] what each face counts: its area as seen from above.
    """
    typical = _typical(density, areas)
    return typical**-0.5 if typical > 0 else 0.0


def _typical(density: np.ndarray, areas: np.ndarray) -> float:
    """The median over the area that photos show; 0 where they show none."""
    shown = np.flatnonzero((density > 0) & (areas > 0))
    if not len(shown):
        return 0.0
    order = shown[np.argsort(density[shown])]
    cumulative = np.cumsum(areas[order])
    return float(density[order[np.searchsorted(cumulative, cumulative[-1] / 2)]])


def texture_size_for(texels: float, fill: float) -> int:
    """The power of two between `SMALLEST` and `LARGEST` at which charts that fill a part `fill` have so many texels."""
    side = np.sqrt(texels / fill)
    return int(np.clip(2.0 ** np.ceil(np.log2(max(side * (1 - SHORT_OF), 1.0))), SMALLEST, LARGEST))
