"""GLB, binary glTF 2.0: a textured mesh, or bare shapes. Arrays in, bytes out; and a textured mesh back."""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

from stages.artifacts import AtlasMesh
from stages.files.contents import ROUGHNESS, Textures, checked_mesh
from stages.inputs.texts import parse_json
from stages.texture.tangents import vertex_tangents

NAME = "model"
_FLOAT, _UINT = 5126, 5125
_JPEG = b"\xff\xd8\xff"
_ARRAY_BUFFER, _ELEMENT_ARRAY_BUFFER = 34962, 34963
# Linear, with mip-maps where it shrinks, clamped at the edges.
_SAMPLER = {"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}


def glb_bytes(
    mesh: AtlasMesh,
    textures: Textures,
    generator: str = "hineus",
    extras: dict[str, Any] | None = None,
) -> bytes:
    """A binary glTF 2.0 file with one mesh and one PBR material, see `Textures`.

    Written by hand so that every field is chosen here (buffer targets, sampler, extras, the PNG's own
    bytes): the format is two chunks, JSON and a binary blob (glTF 2.0 specification, section 4). With a normal map
    goes the frame it was baked for, as TANGENT.

    Args:
        mesh: in a right-handed, Y-up frame. Its UVs are turned to glTF's top-left origin here.
        textures: of the material.
        extras: JSON-able, kept in the asset's extras.

    Raises:
        ValueError: see `checked_mesh`.
    """
    mesh = checked_mesh(mesh)
    vertices, flipped = mesh.vertices, mesh.uvs.copy()
    flipped[:, 1] = 1 - flipped[:, 1]
    bounds = {"min": vertices.min(0).tolist(), "max": vertices.max(0).tolist()}
    buffer = GlbBuffer()
    attributes = {
        "POSITION": buffer.add_numbers(vertices, "VEC3", **bounds),
        "NORMAL": buffer.add_numbers(mesh.normals, "VEC3"),
        "TEXCOORD_0": buffer.add_numbers(flipped, "VEC2"),
    }
    if textures.normal is not None:
        attributes["TANGENT"] = buffer.add_numbers(vertex_tangents(mesh), "VEC4")
    indices = buffer.add_numbers(mesh.faces.ravel(), "SCALAR", _ELEMENT_ARRAY_BUFFER)
    material = _material(buffer, textures)
    primitive = {"attributes": attributes, "indices": indices, "material": 0}
    return buffer.file(
        [{"name": NAME, "primitives": [primitive]}],
        generator,
        extras,
        materials=[material],
        textures=[{"source": k, "sampler": 0} for k in range(len(buffer.images))],
        samplers=[_SAMPLER],
        images=buffer.images,
    )


def read_glb(data: bytes) -> tuple[AtlasMesh, bytes]:
    """Mesh with Y up and image of the base colour of a file that `glb_bytes` wrote.

    Raises:
        ValueError: it is no such file.
    """
    try:
        magic, version, _, length = struct.unpack_from("<4s3I", data)
        if magic != b"glTF" or version != 2:
            raise ValueError
        tree, binary = parse_json(data[20 : 20 + length].decode()), data[28 + length :]

        def blob(view: int) -> bytes:
            start, size = tree["bufferViews"][view]["byteOffset"], tree["bufferViews"][view]["byteLength"]
            if start + size > len(binary):
                raise ValueError
            return binary[start : start + size]

        def numbers(accessor: int, kind: type, width: int) -> np.ndarray:
            return np.frombuffer(blob(tree["accessors"][accessor]["bufferView"]), kind).reshape(-1, width)

        (part,) = tree["meshes"][0]["primitives"]
        places, normals, uvs = (
            numbers(part["attributes"][name], np.float32, width)
            for name, width in (("POSITION", 3), ("NORMAL", 3), ("TEXCOORD_0", 2))
        )
        faces = numbers(part["indices"], np.uint32, 3).astype(np.int32)
        texture = tree["materials"][part["material"]]["pbrMetallicRoughness"]["baseColorTexture"]["index"]
        image = blob(tree["images"][tree["textures"][texture]["source"]]["bufferView"])
    except (ValueError, KeyError, IndexError, TypeError, struct.error) as error:
        raise ValueError("it is no GLB of one textured mesh that this program wrote") from error
    mesh = AtlasMesh(places, normals, np.stack([uvs[:, 0], 1 - uvs[:, 1]], axis=1), faces, 0)
    return checked_mesh(mesh), image


def _material(buffer: GlbBuffer, textures: Textures) -> dict[str, Any]:
    """The material, its images added to the buffer. One image of three channels serves as two textures."""
    surface: dict[str, Any] = {
        "baseColorTexture": {"index": buffer.add_image(textures.base_color, "base_color")},
        "metallicFactor": 0.0,
        "roughnessFactor": ROUGHNESS,
    }
    material: dict[str, Any] = {"name": NAME, "pbrMetallicRoughness": surface}
    if textures.orm is not None:
        packed = {"index": buffer.add_image(textures.orm, "occlusion_roughness_metallic")}
        surface |= {"metallicRoughnessTexture": packed, "metallicFactor": 1.0, "roughnessFactor": 1.0}
        material["occlusionTexture"] = packed
    if textures.normal is not None:
        material["normalTexture"] = {"index": buffer.add_image(textures.normal, "normal")}
    if textures.occlusion is not None:
        material["occlusionTexture"] = {"index": buffer.add_image(textures.occlusion, "occlusion")}
    return material


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
    buffer = GlbBuffer()
    meshes = []
    for name, (vertices, faces) in shapes.items():
        points = np.ascontiguousarray(vertices, dtype=np.float32)
        bounds = {"min": points.min(0).tolist(), "max": points.max(0).tolist()}
        position = buffer.add_numbers(points, "VEC3", **bounds)
        indices = buffer.add_numbers(faces.ravel().astype(np.uint32), "SCALAR", _ELEMENT_ARRAY_BUFFER)
        meshes.append({"name": name, "primitives": [{"attributes": {"POSITION": position}, "indices": indices}]})
    return buffer.file(meshes, generator, extras)


class GlbBuffer:
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

    def add_image(self, image: bytes, name: str) -> int:
        """Index of the new image, a PNG or a JPEG, which is also its texture's."""
        self._add(image, {})
        kind = "image/jpeg" if image.startswith(_JPEG) else "image/png"
        self.images.append({"bufferView": len(self.views) - 1, "mimeType": kind, "name": name})
        return len(self.images) - 1

    def _add(self, blob: bytes, how: dict[str, int]) -> None:
        self.views.append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(blob), **how})
        self.data += blob + b"\0" * (-len(blob) % 4)

    def file(
        self,
        meshes: list[dict[str, Any]],
        generator: str,
        extras: dict[str, Any] | None,
        **tables: list[Any],
    ) -> bytes:
        """The file: a JSON chunk, with a node for each mesh, and a binary one, each of a multiple of four bytes."""
        tree = {
            "asset": {"version": "2.0", "generator": generator, **({"extras": extras} if extras else {})},
            "scene": 0,
            "scenes": [{"nodes": list(range(len(meshes)))}],
            "nodes": [{"mesh": k, "name": mesh["name"]} for k, mesh in enumerate(meshes)],
            "meshes": meshes,
            **tables,
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": len(self.data)}],
        }
        text = json.dumps(tree, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        head = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(self.data))
        chunks = struct.pack("<I4s", len(text), b"JSON"), text, struct.pack("<I4s", len(self.data), b"BIN\0"), self.data
        return b"".join([head, *chunks])
