"""What atlas publishes: the mesh with its UV charts."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from stages.artifacts.artifact import Artifact

ATLAS_FILE = "atlas.npz"


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


def save_atlas(folder: Path, atlas: AtlasMesh) -> None:
    np.savez(folder / ATLAS_FILE, **asdict(atlas))


def load_atlas(folder: Path) -> AtlasMesh:
    with np.load(folder / ATLAS_FILE) as data:
        return AtlasMesh(data["vertices"], data["normals"], data["uvs"], data["faces"], int(data["texture_size"]))


ATLAS = Artifact("atlas", (ATLAS_FILE,), load_atlas, save_atlas)
