"""PLY and STL: a mesh with colours at its vertices, or bare. Arrays in, bytes out, by trimesh."""

from __future__ import annotations

import numpy as np


def ply_bytes(
    vertices: np.ndarray, normals: np.ndarray, colors: np.ndarray, faces: np.ndarray, comment: str = ""
) -> bytes:
    """A binary PLY with vertex normals and colours; vertices at one position (UV seams) are joined.

    Args:
        vertices, normals: [V, 3].
        colors: [V, 3] 0..255.
        faces: [F, 3].
        comment: one line of ASCII for the header.
    """
    import trimesh

    joined, first, inverse = np.unique(
        np.ascontiguousarray(vertices, dtype=np.float32), axis=0, return_index=True, return_inverse=True
    )
    inverse = inverse.reshape(-1)
    count = np.bincount(inverse)
    # As columns of their own: trimesh's colours have an alpha.
    columns = dict(zip(("nx", "ny", "nz"), normals[first].T.astype(np.float32), strict=True))
    for name, channel in zip(("red", "green", "blue"), colors.T, strict=True):
        columns[name] = np.clip(np.bincount(inverse, channel) / count + 0.5, 0, 255).astype(np.uint8)
    mesh = trimesh.Trimesh(joined, inverse[faces], vertex_attributes=columns, process=False)
    data = mesh.export(file_type="ply", vertex_normal=False)
    return data.replace(b"element", f"comment {comment}\nelement".encode("ascii", "replace"), 1) if comment else data


def stl_bytes(vertices: np.ndarray, faces: np.ndarray, comment: str = "") -> bytes:
    """A binary STL: shape only.

    Args:
        vertices, faces: [V, 3], [F, 3].
        comment: ASCII, cut to the header's 80 bytes.
    """
    import trimesh

    data = trimesh.Trimesh(vertices, faces, process=False).export(file_type="stl")
    # A file that begins with "solid" is taken for the text form.
    return f"STL {comment}".encode("ascii", "replace")[:80].ljust(80) + data[80:]
