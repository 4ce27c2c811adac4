"""Bare meshes: what extract publishes, and cleanup before and after decimation."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.artifacts.artifact import Artifact
from stages.inputs.meshes import read_geometry

Mesh = tuple[np.ndarray, np.ndarray]
"""Vertices [V, 3] float32 in the scene frame and faces [F, 3] int32."""


def _mesh(stage: str, name: str) -> Artifact[Mesh]:
    """A binary PLY."""

    def load(folder: Path) -> Mesh:
        vertices, faces, _ = read_geometry(folder / name)
        if faces is None:
            raise ValueError(f"{folder / name} has no faces")
        return vertices.astype(np.float32), faces.astype(np.int32)

    def save(folder: Path, mesh: Mesh) -> None:
        import trimesh

        trimesh.Trimesh(*mesh, process=False).export(folder / name)

    return Artifact(stage, (name,), load, save)


def _load_around(folder: Path) -> Mesh | None:
    return _AROUND.load(folder) if (folder / _AROUND.files[0]).exists() else None


def _save_around(folder: Path, mesh: Mesh | None) -> None:
    if mesh is not None:
        _AROUND.save(folder, mesh)


_AROUND = _mesh("extract", "around.ply")

RAW_MESH = _mesh("extract", "mesh.ply")
AROUND_MESH: Artifact[Mesh | None] = Artifact("extract", _AROUND.files, _load_around, _save_around, optional=True)
"""What a block has learned around its tile, coarse; None where there is nothing, or no tile."""
CLEAN_FULL_MESH = _mesh("cleanup", "full_mesh.ply")
CLEAN_MESH = _mesh("cleanup", "mesh.ply")
