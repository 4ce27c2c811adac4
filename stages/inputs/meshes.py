"""Meshes and clouds of points that other programs wrote, read from their bytes alone.

No other file, address or picture that they name is opened, and what headers say is held against the bytes that are
there before memory is taken for it. What no geometry comes from (materials, textures, notes) is not looked at.
"""

from __future__ import annotations

import io
import json
import re
import struct
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from stages.inputs.bounded import read_bytes
from stages.inputs.texts import parse_json

MESHES = (".ply", ".obj", ".stl", ".glb", ".gltf", ".off")
CLOUDS = (".pcd", ".xyz", ".pts")
MOST_BYTES = 1 << 34
LARGEST = 1e9  # of a coordinate: areas squared must be numbers in single precision, too

# Of a PLY: bytes of its types, its header's length and elements.
PLY_TYPES = {name: size for names, size in (
    ("char uchar int8 uint8", 1), ("short ushort int16 uint16", 2),
    ("int uint float int32 uint32 float32", 4), ("double float64", 8),
) for name in names.split()}  # fmt: skip
MOST_HEADER, MOST_ELEMENTS = 1 << 16, 32
# Of a glTF: what may come of a small file by repetition (vertices and corners), and how deep nodes lie in each other.
MOST_REPEATED, MOST_DEPTH = 4_000_000, 100
GLTF_NODE = ("children", "mesh", "matrix", "translation", "rotation", "scale")
GLTF_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
GLTF_ITEMS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
GLB, GLB_JSON, GLB_BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
LZF_GROWTH = 88  # of LZF, by which PCD files are compressed, at most


def read_geometry(file: Path) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
    """Points [V, 3] float64; faces [F, 3] int64, None of a cloud; unit normals [V, 3] of a cloud that has some.

    Raises:
        OSError: it cannot be read.
        ValueError: it is of none of `MESHES` and `CLOUDS`, or says what cannot be. Damaged files raise nearly anything.
    """
    suffix = file.suffix.lower()
    if suffix not in MESHES + CLOUDS:
        raise ValueError(f"{suffix or 'a name without an ending'} is none of {' '.join(MESHES + CLOUDS)}")
    data = read_bytes(file, MOST_BYTES)
    if suffix == ".pcd":
        points, normals = _read_pcd(file, data)
        return _checked(points), None, normals
    if suffix in CLOUDS:
        return _checked(_rows(data)), None, None
    if suffix == ".ply":
        check_ply(data)
        return _read_ply(data)
    prepared = {".obj": plain_obj, ".stl": plain_stl, ".glb": plain_glb, ".gltf": plain_gltf}.get(suffix, bytes)(data)
    mesh = _load(prepared, suffix, force="mesh")
    return _checked(mesh.vertices), _checked_faces(mesh.faces, len(mesh.vertices)), None


def _load(data: bytes, suffix: str, **options: Any) -> Any:
    import trimesh

    return trimesh.load(
        io.BytesIO(data), file_type=suffix[1:], resolver=None, process=False, skip_materials=True, **options
    )


def _checked(points: Any) -> np.ndarray:
    found = np.asarray(points, dtype=np.float64)
    if found.ndim != 2 or found.shape[1] != 3 or not len(found):
        raise ValueError("it holds no points")
    if not (np.abs(found) <= LARGEST).all():
        worst = found.ravel()[np.argmax(~(np.abs(found) <= LARGEST))]
        raise ValueError(f"a coordinate is {worst:g}, at most {LARGEST:g} is read")
    return found


def _checked_faces(faces: Any, count: int) -> np.ndarray:
    found = np.asarray(faces)
    if not found.size:
        raise ValueError(f"it holds {count} points and no faces")
    if found.ndim != 2 or found.shape[1] != 3 or found.dtype.kind not in "iu":
        raise ValueError("its faces are no triangles")
    if found.min() < 0 or found.max() >= count:
        raise ValueError(f"a face has vertex {found.min() if found.min() < 0 else found.max()}, of {count}")
    return found.astype(np.int64)


# ---------------------------------------------------------------- PLY
def check_ply(data: bytes) -> None:
    """
    Raises:
        ValueError: the header is none, or needs more bytes than follow it.
    """
    head, mark, _ = data[:MOST_HEADER].partition(b"end_header")
    lines = [line.split() for line in head.decode("latin-1").splitlines()]
    if not head.lower().startswith(b"ply") or not mark or len(lines) < 2 or lines[1][:1] != ["format"]:
        raise ValueError("it has no header of a PLY file")
    follow = len(data) - len(head) - len(mark)
    ascii_text, elements = lines[1][1:2] == ["ascii"], dict[str, tuple[int, list[int]]]()
    for words in lines[2:]:
        if words[:1] == ["element"]:
            if len(words) != 3 or not words[2].isdecimal() or words[1] in elements:
                raise ValueError(f"its header has the line '{' '.join(words)[:60]}'")
            elements[words[1]] = int(words[2]), []
        elif words[:1] == ["property"]:
            kinds = words[2:4] if words[1:2] == ["list"] else words[1:2]
            if not elements or len(words) != 2 + len(kinds) + (len(kinds) == 2) or not set(kinds) <= PLY_TYPES.keys():
                raise ValueError(f"its header has the line '{' '.join(words)[:60]}'")
            # of a list at least its count; of a number in a text at least a digit and a blank
            next(reversed(elements.values()))[1].append(2 if ascii_text else PLY_TYPES[kinds[0]])
    if len(elements) > MOST_ELEMENTS or any(count and not sizes for count, sizes in elements.values()):
        raise ValueError(f"its header has {len(elements)} elements, or some without properties")
    needed = sum(count * sum(sizes) for count, sizes in elements.values())
    if needed > follow + 1:  # the last blank may be missing
        raise ValueError(f"its header needs {needed} bytes or more, {follow} follow")


