"""Meshes and clouds of strangers: every format that is listed, and what lies, names other files or cannot be."""

from __future__ import annotations

import base64
import json
import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from stages.errors import InputError
from stages.evaluation.reading import read_matrix, read_surface
from stages.evaluation.surfaces import Sampling, Surface, measure
from stages.inputs.meshes import CLOUDS, MESHES

BALL = trimesh.creation.icosphere(1)
PCD = "VERSION .7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {0}\nHEIGHT 1\nPOINTS {0}\nDATA {1}\n"
XYZ = "".join(f"property float {axis}\n" for axis in "xyz")
TRIANGLE = f"ply\nformat ascii 1.0\nelement vertex 3\n{XYZ}element face 1\nproperty list uchar int vertex_indices\n"
CORNERS = "0 0 0\n1 0 0\n0 1 0\n"
PLACES, INDICES = np.random.default_rng(0).random((3000, 3)).astype("<f4"), np.arange(3000, dtype="<u4")


def refused(file: Path, data: str | bytes, sentence: str) -> None:
    file.write_bytes(data.encode() if isinstance(data, str) else data)
    with pytest.raises(InputError, match=sentence) as caught:
        read_surface(file)
    assert len(caught.value.message) < 600


def glb(**changes: Any) -> bytes:
    """1000 triangles, once, less or more what `changes` says of its tree."""
    stored = PLACES.tobytes() + INDICES.tobytes()
    tree = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(stored)}],
        "bufferViews": [
            {"buffer": 0, "byteLength": PLACES.nbytes},
            {"buffer": 0, "byteOffset": PLACES.nbytes, "byteLength": INDICES.nbytes},
        ],
        "accessors": [places(3000), {"bufferView": 1, "componentType": 5125, "count": 3000, "type": "SCALAR"}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "nodes": [{"mesh": 0}],
        "scenes": [{"nodes": [0]}],
        **changes,
    }
    return packed(json.dumps(tree).encode(), stored)


def packed(head: bytes, stored: bytes) -> bytes:
    head += b" " * (-len(head) % 4)
    length = 28 + len(head) + len(stored)
    chunks = struct.pack("<2I", len(head), 0x4E4F534A) + head + struct.pack("<2I", len(stored), 0x4E4942) + stored
    return struct.pack("<3I", 0x46546C67, 2, length) + chunks


def places(count: int, **more: Any) -> dict[str, Any]:
    return {"bufferView": 0, "componentType": 5126, "count": count, "type": "VEC3", **more}


# ---------------------------------------------------------------- what is read
@pytest.mark.parametrize("suffix", MESHES)
def test_meshes_of_every_format(tmp_path: Path, suffix: str):
    file = tmp_path / f"ball{suffix}"
    if suffix == ".gltf":
        files = BALL.export(file_type="gltf")
        tree = json.loads(files["model.gltf"])
        for each in tree["buffers"]:
            each["uri"] = "data:application/octet-stream;base64," + base64.b64encode(files[each["uri"]]).decode()
        file.write_text(json.dumps(tree))
    else:
        BALL.export(file)
    found = read_surface(file)
    assert found.faces is not None
    np.testing.assert_allclose(found.box, [[-1] * 3, [1] * 3], atol=1e-6)
    np.testing.assert_allclose(
        np.sort(found.points[found.faces].mean(1), 0), np.sort(BALL.triangles_center, 0), atol=1e-5
    )


def test_texts_of_stl_and_ply_and_the_other_byte_order(tmp_path: Path):
    big = TRIANGLE.replace("ascii", "binary_big_endian").encode() + b"end_header\n"
    for name, data in (
        ("a.stl", BALL.export(file_type="stl_ascii").encode()),
        ("a.ply", BALL.export(file_type="ply", encoding="ascii")),
        (
            "b.ply",
            big + np.array([0, 0, 0, 1, 0, 0, 0, 1, 0], ">f4").tobytes() + b"\3" + np.arange(3, dtype=">i4").tobytes(),
        ),
        ("solid.stl", b"solid".ljust(80) + struct.pack("<I12fH", 1, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0)),
    ):
        (tmp_path / name).write_bytes(data)
        found = read_surface(tmp_path / name)
        assert found.faces is not None
        assert len(found.faces) == (80 if name.startswith("a") else 1)


def test_nodes_of_gltf_place_their_meshes(tmp_path: Path):
    nodes = [{"children": [1, 2], "scale": [2, 2, 2]}, {"mesh": 0}, {"mesh": 0, "translation": [5, 0, 0]}]
    (tmp_path / "a.glb").write_bytes(glb(nodes=nodes))
    found = read_surface(tmp_path / "a.glb")
    expected = np.concatenate([2 * PLACES, 2 * (PLACES + np.float32([5, 0, 0]))])
    np.testing.assert_allclose(np.sort(found.points, 0), np.sort(expected, 0), atol=1e-5)


