"""Fewer faces, same shape: quadric edge collapse (Garland and Heckbert 1997), by pymeshlab.

docs/adr/0011-mesh-libraries.md has what other libraries make of the same meshes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from stages.surface.triangle_mesh import repair_manifold

# Whole parameter lists: pymeshlab takes what is left out from the call before in the same process.
_COLLAPSE = {
    "targetperc": 0.0, "qualitythr": 0.3, "boundaryweight": 1.0, "preservenormal": True, "optimalplacement": True,
    "planarquadric": False, "selected": False,
}  # fmt: skip
# Borders may lose vertices, too: frozen, they take the faces of a light mesh for themselves.
_PLAIN = {
    **_COLLAPSE, "preserveboundary": False, "preservetopology": True, "planarweight": 0.001, "qualityweight": False,
    "autoclean": True,
}  # fmt: skip
# pymeshlab's own weight of UVs is 1; more holds the texture better and the shape no worse.
_TEXTURED = {**_COLLAPSE, "preserveboundary": True, "extratcoordw": 3.0}


def decimate(
    vertices: np.ndarray, faces: np.ndarray, target_faces: int, frozen: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """A mesh of about `target_faces` faces; the same one where it has no more.

    Args:
        vertices: [V, 3].
        faces: [F, 3], a 2-manifold with or without borders.
        target_faces: >= 4.
        frozen: [V] bool, vertices that stay where they are; None: none.

    Returns:
        Vertices float32 and faces int32, a 2-manifold; closed, if the mesh was.

    Raises:
        ValueError: `target_faces` out of bounds.
    """
    import pymeshlab

    if target_faces < 4:
        raise ValueError(f"expected target_faces >= 4, got {target_faces}")
    if len(faces) > target_faces:
        meshes = pymeshlab.MeshSet()
        held = np.zeros(len(vertices)) if frozen is None else frozen.astype(np.float64)
        mesh = pymeshlab.Mesh(vertices.astype(np.float64), faces.astype(np.int32), v_scalar_array=held)
        meshes.add_mesh(mesh)
        if held.any():
            meshes.compute_selection_by_condition_per_face(condselect="q0 + q1 + q2 == 0")
        # Of what is selected only vertices move all of whose faces are.
        meshes.meshing_decimation_quadric_edge_collapse(
            targetfacenum=target_faces, **{**_PLAIN, "selected": bool(held.any())}
        )
        light = meshes.current_mesh()
        vertices, faces = light.vertex_matrix(), light.face_matrix()
    vertices, faces = repair_manifold(vertices, faces)
    return vertices.astype(np.float32), faces


def decimate_textured(
    vertices: np.ndarray, faces: np.ndarray, uvs: np.ndarray, targets: Sequence[int]
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Lighter and lighter versions of a textured mesh, each made from the one before.

    Quadrics over position and UV (Garland and Heckbert 1998) keep seams and what lies where in the texture.

    Args:
        vertices, uvs: [V, 3] and [V, 2], split along the seams of the charts.
        faces: [F, 3], one or more.
        targets: faces of each version, >= 4, falling.

    Yields:
        Vertices [W, 3] float64, faces [G, 3] int32 and UVs [3G, 2] float64 of the faces' corners.
    """
    import pymeshlab

    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(vertices.astype(np.float64), faces, v_tex_coords_matrix=uvs.astype(np.float64)))
    meshes.compute_texcoord_transfer_vertex_to_wedge()
    meshes.meshing_remove_duplicate_vertices()
    for target in targets:
        meshes.meshing_decimation_quadric_edge_collapse_with_texture(targetfacenum=target, **_TEXTURED)
        light = meshes.current_mesh()
        yield light.vertex_matrix(), light.face_matrix(), light.wedge_tex_coord_matrix()
