"""What every textured file holds: one mesh, its arrays checked, and the images of one material."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stages.artifacts import AtlasMesh

ROUGHNESS = 0.9


@dataclass(frozen=True)
class Textures:
    """The images of one material, each as the bytes of a PNG (a GLB takes JPEG, too), row 0 at v = 1.

    Attributes:
        base_color: sRGB.
        normal: tangent-space normals, +Y up, or None.
        occlusion: grey, 255 where all is open to light, or None.
        orm: linear occlusion, roughness and metalness as red, green and blue, in place of `occlusion`; None where the
            material was not learned, which then is no metal and of `ROUGHNESS`.
    """

    base_color: bytes
    normal: bytes | None = None
    occlusion: bytes | None = None
    orm: bytes | None = None

    def __post_init__(self) -> None:
        if self.orm is not None and self.occlusion is not None:
            raise ValueError("expected the occlusion beside the roughness or alone, got both")


def checked_mesh(mesh: AtlasMesh) -> AtlasMesh:
    """The mesh with arrays of float32 and uint32.

    Raises:
        ValueError: an index is out of range, a normal is not unit or a number is not finite.
    """
    num, faces = len(mesh.vertices), mesh.faces
    if mesh.normals.shape != (num, 3) or mesh.uvs.shape != (num, 2):
        shapes = f"{mesh.normals.shape} and {mesh.uvs.shape}"
        raise ValueError(f"expected normals [{num}, 3] and uvs [{num}, 2], got {shapes}")
    if not len(faces) or faces.min() < 0 or faces.max() >= num:
        raise ValueError(f"expected at least one face with vertices in [0, {num}), got {faces.shape[0]} faces")
    arrays = [np.ascontiguousarray(array, dtype=np.float32) for array in (mesh.vertices, mesh.normals, mesh.uvs)]
    if not all(np.isfinite(array).all() for array in arrays):
        raise ValueError("expected finite vertices, normals and uvs")
    lengths = np.linalg.norm(arrays[1], axis=1)
    if np.abs(lengths - 1).max() > 1e-3:
        raise ValueError(f"expected unit normals, got lengths in [{lengths.min():.3g}, {lengths.max():.3g}]")
    vertices, normals, uvs = arrays
    return replace(mesh, vertices=vertices, normals=normals, uvs=uvs, faces=np.ascontiguousarray(faces, np.uint32))
