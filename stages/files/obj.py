"""OBJ and MTL: a textured mesh as text. Arrays in, text out."""

from __future__ import annotations

from collections.abc import Mapping

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


# The words by which a material names a map. Readers know normals by one of two: that of the PBR extension, and bumps.
_WORDS = {"roughness": ("map_Pr",), "metallic": ("map_Pm",), "normal": ("norm", "map_bump")}


def mtl_text(texture_name: str, maps: Mapping[str, str] | None = None) -> str:
    """The material "textured", of the colours in `texture_name`; without maps of roughness and metalness a matt one.

    Args:
        maps: file names of its maps: roughness, metallic (the PBR extension: `Pr` and `Pm` times the map) and normal.
    """
    maps = maps or {}
    lines = [
        "newmtl textured", "Ka 0 0 0", "Kd 1 1 1", "Ks 0 0 0", "illum 1",
        f"Pr {1 if 'roughness' in maps else ROUGHNESS}", f"Pm {1 if 'metallic' in maps else 0}",
        f"map_Kd {texture_name}",
    ]  # fmt: skip
    lines += [f"{word} {maps[kind]}" for kind in _WORDS if kind in maps for word in _WORDS[kind]]
    return "\n".join(lines) + "\n"


def roughness_and_metalness(orm_png: bytes) -> tuple[bytes, bytes]:
    """The grey images that an MTL wants, as PNG, of one that holds occlusion, roughness and metalness.

    Raises:
        ValueError: it is no image.
    """
    import cv2

    packed = cv2.imdecode(np.frombuffer(orm_png, np.uint8), cv2.IMREAD_COLOR)
    if packed is None:
        raise ValueError("expected a readable image of occlusion, roughness and metalness")
    metalness, roughness, _ = cv2.split(packed)  # OpenCV's channels begin with blue
    return cv2.imencode(".png", roughness)[1].tobytes(), cv2.imencode(".png", metalness)[1].tobytes()
