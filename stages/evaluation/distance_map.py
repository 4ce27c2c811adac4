"""A surface coloured by how far it is from another, as a PLY."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.errors import InputError
from stages.evaluation.surfaces import Surface
from stages.files.ply_stl import ply_bytes
from stages.surface.triangle_mesh import vertex_normals


def write_distance_map(path: Path, mesh: Surface, distances: np.ndarray, largest: float) -> None:
    """Write a mesh with the colours of `distance_colors` for the distances [V] of its vertices.

    Raises:
        InputError: it is a cloud, or the file cannot be written.
    """
    if mesh.faces is None:
        raise InputError("A cloud of points has no surface to colour.", "Leave `--map` out, or name a mesh.")
    normals, colors = vertex_normals(mesh.points, mesh.faces), distance_colors(distances, largest)
    data = ply_bytes(mesh.points, normals, colors, mesh.faces, f"red is {largest:.6g} and more")
    try:
        path.write_bytes(data)
    except OSError as error:
        raise InputError(
            f"The distance map cannot be written to {path}: {error.strerror}.", "Choose another place with `--map`."
        ) from error


def distance_colors(distances: np.ndarray, largest: float) -> np.ndarray:
    """Colours [P, 3] uint8 of distances [P]: from blue at 0 over green to red at `largest` and beyond."""
    import cv2

    levels = np.clip(255 * distances / max(largest, 1e-30), 0, 255).astype(np.uint8)
    return cv2.applyColorMap(levels[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1]
