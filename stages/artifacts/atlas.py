"""What atlas publishes: the mesh with its UV charts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.artifacts.artifact import arrays_artifact


@dataclass(frozen=True)
class AtlasMesh:
    """A mesh whose vertices are split along the seams of its UV charts.

    Attributes:
        vertices: [V, 3] float32, scene frame.
        normals: [V, 3] float32 unit normals, smooth across seams.
        uvs: [V, 2] float32 in [0, 1], origin at the BOTTOM-left of the texture (OBJ's convention).
        faces: [F, 3] int32.
        texture_size: side in pixels of the texture the charts were packed for.
    """

    vertices: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray
    faces: np.ndarray
    texture_size: int


ATLAS = arrays_artifact("atlas", "atlas.npz", AtlasMesh)
