"""Files of Gaussians: PLY, SPZ and glTF, each read back by a program that is not ours."""

from __future__ import annotations

import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from made_up_gaussians import some_gaussians
from splat_readers import read_splats, splat_transform
from validators import gltf_reports

from stages.files.splat_files import fraction_bits, splat_glb_bytes, splat_ply_bytes, spz_bytes
from stages.gaussians.gaussians import Gaussians

EXTENSION = "KHR_gaussian_splatting"
COLORS = {"R": 0, "G": 1, "B": 2}


def columns_of(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """By their names in a PLY, spelt out."""
    columns = {axis: gaussians.centers[:, k] for k, axis in enumerate("xyz")}
    columns |= {f"scale_{k}": gaussians.log_scales[:, k] for k in range(3)}
    columns |= {f"rot_{k}": gaussians.rotations[:, k] for k in range(4)}
    columns |= {f"f_dc_{k}": gaussians.harmonics[:, 0, k] for k in range(3)}
    rest = gaussians.harmonics.shape[1] - 1
    for channel in range(3):
        for k in range(rest):
            columns[f"f_rest_{channel * rest + k}"] = gaussians.harmonics[:, 1 + k, channel]
    return columns | {"opacity": gaussians.opacity_logits}


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_ply_read_by_splat_transform(tmp_path, degree):
    gaussians = some_gaussians(40, degree)
    file = tmp_path / "some.ply"
    file.write_bytes(splat_ply_bytes(gaussians, "units: metres"))
    found, expected = read_splats(file, tmp_path), columns_of(gaussians)
    assert expected.keys() <= found.keys()
    assert found.keys() - expected.keys() <= {"nx", "ny", "nz"}
    for name, column in expected.items():
        np.testing.assert_allclose(found[name], column, rtol=1e-6, err_msg=name)


def test_ply_read_by_trimesh_has_all_of_a_gaussian_in_a_row():
    import trimesh

    gaussians = some_gaussians(30)
    data = splat_ply_bytes(gaussians)
    read = trimesh.load(trimesh.util.wrap_as_stream(data), file_type="ply").metadata["_ply_raw"]["vertex"]
    assert list(read["properties"])[:10] == ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "f_rest_0"]
    assert list(read["properties"])[-9:] == ["f_rest_44", "opacity", *(f"scale_{k}" for k in range(3)),
                                             *(f"rot_{k}" for k in range(4))]  # fmt: skip
    for name, column in columns_of(gaussians).items():
        assert (read["data"][name].ravel() == column).all(), name


@pytest.mark.slow
@pytest.mark.parametrize("degree", [0, 3])
def test_spz_read_by_splat_transform_is_as_near_as_its_bytes_come(tmp_path, degree):
    gaussians = some_gaussians(60, degree)
    file = tmp_path / "some.spz"
    file.write_bytes(spz_bytes(gaussians))
    found = read_splats(file, tmp_path)
    grain = 0.5 ** fraction_bits(gaussians.centers)
    expected = columns_of(gaussians)
    for axis in "xyz":
        np.testing.assert_allclose(found[axis], expected[axis], atol=0.51 * grain)
    opacity = 1 / (1 + np.exp(-found["opacity"]))
    np.testing.assert_allclose(opacity, gaussians.opacities, atol=0.51 / 255)
    np.testing.assert_allclose(found["scale_1"], np.clip(expected["scale_1"], -10, -10 + 255 / 16), atol=0.51 / 16)
    quaternions = np.stack([found[f"rot_{k}"] for k in range(4)], axis=1)
    assert np.abs((quaternions * gaussians.rotations).sum(1)).min() > 1 - 1e-5
    for name in (name for name in expected if name.startswith("f_rest")):
        np.testing.assert_allclose(found[name], np.clip(expected[name], -1, 127 / 128), atol=0.51 / 128)
    np.testing.assert_allclose(found["f_dc_2"], expected["f_dc_2"], atol=0.51 / (0.15 * 255))


@given(st.floats(1e-4, 1e5))
@settings(deadline=None)
def test_coordinates_in_spz_have_room_and_all_bits(size):
    fraction = fraction_bits(np.array([[size, 0, -size]]))
    assert size * 2.0**fraction <= 2**23
    assert fraction == 24 or size * 2.0**fraction > 2**22 * 0.99


