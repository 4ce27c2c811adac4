"""OBJ and MTL: a textured mesh as text. Arrays in, text out."""

from __future__ import annotations

import numpy as np

from stages.artifacts import AtlasMesh
from stages.files.contents import ROUGHNESS, checked_mesh


def obj_text(mesh: AtlasMesh, mtl_name: str, comment: str = "") -> str:
    """An OBJ with positions, UVs (bottom-left origin), normals, the material "textured" of `mtl_name`, a comment."""
    mesh = checked_mesh(mesh)
    lines = [f"# {comment}"] if comment else []
    lines += [f"mtllib {mtl_name}", "o model"]
    lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in mesh.vertices.tolist()]
    lines += [f"vt {u:.7g} {v:.7g}" for u, v in mesh.uvs.tolist()]
    lines += [f"vn {x:.6g} {y:.6g} {z:.6g}" for x, y, z in mesh.normals.tolist()]
    lines.append("usemtl textured")
    lines += [f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}" for a, b, c in (mesh.faces.astype(np.int64) + 1).tolist()]
    return "\n".join(lines) + "\n"


def mtl_text(texture_name: str, normal_map_name: str | None = None) -> str:
    """The material "textured": a matt surface of the colours in `texture_name`.

    Readers know a map of normals by one of two names: `norm` (the PBR extension) or `map_bump`.
    """
    lines = [
        "newmtl textured", "Ka 0 0 0", "Kd 1 1 1", "Ks 0 0 0", "illum 1", f"Pr {ROUGHNESS}", "Pm 0",
        f"map_Kd {texture_name}",
    ]  # fmt: skip
    if normal_map_name is not None:
        lines += [f"norm {normal_map_name}", f"map_bump {normal_map_name}"]
    return "\n".join(lines) + "\n"
