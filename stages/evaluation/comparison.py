"""Compare two meshes or workspaces: reads and writes the files, leaves the measuring to `stages.evaluation`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from stages import artifacts
from stages.errors import InputError
from stages.evaluation.alignment import by_icp
from stages.evaluation.coloring import distance_colors
from stages.evaluation.surfaces import DEFAULT_THRESHOLDS, Surface, Target, measure
from stages.files.ply_stl import ply_bytes

Mesh = tuple[np.ndarray, np.ndarray]


def compare(first: Path, second: Path, icp: bool, distance_map: Path | None) -> dict[str, Any]:
    """Distances of two meshes both ways, see `stages.evaluation.surfaces.OneWay`.

    Args:
        first, second: mesh files or workspaces.
        icp: move the first onto the second before; else both are taken to be in one frame.
        distance_map: PLY to write: the first mesh, coloured by its distance to the second.

    Returns:
        JSON-able numbers, the meshes' paths, and how they were aligned. F-scores at parts of the larger extent.

    Raises:
        InputError: a mesh cannot be read, or the distance map not written.
    """
    paths = [mesh_path(place) for place in (first, second)]
    a, b = (Surface(*read_mesh(path)) for path in paths)
    alignment: dict[str, Any] = {"alignment": "same frame"}
    try:
        if icp:
            motion = by_icp(a, b)
            a = a.moved(motion.matrix())
            alignment = {"alignment": "icp", "b_from_a": motion.matrix().tolist()}
        extent = max(a.extent, b.extent)
        found = measure(a, b, [part * extent for part in DEFAULT_THRESHOLDS])
    except ValueError as error:
        raise InputError(
            f"{paths[0]} and {paths[1]} cannot be compared: {error}.", "Look at the two meshes."
        ) from error
    if distance_map is not None:
        _write_map(distance_map, a, Target(b).nearest(a.points).distances, found.accuracy.p95)
    return {
        "a": str(paths[0]),
        "b": str(paths[1]),
        **alignment,
        "extent": extent,
        "a_to_b": asdict(found.accuracy),
        "b_to_a": asdict(found.completeness),
        "f_scores": {f"{part:g}": at.f_score for part, at in zip(DEFAULT_THRESHOLDS, found.f_scores, strict=True)},
        "distance_map": None if distance_map is None else str(distance_map),
    }


def mesh_path(place: Path) -> Path:
    """The mesh of a workspace, that which was exported; a file is its own."""
    if not place.is_dir():
        return place
    path = artifacts.ply_path(place / "export")
    if not path.exists():
        raise InputError(
            f"{place} holds no exported PLY ({path.relative_to(place)}).",
            f"Make it with ply in `export.formats`: `hineus export --workspace {place}`; or name a mesh file.",
        )
    return path


def read_mesh(path: Path) -> Mesh:
    """Vertices [V, 3] float64 and faces [F, 3] of a mesh file of any format that trimesh reads."""
    import trimesh

    try:
        mesh = trimesh.load(path, process=False, force="mesh")
        vertices, faces = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces)
    except (OSError, ValueError, AttributeError) as error:
        raise InputError(
            f"{path} cannot be read as a mesh: {error}.", "Name a PLY, OBJ, GLB or STL file, or a workspace."
        ) from error
    if not len(faces):
        raise InputError(f"{path} holds {len(vertices)} points and no faces.", "Name a mesh, not a point cloud.")
    return vertices, faces


def _write_map(path: Path, mesh: Surface, distances: np.ndarray, largest: float) -> None:
    from stages.surface.triangle_mesh import vertex_normals

    assert mesh.faces is not None
    normals, colors = vertex_normals(mesh.points, mesh.faces), distance_colors(distances, largest)
    data = ply_bytes(mesh.points, normals, colors, mesh.faces, f"red is {largest:.6g} and more")
    try:
        path.write_bytes(data)
    except OSError as error:
        raise InputError(
            f"The distance map cannot be written to {path}: {error.strerror}.", "Choose another place with `--map`."
        ) from error