def _read_ply(data: bytes) -> tuple[np.ndarray, np.ndarray | None, np.ndarray | None]:
    found = _load(data, ".ply")
    points = _checked(getattr(found, "vertices", ()))
    if hasattr(found, "faces"):
        return points, _checked_faces(found.faces, len(points)), None
    columns = found.metadata["_ply_raw"]["vertex"]["data"]
    names = columns.dtype.names if isinstance(columns, np.ndarray) else columns
    if not {"nx", "ny", "nz"} <= set(names):
        return points, None, None
    return points, None, _unit(np.column_stack([columns[name] for name in ("nx", "ny", "nz")]))


def _unit(normals: np.ndarray) -> np.ndarray:
    """At length 1; those of no length or that are not finite point up."""
    lengths = np.linalg.norm(normals.astype(np.float64), axis=1, keepdims=True)
    good = np.isfinite(lengths) & (lengths > 0)
    return np.where(good, normals / np.where(good, lengths, 1), (0.0, 0.0, 1.0))


# ---------------------------------------------------------------- texts
def plain_obj(data: bytes) -> bytes:
    """Its vertices and faces alone: other lines name files, and split it into as many parts as there are materials."""
    lines = data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines()
    return b"\n".join(line.lstrip() for line in lines if line.lstrip()[:2] in (b"v ", b"v\t", b"f ", b"f\t"))


def plain_stl(data: bytes) -> bytes:
    """A text as one solid of its vertices alone; what is binary as it is."""
    if len(data) >= 84 and len(data) == 84 + 50 * struct.unpack_from("<I", data, 80)[0]:
        return data
    vertices = re.findall(rb"^[ \t]*(vertex[^\n]*)", data, flags=re.MULTILINE | re.IGNORECASE)
    return b"solid\n" + b"\n".join(vertices) + b"\nendsolid\n"


def _rows(data: bytes) -> np.ndarray:
    """The first three numbers of each line; the first line may be names, or the number of lines."""
    text = data.decode("utf-8", "replace")
    first = text.split("\n", 1)[0].split("#")[0].replace(",", " ").split()
    try:
        titled = len([float(word) for word in first]) < 3
    except ValueError:
        titled = True
    lines = io.StringIO(text.replace(",", " "))
    with warnings.catch_warnings(action="ignore"):  # of one without rows, which is refused
        return np.asarray(np.loadtxt(lines, usecols=(0, 1, 2), skiprows=int(titled), ndmin=2))


# ---------------------------------------------------------------- glTF
def plain_glb(data: bytes) -> bytes:
    """A GLB of the same meshes and nothing else."""
    magic, version, _, length, kind = struct.unpack("<5I", data[:20].ljust(20, b"\0"))
    if (magic, version, kind) != (GLB, 2, GLB_JSON) or 20 + length > len(data):
        raise ValueError("it has no header of a GLB file of version 2")
    head = _plain_tree(parse_json(data[20 : 20 + length].decode("utf-8-sig")), len(data))
    head += b" " * (-len(head) % 4)
    rest = data[20 + length :]
    return struct.pack("<5I", GLB, 2, 20 + len(head) + len(rest), len(head), GLB_JSON) + head + rest


def plain_gltf(data: bytes) -> bytes:
    """A glTF of the same meshes and nothing else; its bytes must lie within it."""
    return _plain_tree(parse_json(data.decode("utf-8-sig")), len(data))


def _plain_tree(tree: Any, size: int) -> bytes:
    """What meshes and their places come from.

    Args:
        size: bytes of the file.

    Raises:
        ValueError: it refers to other files, or has much more in it than the file has bytes.
    """
    for buffer in tree.get("buffers", []):
        if not str(buffer.get("uri", "data:")).startswith("data:"):
            raise ValueError(f"it refers to another file, {str(buffer['uri'])[:60]}: save it as GLB, which is one file")
    plain = {key: tree[key] for key in ("buffers", "bufferViews", "accessors", "scene") if key in tree}
    plain["scenes"] = [{"nodes": scene.get("nodes", [])} for scene in tree.get("scenes", [])]
    plain["nodes"] = [{key: node[key] for key in GLTF_NODE if key in node} for node in tree.get("nodes", [])]
    plain["meshes"] = [
        {"primitives": [_plain_part(part) for part in mesh["primitives"]]} for mesh in tree.get("meshes", [])
    ]
    _check_tree(plain, size)
    return json.dumps({"asset": {"version": "2.0"}, **plain}).encode()


