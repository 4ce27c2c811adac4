"""Bare meshes: what extract publishes, and cleanup before and after decimation."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from stages.artifacts.artifact import Artifact

MESH = "mesh.ply"
FULL_MESH = "full_mesh.ply"

Mesh = tuple[np.ndarray, np.ndarray]
"""Vertices [V, 3] float32 in the scene frame and faces [F, 3] int32."""


def save_mesh(folder: Path, vertices: np.ndarray, faces: np.ndarray, name: str = MESH) -> None:
    """Write mesh.ply (binary): vertices [V, 3] in the scene frame, faces [F, 3]."""
    import trimesh

    trimesh.Trimesh(vertices, faces, process=False).export(folder / name)


def load_mesh(folder: Path, name: str = MESH) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] float32 in the scene frame and faces [F, 3] int32."""
    import trimesh

    mesh = trimesh.load(folder / name, process=False)
    return np.asarray(mesh.vertices, dtype=np.float32), np.asarray(mesh.faces, dtype=np.int32)


def _mesh(stage: str, name: str) -> Artifact[Mesh]:
    return Artifact(
        stage, (name,), lambda folder: load_mesh(folder, name), lambda folder, mesh: save_mesh(folder, *mesh, name)
    )


RAW_MESH = _mesh("extract", MESH)
CLEAN_FULL_MESH = _mesh("cleanup", FULL_MESH)
CLEAN_MESH = _mesh("cleanup", MESH)
