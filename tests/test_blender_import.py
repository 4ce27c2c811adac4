"""The Blender benchmark: what it calls missing, and a real import where Blender is there."""

from __future__ import annotations

import json
import shutil
import subprocess
from pathlib import Path

import light_in_blender
import numpy as np
import pytest

from benchmarks import blender_import
from stages.artifacts import AtlasMesh
from stages.files.contents import Textures
from stages.files.glb import glb_bytes, shapes_glb_bytes
from stages.light.environment import directions

CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])


def image() -> bytes:
    import cv2

    return cv2.imencode(".png", np.full((4, 4, 3), 128, np.uint8))[1].tobytes()


def written(path: Path, textures: Textures) -> Path:
    normals = np.tile([0.0, 0.0, 1.0], (4, 1))
    path.write_bytes(glb_bytes(AtlasMesh(CORNERS, normals, CORNERS[:, :2], FACES, 4), textures))
    return path


@pytest.fixture
def model(tmp_path: Path) -> Path:
    return written(tmp_path / "model.glb", Textures(image(), image(), image()))


@pytest.fixture
def material(tmp_path: Path) -> Path:
    return written(tmp_path / "material.glb", Textures(image(), image(), orm=image()))


FULL = {"meshes": 1, "triangles": 4, "uv_layers": 1, "images": {"Base Color": "", "Normal": "", "Occlusion": ""}}


def test_what_the_file_has_and_blender_does_not_is_missing(model: Path, tmp_path: Path) -> None:
    assert blender_import.missing(model, FULL) == []
    assert blender_import.missing(model, {**FULL, "images": {"Base Color": ""}}) == ["Normal", "Occlusion"]
    assert blender_import.missing(model, {**FULL, "triangles": 0, "uv_layers": 0}) == ["mesh", "UVs"]
    bare = tmp_path / "bare.glb"
    bare.write_bytes(shapes_glb_bytes({"shape": (CORNERS, FACES)}))
    assert blender_import.missing(bare, {**FULL, "uv_layers": 0, "images": {}}) == []


def test_a_map_in_another_channel_is_missing(material: Path) -> None:
    surface = {"Roughness": "orm 4x4 Non-Color Green", "Metallic": "orm 4x4 Non-Color Blue"}
    assert blender_import.missing(material, {**FULL, "images": {**FULL["images"], **surface}}) == []
    assert blender_import.missing(material, FULL) == ["Roughness", "Metallic"]
    surface["Metallic"] = "orm 4x4 Non-Color Red"
    assert blender_import.missing(material, {**FULL, "images": {**FULL["images"], **surface}}) == ["Metallic"]


def test_without_blender_it_says_how_to_get_it(model: Path, monkeypatch, capsys) -> None:
    monkeypatch.setenv("PATH", str(model.parent))
    assert blender_import.main([str(model)]) == 2
    assert "apt-get install blender" in capsys.readouterr().err


def test_blender_takes_mesh_and_textures(model: Path) -> None:
    blender = shutil.which("blender")
    if blender is None:
        pytest.skip("needs Blender")
    found = blender_import.import_model(blender, model, None)
    assert blender_import.missing(model, found) == []
    assert found["triangles"] == 4
    np.testing.assert_allclose(found["size"], [1, 1, 1], atol=1e-4)


@pytest.mark.slow
def test_blender_has_the_four_maps_where_they_belong(material: Path) -> None:
    blender = shutil.which("blender")
    if blender is None:
        pytest.skip("needs Blender")
    assert blender_import.import_model(blender, material, None)["images"] == {
        "Base Color": "base_color 4x4 sRGB",
        "Normal": "normal 4x4 Non-Color",
        "Occlusion": "occlusion_roughness_metallic 4x4 Non-Color Red",
        "Roughness": "occlusion_roughness_metallic 4x4 Non-Color Green",
        "Metallic": "occlusion_roughness_metallic 4x4 Non-Color Blue",
    }


@pytest.mark.slow
def test_blender_takes_the_light_without_a_turn(tmp_path: Path) -> None:
    import OpenEXR

    blender = shutil.which("blender")
    if blender is None:
        pytest.skip("needs Blender")
    light = tmp_path / "light.exr"  # whose radiance says where it comes from
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": directions(32) + 1}).write(str(light))
    script = ["--python", light_in_blender.__file__, "--", str(light), str(tmp_path)]
    command = [blender, "--background", "--factory-startup", "--python-exit-code", "1", *script]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    (seen,) = [line for line in done.stdout.splitlines() if line.startswith(light_in_blender.MARK)]
    found = np.array(json.loads(seen.removeprefix(light_in_blender.MARK))) - 1
    np.testing.assert_allclose(found, light_in_blender.TOWARDS, atol=5e-3)