def _plain_part(part: Any) -> dict[str, Any]:
    kept = {key: part[key] for key in ("indices", "mode") if key in part}
    return {"attributes": {"POSITION": part["attributes"]["POSITION"]}, **kept}


def _check_tree(tree: dict[str, Any], size: int) -> None:
    accessors, nodes = tree.get("accessors", []), tree["nodes"]
    if not all("bufferView" in each and "sparse" not in each for each in accessors):
        raise ValueError("its meshes are compressed or sparse: save it without compression")
    views = [view["byteLength"] for view in tree.get("bufferViews", [])]
    held = [each["count"] * GLTF_BYTES[each["componentType"]] * GLTF_ITEMS[each["type"]] for each in accessors]
    if min([0, *views, *held]) < 0 or sum(views) > 2 * size or sum(held) > 4 * size:
        raise ValueError(f"it says that it holds {max(sum(views), sum(held))} bytes, the file has {size}")

    def weight(mesh: dict[str, Any]) -> int:
        used = [part[key] for part in mesh["primitives"] for key in ("indices",) if key in part]
        used += [part["attributes"]["POSITION"] for part in mesh["primitives"]]
        return sum(accessors[index]["count"] for index in used)

    weights = [weight(mesh) for mesh in tree["meshes"]]
    placed = (nodes[each].get("mesh") for each in _places(tree))
    total = sum(weights) + sum(weights[mesh] for mesh in placed if mesh is not None)
    if total > MOST_REPEATED + 4 * size:
        raise ValueError(f"it repeats its meshes up to {total} vertices and corners")
    level = {root for scene in tree["scenes"] for root in scene["nodes"]}
    for _ in range(MOST_DEPTH):
        level = {child for each in level for child in nodes[each].get("children", ())}
    if level:
        raise ValueError(f"its nodes lie in each other more than {MOST_DEPTH} deep, or in a circle")


def _places(tree: dict[str, Any]) -> Iterator[int]:
    """Nodes, as often as others or a scene refer to them."""
    for scene in tree["scenes"]:
        yield from scene["nodes"]
    for node in tree["nodes"]:
        yield from node.get("children", ())


# ---------------------------------------------------------------- PCD
def _read_pcd(file: Path, data: bytes) -> tuple[np.ndarray, np.ndarray | None]:
    import open3d as o3d

    check_pcd(data)
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud = o3d.io.read_point_cloud(str(file), format="pcd", remove_nan_points=False)
    return np.asarray(cloud.points), _unit(np.asarray(cloud.normals)) if cloud.has_normals() else None


def check_pcd(data: bytes) -> None:
    """
    Raises:
        ValueError: the header is none, or needs other bytes than follow it.
    """
    found = re.search(rb"^DATA (ascii|binary|binary_compressed)\s*?\n", data[:MOST_HEADER], flags=re.MULTILINE)
    if found is None:
        raise ValueError("it has no header of a PCD file")
    lines = [line.split() for line in data[: found.start()].decode("latin-1").splitlines()]
    head = {words[0]: words[1:] for words in lines if words and not words[0].startswith("#")}
    fields, sizes = head.get("FIELDS", []), [int(word) for word in head.get("SIZE", [])]
    counts = [int(word) for word in head.get("COUNT", ["1"] * len(fields))]
    points = int(head["POINTS"][0])
    if not (0 < len(fields) == len(sizes) == len(counts) == len(head["TYPE"]) <= 64) or not set("xyz") <= set(fields):
        raise ValueError(f"its header names {len(fields)} fields, {len(sizes)} sizes and {len(counts)} counts")
    if not set(sizes) <= {1, 2, 4, 8} or not all(1 <= count <= 4096 for count in counts):
        raise ValueError("its header has sizes or counts that cannot be")
    if points < 1 or points != int(head["WIDTH"][0]) * int(head["HEIGHT"][0]):
        raise ValueError(f"its header has {points} points in {head['WIDTH'][0]} x {head['HEIGHT'][0]}")
    row, follow = sum(size * count for size, count in zip(sizes, counts, strict=True)), len(data) - found.end()
    needed = points * 2 * sum(counts) - 1 if found[1] == b"ascii" else points * row
    if found[1] == b"binary_compressed":
        packed, unpacked = struct.unpack("<2I", data[found.end() :][:8].ljust(8, b"\0"))
        if unpacked != needed or packed > follow - 8 or unpacked > LZF_GROWTH * packed:
            raise ValueError(f"{follow - 8} bytes follow, of which {packed} unpack to {unpacked}; {needed} are needed")
    elif needed > follow:
        raise ValueError(f"its header needs {needed} bytes or more, {follow} follow")