def test_spz_is_small_and_the_same_each_time():
    gaussians = some_gaussians(2000)
    data = spz_bytes(gaussians)
    assert data == spz_bytes(gaussians)
    assert len(data) < len(splat_ply_bytes(gaussians)) / 3


def tree_and_blob(glb: bytes) -> tuple[dict, bytes]:
    length = struct.unpack_from("<I", glb, 12)[0]
    return json.loads(glb[20 : 20 + length]), glb[28 + length :]


def accessor(tree: dict, blob: bytes, index: int) -> np.ndarray:
    about = tree["accessors"][index]
    start = tree["bufferViews"][about["bufferView"]]["byteOffset"]
    width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[about["type"]]
    assert about["componentType"] == 5126
    return np.frombuffer(blob, "<f4", about["count"] * width, start).reshape(-1, width)


@pytest.mark.slow
def test_glb_has_what_splat_transform_writes_of_the_ply(tmp_path):
    gaussians = some_gaussians(40)
    ply, theirs = tmp_path / "some.ply", tmp_path / "theirs.glb"
    ply.write_bytes(splat_ply_bytes(gaussians))
    # it takes a PLY to stand on its head; half a turn about Z brings it back
    assert splat_transform(ply, "-r", "0,0,180", theirs) == ""
    their_tree, their_blob = tree_and_blob(theirs.read_bytes())
    tree, blob = tree_and_blob(splat_glb_bytes(gaussians))
    assert tree["extensionsUsed"] == [EXTENSION]
    ours, other = tree["meshes"][0]["primitives"][0], their_tree["meshes"][0]["primitives"][0]
    assert ours["mode"] == other["mode"] == 0
    assert ours["extensions"][EXTENSION].items() <= other["extensions"][EXTENSION].items()
    splat_attributes = {name for name in other["attributes"] if name != "COLOR_0"}
    assert splat_attributes == {name for name in ours["attributes"] if name != "COLOR_0"}
    for name in splat_attributes:
        mine, expected = (
            accessor(tree, blob, ours["attributes"][name]),
            accessor(their_tree, their_blob, other["attributes"][name]),
        )
        if name.endswith("ROTATION"):
            assert np.abs((mine * expected).sum(1)).min() > 1 - 1e-5
        else:
            np.testing.assert_allclose(mine, expected, atol=1e-5, err_msg=name)


def test_glb_passes_the_validator_of_gltf_but_for_the_extension_that_it_does_not_know(tmp_path):
    tree, blob = tree_and_blob(splat_glb_bytes(some_gaussians(40), extras={"units": "metres"}))
    del tree["extensionsUsed"]
    primitive = tree["meshes"][0]["primitives"][0]
    del primitive["extensions"]
    # what begins with an underscore is anybody's
    attributes = primitive["attributes"].items()
    primitive["attributes"] = {name.replace(f"{EXTENSION}:", "_SPLAT_"): index for name, index in attributes}
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + len(blob), len(text), b"JSON")
    file = tmp_path / "some.glb"
    file.write_bytes(head + text + struct.pack("<I4s", len(blob), b"BIN\0") + blob)
    gltf_reports([file])


def test_points_have_the_linear_colour_of_all_sides():
    gaussians = some_gaussians(3)
    harmonics = np.zeros((3, 16, 3), np.float32)
    harmonics[:, 0] = (np.array([[0.0, 0.5, 1], [2, -1, 0.2], [0.25, 0.25, 0.25]]) - 0.5) / 0.28209479177387814
    tree, blob = tree_and_blob(splat_glb_bytes(replace(gaussians, harmonics=harmonics)))
    colors = accessor(tree, blob, tree["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"])
    np.testing.assert_allclose(colors[0, :3], [0, 0.2140, 1], atol=1e-4)
    np.testing.assert_allclose(colors[1, :3], [1, 0, 0.0331], atol=1e-4)
    np.testing.assert_allclose(colors[:, 3], gaussians.opacities)


@pytest.mark.parametrize("write", [splat_ply_bytes, spz_bytes, splat_glb_bytes])
def test_what_is_not_finite_or_not_there_is_refused(write):
    gaussians = some_gaussians(5)
    broken = replace(gaussians, log_scales=np.full_like(gaussians.log_scales, np.nan))
    with pytest.raises(ValueError, match="finite log_scales"):
        write(broken)
    with pytest.raises(ValueError, match="got none"):
        write(gaussians.select(np.zeros(0, int)))
