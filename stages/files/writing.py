"""Textured meshes as bytes: GLB, OBJ + MTL, PLY, STL. Arrays in, bytes out."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np

from stages.texture.tangents import vertex_tangents

_FLOAT, _UINT = 5126, 5125
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963
_LINEAR, _LINEAR_MIPMAP_LINEAR, _CLAMP_TO_EDGE = 9729, 9987, 33071
ROUGHNESS = 0.9


@dataclass(frozen=True)
class Textures:
    """The images of one material, each as the bytes of a PNG, row 0 at v = 1.

    Attributes:
        base_color: sRGB.
        normal: tangent-space normals, +Y up, or None.
        occlusion: grey, 255 where all is open to light, or None.
    """

    base_color: bytes
    normal: bytes | None = None
    occlusion: bytes | None = None


def glb_bytes(
    vertices: np.ndarray,
    normals: np.ndarray,
    uvs: np.ndarray,
    faces: np.ndarray,
    textures: Textures,
    name: str = "model",
    generator: str = "hineus",
    extras: dict[str, Any] | None = None,
) -> bytes:
    """A binary glTF 2.0 file with one mesh and one PBR material (metallic 0, roughness `ROUGHNESS`).

    Written by hand so that every field is chosen here (buffer targets, sampler, extras, the PNG's own
    bytes): the format is two chunks, JSON and a binary blob (glTF 2.0 specification, section 4). With a normal map
    goes the frame it was baked for, as TANGENT.

    Args:
        vertices: [V, 3] in a right-handed, Y-up frame.
        normals: [V, 3] unit.
        uvs: [V, 2], origin at the bottom-left (turned to glTF's top-left here).
        faces: [F, 3], counter-clockwise seen from outside.
        textures: of the material.
        extras: JSON-able, kept in the asset's extras.

    Raises:
        ValueError: an index is out of range, a normal is not unit or a number is not finite.
    """
    vertices, normals, uvs, faces = checked_mesh(vertices, normals, uvs, faces)
    flipped = uvs.copy()
    flipped[:, 1] = 1 - flipped[:, 1]
    bounds = {"min": vertices.min(0).tolist(), "max": vertices.max(0).tolist()}
    buffer = _GlbBuffer()
    attributes = {
        "POSITION": buffer.add_numbers(vertices, "VEC3", **bounds),
        "NORMAL": buffer.add_numbers(normals, "VEC3"),
        "TEXCOORD_0": buffer.add_numbers(flipped, "VEC2"),
    }
    if textures.normal is not None:
        attributes["TANGENT"] = buffer.add_numbers(vertex_tangents(vertices, normals, uvs, faces), "VEC4")
    indices = buffer.add_numbers(faces.ravel(), "SCALAR", _ELEMENT_ARRAY_BUFFER)
    material: dict[str, Any] = {
        "name": name,
        "pbrMetallicRoughness": {
            "baseColorTexture": {"index": buffer.add_image(textures.base_color, "base_color")},
            "metallicFactor": 0.0,
            "roughnessFactor": ROUGHNESS,
        },
    }
    if textures.normal is not None:
        material["normalTexture"] = {"index": buffer.add_image(textures.normal, "normal")}
    if textures.occlusion is not None:
        material["occlusionTexture"] = {"index": buffer.add_image(textures.occlusion, "occlusion")}
    tree = {
        "asset": {"version": "2.0", "generator": generator, **({"extras": extras} if extras else {})},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": name}],
        "meshes": [{"name": name, "primitives": [{"attributes": attributes, "indices": indices, "material": 0}]}],
        "materials": [material],
        "textures": [{"source": k, "sampler": 0} for k in range(len(buffer.images))],
        "samplers": [
            {
                "magFilter": _LINEAR,
                "minFilter": _LINEAR_MIPMAP_LINEAR,
                "wrapS": _CLAMP_TO_EDGE,
                "wrapT": _CLAMP_TO_EDGE,
            }
        ],
        "images": buffer.images,
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    return _chunks(tree, buffer.data)


def shapes_glb_bytes(
    shapes: dict[str, tuple[np.ndarray, np.ndarray]],
    generator: str = "hineus",
    extras: dict[str, Any] | None = None,
) -> bytes:
    """A binary glTF 2.0 file of bare shapes: a node and a mesh for each name, without normals and material.

    Args:
        shapes: name -> vertices [V, 3] in a right-handed, Y-up frame, and faces [F, 3], counter-clockwise from outside.
        extras: JSON-able, kept in the asset's extras.
    """
    buffer = _GlbBuffer()
    meshes = []
    for name, (vertices, faces) in shapes.items():
        points = np.ascontiguousarray(vertices, dtype=np.float32)
        bounds = {"min": points.min(0).tolist(), "max": points.max(0).tolist()}
        position = buffer.add_numbers(points, "VEC3", **bounds)
        indices = buffer.add_numbers(faces.ravel().astype(np.uint32), "SCALAR", _ELEMENT_ARRAY_BUFFER)
        meshes.append({"name": name, "primitives": [{"attributes": {"POSITION": position}, "indices": indices}]})
    tree = {
        "asset": {"version": "2.0", "generator": generator, **({"extras": extras} if extras else {})},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(meshes)))}],
        "nodes": [{"mesh": k, "name": name} for k, name in enumerate(shapes)],
        "meshes": meshes,
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    return _chunks(tree, buffer.data)


def _chunks(tree: dict[str, Any], data: bytearray) -> bytes:
    """The file of a JSON and a binary chunk, each of a multiple of four bytes."""
    text = json.dumps(tree, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % 4)
    return b"".join(
        [
            struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(data)),
            struct.pack("<I4s", len(text), b"JSON"),
            text,
            struct.pack("<I4s", len(data), b"BIN\0"),
            data,
        ]
    )


class _GlbBuffer:
    """The binary chunk as it grows, and the JSON that says what lies where in it."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []
        self.images: list[dict[str, Any]] = []

    def add_numbers(self, array: np.ndarray, kind: str, target: int = _ARRAY_BUFFER, **bounds: list[float]) -> int:
        """Index of the new accessor of `array`, float32 or uint32, of elements `kind`."""
        self._add(array.tobytes(), {"target": target})
        component = _UINT if array.dtype == np.uint32 else _FLOAT
        accessor = {"bufferView": len(self.views) - 1, "componentType": component, "count": len(array), "type": kind}
        self.accessors.append({**accessor, **bounds})
        return len(self.accessors) - 1

    def add_image(self, png: bytes, name: str) -> int:
        """Index of the new image, which is also its texture's."""
        self._add(png, {})
        self.images.append({"bufferView": len(self.views) - 1, "mimeType": "image/png", "name": name})
        return len(self.images) - 1

    def _add(self, blob: bytes, how: dict[str, int]) -> None:
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(blob), **how})
        self.data += blob + b"\0" * (-len(blob) % 4)