@pytest.mark.parametrize("suffix", CLOUDS)
def test_clouds_of_every_format(tmp_path: Path, suffix: str):
    rows = "\n".join(" ".join(map(str, row)) for row in BALL.vertices) + "\n"
    before = {".xyz": "x y z\n", ".pts": f"{len(BALL.vertices)}\n", ".pcd": PCD.format(len(BALL.vertices), "ascii")}
    (tmp_path / f"ball{suffix}").write_text(before[suffix] + rows)
    found = read_surface(tmp_path / f"ball{suffix}")
    assert found.faces is None
    np.testing.assert_allclose(found.points, BALL.vertices, atol=1e-6)


# ---------------------------------------------------------------- what is not
@pytest.mark.parametrize("name", ["a.3mf", "a.dae", "a.zip", "a.tar.gz", "a.stl.bz2", "a.dxf", "a"])
def test_only_listed_formats_are_opened(tmp_path: Path, name: str):
    refused(tmp_path / name, "PK\3\4", "is none of .ply")


@pytest.mark.parametrize("link", ["fifo", "/dev/zero"])
def test_pipes_and_devices_are_not_waited_for(tmp_path: Path, link: str):
    file = tmp_path / "a.ply"
    os.mkfifo(file) if link == "fifo" else file.symlink_to(link)
    with pytest.raises(InputError, match="There is no file"):
        read_surface(file)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("", "no header of a PLY"),
        ("ply\nformat ascii 1.0\nelement face\nend_header\n", "has the line 'element face'"),
        ("ply\nformat ascii 1.0\n" + "element vertex 1\n" * 80, "no header of a PLY"),
        ("ply\nformat ascii 1.0\n" + "element vertex 1\n" * 2 + "end_header\n", "has the line 'element vertex 1'"),
        (TRIANGLE.replace("float x", "quux x") + "end_header\n", "has the line 'property quux x'"),
        (TRIANGLE.replace("vertex 3", "vertex 1000000000") + "end_header\n" + CORNERS, "6000000002 bytes or more, 19"),
        (TRIANGLE.replace("vertex 3", "vertex -3") + "end_header\n" + CORNERS, "has the line 'element vertex -3'"),
        (TRIANGLE + "element more 5\nend_header\n" + CORNERS + "3 0 1 2\n", "some without properties"),
        (TRIANGLE + "end_header\n" + CORNERS + "3 0 1 99\n", "a face has vertex 99, of 3"),
        (TRIANGLE + "end_header\n" + CORNERS + "3 0 1 -1\n", "a face has vertex -1, of 3"),
        (TRIANGLE + "end_header\n" + CORNERS.replace("1", "1e38") + "3 0 1 2\n", r"a coordinate is 1e\+38"),
        (TRIANGLE + "end_header\n" + CORNERS.replace("1", "nan") + "3 0 1 2\n", "a coordinate is nan"),
        (TRIANGLE + "end_header\n" + "1 1 1\n" * 3 + "3 0 1 2\n", "extent of 0"),
    ],
)
def test_ply_that_cannot_be(tmp_path: Path, text: str, sentence: str):
    refused(tmp_path / "a.ply", text, sentence)


def test_ply_in_bytes_that_cannot_be(tmp_path: Path):
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {{}}\n{XYZ}end_header\n"
    refused(tmp_path / "a.ply", head.format(10**12), "needs 12000000000000 bytes or more, 1 follow")
    for kind, first in (("float", struct.pack("<f", 1e9)), ("int", struct.pack("<i", -1)), ("uint", b"\xff" * 4)):
        listed = head.format(1).replace("property float x", f"property list {kind} float x")
        refused(tmp_path / "a.ply", listed.encode() + first + bytes(20), "cannot be read as a mesh")