def obj_text(
    vertices: np.ndarray,
    normals: np.ndarray,
    uvs: np.ndarray,
    faces: np.ndarray,
    mtl_name: str,
    comment: str = "",
) -> str:
    """An OBJ with positions, UVs (bottom-left origin), normals, the material "textured" of `mtl_name`, a comment."""
    vertices, normals, uvs, faces = checked_mesh(vertices, normals, uvs, faces)
    lines = [f"# {comment}"] if comment else []
    lines += [f"mtllib {mtl_name}", "o model"]
    lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices.tolist()]
    lines += [f"vt {u:.7g} {v:.7g}" for u, v in uvs.tolist()]
    lines += [f"vn {x:.6g} {y:.6g} {z:.6g}" for x, y, z in normals.tolist()]
    lines.append("usemtl textured")
    lines += [f"f {a}/{a}/{a} {b}/{b}/{b} {c}/{c}/{c}" for a, b, c in (faces.astype(np.int64) + 1).tolist()]
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
    joined, first, inverse = np.unique(
        np.ascontiguousarray(vertices, dtype=np.float32), axis=0, return_index=True, return_inverse=True
    )
    inverse = inverse.reshape(-1)
    count = np.bincount(inverse)[:, None]
    mean_colors = np.stack([np.bincount(inverse, colors[:, c]) for c in range(3)], 1) / count
    vertex = np.empty(len(joined), dtype=[("position", "<f4", 3), ("normal", "<f4", 3), ("color", np.uint8, 3)])
    vertex["position"] = joined
    vertex["normal"] = normals[first]
    vertex["color"] = np.clip(mean_colors + 0.5, 0, 255).astype(np.uint8)
    face = np.empty(len(faces), dtype=[("count", np.uint8), ("corners", "<i4", 3)])
    face["count"] = 3
    face["corners"] = inverse[faces]
    header = ["ply", "format binary_little_endian 1.0", *([f"comment {comment}"] if comment else [])]
    header.append(f"element vertex {len(vertex)}")
    header += [f"property float {axis}" for axis in ("x", "y", "z", "nx", "ny", "nz")]
    header += [f"property uchar {channel}" for channel in ("red", "green", "blue")]
    header += [f"element face {len(face)}", "property list uchar int vertex_indices", "end_header"]
    return ("\n".join(header) + "\n").encode() + vertex.tobytes() + face.tobytes()


def stl_bytes(vertices: np.ndarray, faces: np.ndarray, comment: str = "") -> bytes:
    """A binary STL: shape only.

    Args:
        vertices, faces: [V, 3], [F, 3].
        comment: ASCII, cut to the header's 80 bytes.
    """
    corners = vertices[faces].astype(np.float32)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    triangles = np.zeros(len(faces), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("unused", "<u2")])
    triangles["normal"] = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    triangles["corners"] = corners
    # A file that begins with "solid" is taken for the text form.
    header = f"STL {comment}".encode("ascii", "replace")[:80].ljust(80)
    return header + struct.pack("<I", len(faces)) + triangles.tobytes()


def checked_mesh(
    vertices: np.ndarray, normals: np.ndarray, uvs: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """The arrays as float32 and uint32; wrong ones are refused."""
    num = len(vertices)
    if normals.shape != (num, 3) or uvs.shape != (num, 2):
        raise ValueError(f"expected normals [{num}, 3] and uvs [{num}, 2], got {normals.shape} and {uvs.shape}")
    if not len(faces) or faces.min() < 0 or faces.max() >= num:
        raise ValueError(f"expected at least one face with vertices in [0, {num}), got {faces.shape[0]} faces")
    arrays = [np.ascontiguousarray(array, dtype=np.float32) for array in (vertices, normals, uvs)]
    if not all(np.isfinite(array).all() for array in arrays):
        raise ValueError("expected finite vertices, normals and uvs")
    lengths = np.linalg.norm(arrays[1], axis=1)
    if np.abs(lengths - 1).max() > 1e-3:
        raise ValueError(f"expected unit normals, got lengths in [{lengths.min():.3g}, {lengths.max():.3g}]")
    return arrays[0], arrays[1], arrays[2], np.ascontiguousarray(faces, dtype=np.uint32)