@pytest.mark.parametrize(
    ("name", "data", "sentence"),
    [
        ("a.obj", "v 0 0 0\nf 1 2 999\n", "out of bounds"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -1 -2 -99\n", "-99"),
        ("a.obj", "v 0 0 0\nv 1 0 0\n", "no faces|no points"),
        ("a.off", "OFF\n999999999999 1 0\n0 0 0\n", "cannot reshape"),
        (
            "a.off",
            "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n",
            "face index outside the range|a face has vertex 7, of 3",
        ),
        ("a.stl", b"\0" * 80 + struct.pack("<I", 0xFFFFFFFF) + b"\0" * 50, "no points"),
        ("a.stl", "solidendsolid" * 1000, "no points"),
        ("a.xyz", "1 2\n3 4\n", "cannot be read"),
        ("a.xyz", "", "no points"),
        ("a.pcd", "", "no header of a PCD"),
        ("a.pcd", PCD.format(10**12, "ascii"), "needs 5999999999999 bytes or more, 0 follow"),
        ("a.pcd", PCD.format(10**12, "binary"), "needs 12000000000000 bytes or more, 0 follow"),
        ("a.pcd", PCD.format(10**6, "binary_compressed").encode() + struct.pack("<2I", 10, 12 * 10**6), "12000000"),
        ("a.pcd", PCD.format(1, "binary").replace("COUNT 1 1", "COUNT 1 99999").encode() + bytes(99), "cannot be"),
    ],
)
def test_other_formats_that_cannot_be(tmp_path: Path, name: str, data: str | bytes, sentence: str):
    refused(tmp_path / name, data, sentence)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"buffers": [{"uri": "http://127.0.0.1:9/x", "byteLength": 1}]}, "refers to another file, http://127"),
        ({"buffers": [{"uri": "../../etc/passwd", "byteLength": 1}]}, "refers to another file, ../../etc"),
        ({"accessors": [places(10**12)] * 2}, "it says that it holds"),
        ({"accessors": [places(-1)] * 2}, "it says that it holds"),
        ({"accessors": [{**places(10**9), "bufferView": 7}] * 2}, "it says that it holds"),
        ({"accessors": [{"componentType": 5126, "count": 10**9, "type": "VEC3"}] * 2}, "compressed or sparse"),
        ({"bufferViews": [{"buffer": 0, "byteLength": 36000}] * 9000}, "it says that it holds 324000000 bytes"),
        ({"meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}] * 2000}]}, "repeats its meshes"),
        ({"nodes": [{"mesh": 0}] * 3000, "scenes": [{"nodes": list(range(3000))}]}, "repeats its meshes"),
        ({"nodes": [{"mesh": 0, "children": [0]}]}, "or in a circle"),
        ({"nodes": [{"children": [i + 1]} for i in range(200)] + [{"mesh": 0}]}, "more than 100 deep"),
        ({"nodes": [{"mesh": 0, "scale": [1e300, 1, 1]}]}, "a coordinate is"),
        ({"accessors": [places(3), {**places(3000), "type": "SCALAR", "componentType": 5125, "bufferView": 1}]},
         "a face has vertex 2999, of 3"),
    ],
)  # fmt: skip
def test_gltf_that_cannot_be(tmp_path: Path, changes: dict[str, Any], sentence: str):
    refused(tmp_path / "a.glb", glb(**changes), sentence)


def test_glb_cut_off_anywhere_and_nested_deep(tmp_path: Path):
    whole = BALL.export(file_type="glb")
    for end in range(0, len(whole), 13):
        refused(tmp_path / "a.glb", whole[:end], "cannot be read as a mesh")
    refused(tmp_path / "a.glb", packed(b"[" * 100_000, b""), "nested too deeply")
    refused(tmp_path / "a.gltf", '{"asset":' + "[" * 100_000, "nested too deeply")


def test_what_a_mesh_names_is_not_opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Materials, textures and pictures are no part of the surface."""
    import PIL.Image

    def refuse(*_: Any, **__: Any) -> None:
        raise AssertionError("a picture was opened")

    monkeypatch.setattr(PIL.Image, "open", refuse)
    os.mkfifo(tmp_path / "x")
    textured = TRIANGLE.replace("1.0\n", "1.0\ncomment TextureFile x\n", 1) + "end_header\n" + CORNERS + "3 0 1 2\n"
    pictured = glb(
        images=[{"uri": "x"}, {"uri": "data:image/png;base64,JSFQUw=="}],
        textures=[{"source": 1}],
        materials=[{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
    )
    for name, data in (
        ("a.obj", f"mtllib x\nv {CORNERS[:-1]}".replace("\n", "\nv ").replace("v v", "v") + "\nusemtl m\nf 1 2 3\n"),
        ("a.ply", textured),
        ("a.glb", pictured),
    ):
        (tmp_path / name).write_bytes(data if isinstance(data, bytes) else data.encode())
        assert read_surface(tmp_path / name).faces is not None


@pytest.mark.parametrize(
    "text",
    ["", "a " * 16, "1 " * 15, "1 " * 400_000, "nan " * 16, "0 " * 16, "1e300 0 0 0 0 1e300 0 0 0 0 1e300 0 0 0 0 1",
     "1 0 0 1e20 0 1 0 0 0 0 1 0 0 0 0 1", "1 0 0 0 0 1 0 0 0 0 1 0 1 2 3 4"],
)  # fmt: skip
def test_matrices_that_cannot_be(tmp_path: Path, text: str):
    (tmp_path / "m.txt").write_text(text)
    with pytest.raises(InputError, match=r"holds no 4 x 4 numbers|The matrix in"):
        read_matrix(tmp_path / "m.txt")


def test_more_points_than_memory_has_are_not_drawn():
    ball = Surface(BALL.vertices, BALL.faces)
    with pytest.raises(ValueError, match="at most 20000000 are drawn"):
        measure(ball, ball, sampling=Sampling(spacing=1e-9))
    with pytest.raises(ValueError, match="too wide apart for cubes"):
        measure(Surface(BALL.vertices), ball, sampling=Sampling(spacing=1e-12))


def test_faces_without_area_have_no_normals():
    flat = Surface(np.concatenate([BALL.vertices, np.zeros((3, 3))]), np.concatenate([BALL.faces, [[42, 43, 44]] * 9]))
    found = measure(flat, flat, sampling=Sampling(2000))
    assert found.accuracy_normals is not None
    assert np.isfinite([found.accuracy.max, found.accuracy_normals.mean_deg]).all()
