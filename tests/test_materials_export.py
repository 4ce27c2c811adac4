"""Assets with materials: each map where it belongs in each format, as other programs read it; the light beside."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tetrahedron import COLORS, WORLD, color_of, expect_marks, packed_image, to_gltf, workspace
from validators import gltf_reports, usd_errors

from configs.params import ExportParams
from stages import artifacts
from stages.artifacts import write_png
from stages.engine.fingerprint import Identity
from stages.engine.manifest import Manifest
from stages.engine.stage import StageContext
from stages.errors import SystemRequirementError
from stages.export import EXPORT
from stages.files.contents import Textures
from stages.files.obj import roughness_and_metalness
from stages.geometry.place import Place
from stages.geometry.similarity import Similarity
from stages.light.environment import directions
from stages.light.harmonics import project

# Occlusion, roughness and metalness of the texture's quarters, one for each face.
PACKED = np.array([[210, 30, 0], [220, 90, 255], [230, 150, 40], [240, 200, 255]], np.uint8)
LIGHT_ROWS = 8


def quarters(values: np.ndarray) -> np.ndarray:
    """A 32² image of one value [3] for each quarter."""
    return np.kron(values.reshape(2, 2, 3), np.ones((16, 16, 1), np.uint8))


def radiance() -> np.ndarray:
    """A light that is told from its mirror images, and brighter than 1."""
    return (2 + directions(LIGHT_ROWS) @ np.diag([1.0, 0.5, 0.25])).astype(np.float32) ** 3


def with_materials(tmp_path: Path, params: ExportParams | None = None) -> StageContext:
    """The tetrahedron as the stage materials leaves it, its faces half as bright as the photos' texture."""
    import cv2
    import OpenEXR

    context = workspace(tmp_path, params)
    folder, light = context.inputs["materials"], radiance()
    write_png(artifacts.MATERIAL_COLOR.load(folder), quarters(COLORS // 2))
    write_png(artifacts.ORM.load(folder), quarters(PACKED))
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, {"RGB": light}).write(str(artifacts.LIGHT.load(folder)))
    artifacts.LIGHT_HDR.load(folder).write_bytes(cv2.imencode(".hdr", light[..., ::-1])[1].tobytes())
    artifacts.write_json(artifacts.LIGHT_HARMONICS.load(folder), {"degree_2": project(light, 2).tolist()})
    return context


@pytest.fixture
def context(tmp_path) -> StageContext:
    found = with_materials(tmp_path)
    EXPORT.run(found)
    return found


def expect_maps(shown: dict[str, np.ndarray]) -> None:
    """Values of each map [4] or [4, 3] by name, face by face: the material's own."""
    np.testing.assert_array_equal(shown.pop("color"), COLORS // 2)
    for channel, name in enumerate(("occlusion", "roughness", "metallic")):
        if name in shown:
            np.testing.assert_array_equal(shown.pop(name), PACKED[:, channel])
    assert shown == {}


def centres(mesh) -> np.ndarray:
    return np.asarray(mesh.visual.uv)[mesh.faces].mean(1)


def test_glb_read_by_trimesh_has_each_map_in_its_channel(context):
    import trimesh

    mesh = trimesh.load(context.out / "model.glb", force="mesh", process=False)
    material = mesh.visual.material
    assert (material.metallicFactor, material.roughnessFactor) == (1, 1)
    surface = color_of(np.asarray(material.metallicRoughnessTexture.convert("RGB")), centres(mesh))
    occlusion = color_of(np.asarray(material.occlusionTexture.convert("RGB")), centres(mesh))
    color = color_of(np.asarray(material.baseColorTexture.convert("RGB")), centres(mesh))
    expect_maps({"color": color, "roughness": surface[:, 1], "metallic": surface[:, 2], "occlusion": occlusion[:, 0]})
    assert np.asarray(material.normalTexture).reshape(-1, 3)[0].tolist() == [128, 128, 255]
    expect_marks(np.asarray(mesh.vertices), np.asarray(mesh.faces), color * 2, to_gltf)


def test_one_image_serves_for_occlusion_roughness_and_metalness(context):
    data = (context.out / "model.glb").read_bytes()
    tree = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    (material,) = tree["materials"]
    packed = material["pbrMetallicRoughness"]["metallicRoughnessTexture"]
    assert material["occlusionTexture"] == packed
    assert [image["name"] for image in tree["images"]] == ["base_color", "occlusion_roughness_metallic", "normal"]
    assert "extensionsUsed" not in tree


def test_levels_of_detail_have_the_material_too(tmp_path):
    import trimesh

    context = with_materials(tmp_path, ExportParams(formats=("glb",), lods=1))
    EXPORT.run(context)
    mesh = trimesh.load(artifacts.lod_path(context.out, 1), force="mesh", process=False)
    surface = np.asarray(mesh.visual.material.metallicRoughnessTexture.convert("RGB"))
    np.testing.assert_array_equal(color_of(surface, centres(mesh)), PACKED)


def test_gltf_validator_finds_nothing_in_a_material(context):
    (report,) = gltf_reports([artifacts.asset_path(context.out, "glb")])
    assert report["info"]["materialCount"] == 1
    assert len([each for each in report["info"]["resources"] if each.get("mimeType") == "image/png"]) == 3


def test_usdz_read_by_pxr_has_each_map_in_its_channel(context):
    assert usd_errors(context.out / "model.usdz") == []
    expect_maps(usd_maps(context.out / "model.usdz"))


def usd_maps(path: Path) -> dict[str, np.ndarray]:
    """Values of each map of a USDZ's mesh, face by face."""
    from pxr import Usd, UsdGeom, UsdShade

    stage = Usd.Stage.Open(str(path))
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/model/mesh"))
    uvs = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Get()).reshape(-1, 3, 2).mean(1)
    surface = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()[0].ComputeSurfaceSource("")[0]
    names = {"diffuseColor": "color", "roughness": "roughness", "metallic": "metallic", "occlusion": "occlusion"}
    shown = {}
    for name in names:
        ((source,), _) = surface.GetInput(name).GetConnectedSources()
        shader = UsdShade.Shader(source.source.GetPrim())
        assert shader.GetInput("sourceColorSpace").Get() == ("sRGB" if name == "diffuseColor" else "raw")
        values = color_of(packed_image(shader.GetInput("file").Get().resolvedPath), uvs)
        shown[names[name]] = values if source.sourceName == "rgb" else values[:, "rgb".index(str(source.sourceName))]
    return shown


def test_obj_read_by_open3d_has_roughness_and_metalness(context):
    import open3d as o3d

    model = o3d.io.read_triangle_model(str(context.out / "model.obj"))
    (material,) = model.materials
    assert (material.base_roughness, material.base_metallic) == (1, 1)
    uvs = np.asarray(model.meshes[0].mesh.triangle_uvs).reshape(-1, 3, 2).mean(1)
    images = {"color": material.albedo_img, "roughness": material.roughness_img, "metallic": material.metallic_img}
    in_file = {name: np.asarray(image).reshape(32, 32, -1) for name, image in images.items()}
    assert [in_file[name].shape[2] for name in ("roughness", "metallic")] == [1, 1]
    order = np.argsort(uvs @ [1, -2])  # the quarters, row by row
    shown = {name: color_of(image, uvs)[order] for name, image in in_file.items()}
    expect_maps({name: values if name == "color" else values[:, 0] for name, values in shown.items()})


def test_mtl_read_by_trimesh_names_the_maps(context):
    import trimesh

    kwargs = trimesh.load(context.out / "model.obj", process=False).visual.material.kwargs
    named = {word: kwargs[word] for word in ("pr", "pm", "map_pr", "map_pm", "norm")}
    assert named == {
        "pr": ["1"], "pm": ["1"], "map_pr": ["model_roughness.png"], "map_pm": ["model_metallic.png"],
        "norm": ["model_normal.png"],
    }  # fmt: skip


def test_ply_has_the_material_s_colours(context):
    import trimesh

    mesh = trimesh.load(context.out / "model.ply", process=False)
    corner = np.linalg.norm(mesh.vertices - WORLD.apply(np.array([[0.5, 0.4, 0.3]])), axis=1).argmin()
    np.testing.assert_allclose(mesh.visual.vertex_colors[corner, :3], (COLORS[:3] // 2).mean(0), atol=1.1)


def test_the_light_lies_beside_the_files(context):
    import cv2
    import OpenEXR

    exr = OpenEXR.File(str(artifacts.light_path(context.out, "exr"))).channels()["RGB"].pixels
    np.testing.assert_array_equal(exr, radiance())
    hdr = cv2.imread(str(artifacts.light_path(context.out, "hdr")), cv2.IMREAD_UNCHANGED)[..., ::-1]
    shared = radiance().max(axis=2, keepdims=True)  # of a pixel's exponent; the rest has eight bits
    np.testing.assert_allclose(hdr / shared, radiance() / shared, atol=1 / 64)
    said = json.loads(artifacts.light_path(context.out, "json").read_text())
    np.testing.assert_allclose(said["degree_2"], project(radiance(), 2))
    assert artifacts.ASSET.covers("model_light.json")


def test_without_a_learned_material_nothing_is_said_of_one(tmp_path):
    context = workspace(tmp_path)
    write_png(artifacts.ORM.load(context.inputs["materials"]), quarters(PACKED))  # of no use without its colours
    EXPORT.run(context)
    assert b"metallicRoughnessTexture" not in (context.out / "model.glb").read_bytes()
    assert "map_Pr" not in (context.out / "model.mtl").read_text()
    assert not list(context.out.glob("model_light*"))


def test_glb_names_the_run_that_made_the_material(context):
    manifests = {name: Manifest(Identity(name, 1, {}), {}) for name in ("bake", "materials")}
    EXPORT.run(replace(context, manifests=manifests))
    assert manifests["materials"].identity.fingerprint.encode() in (context.out / "model.glb").read_bytes()


def test_an_unreadable_map_is_refused():
    with pytest.raises(ValueError, match="readable"):
        roughness_and_metalness(b"no image")
    with pytest.raises(ValueError, match="got both"):
        Textures(b"", occlusion=b"", orm=b"")


# ---------------------------------------------------------------- for simulators
SIMULATION = ExportParams(formats=(), simulation="usd")


def need_coacd() -> None:
    import open3d  # noqa: F401 - it cannot be imported after coacd

    pytest.importorskip("coacd")


@pytest.fixture
def simulated(tmp_path) -> tuple[StageContext, dict]:
    need_coacd()
    context = with_materials(tmp_path, SIMULATION)
    artifacts.WORLD_PLACE.save(context.inputs["place"], Place(Similarity.identity(), metric=True))
    return context, EXPORT.run(context)


@pytest.mark.filterwarnings("ignore:LoadUsdPhysicsFromRange")  # the oldest version we admit knows only this name
def test_simulators_get_shapes_to_hit_a_scene_and_the_material(simulated):
    from pxr import Usd, UsdGeom, UsdPhysics

    context, numbers = simulated
    path = artifacts.simulation_path(context.out)
    assert numbers["bytes"]["simulation"] == path.stat().st_size
    assert "warnings" not in numbers
    assert usd_errors(path) == []
    expect_maps(usd_maps(path))
    stage = Usd.Stage.Open(str(path))
    assert (UsdGeom.GetStageUpAxis(stage), UsdGeom.GetStageMetersPerUnit(stage)) == ("Y", 1.0)
    assert UsdPhysics.GetStageKilogramsPerUnit(stage) == 1.0
    found = UsdPhysics.LoadUsdPhysicsFromRange(stage, ["/"])  # the library's own reader for simulators
    kinds = UsdPhysics.ObjectType
    assert set(found) == {kinds.Scene, kinds.MeshShape}
    paths, (shape,) = found[kinds.MeshShape]
    assert [str(each) for each in paths] == ["/model/collision/piece_00"]  # a tetrahedron is convex
    assert (shape.approximation, shape.collisionEnabled, str(shape.rigidBody)) == ("convexHull", True, "")
    ((scene,),) = found[kinds.Scene][1:]
    np.testing.assert_allclose(scene.gravityDirection, [0, -1, 0])
    assert scene.gravityMagnitude == pytest.approx(9.81)
    piece = UsdGeom.Mesh(stage.GetPrimAtPath("/model/collision/piece_00"))
    assert piece.ComputePurpose() == UsdGeom.Tokens.guide
    visual = UsdGeom.Mesh(stage.GetPrimAtPath("/model/mesh"))
    extents = [np.array(each.GetExtentAttr().Get()) for each in (piece, visual)]
    np.testing.assert_allclose(*extents, atol=1e-3)


@pytest.mark.filterwarnings("ignore:LoadUsdPhysicsFromRange")
def test_what_refers_to_the_file_as_docs_howto_says_is_a_body_that_falls(simulated, tmp_path, monkeypatch):
    from pxr import Usd, UsdPhysics

    text = (Path(__file__).parents[1] / "docs" / "howto.md").read_text()
    (lines,) = [part.split("```")[0] for part in text.split("```python\n") if "RigidBodyAPI" in part]
    monkeypatch.chdir(simulated[0].out)
    exec(lines, {})
    assert usd_errors(Path("falling.usda")) == []
    found = UsdPhysics.LoadUsdPhysicsFromRange(Usd.Stage.Open("falling.usda"), ["/"])
    kinds = UsdPhysics.ObjectType
    assert set(found) == {kinds.RigidBody, kinds.MeshShape}  # neither the file's scene nor its light
    ((shape,),) = found[kinds.MeshShape][1:]
    assert str(shape.rigidBody) == "/model"


def test_simulators_get_the_light_turned_as_usd_reads_it(simulated):
    from pxr import Usd, UsdGeom, UsdLux

    stage = Usd.Stage.Open(str(artifacts.simulation_path(simulated[0].out)))
    assert stage.GetDefaultPrim().GetPath() == "/model"  # so the light stays out of scenes that refer to the file
    dome = UsdLux.DomeLight(stage.GetPrimAtPath("/light"))
    assert dome.GetTextureFileAttr().Get().resolvedPath.endswith("[light.exr]")
    # UsdLux: longitude falls from pi at the left border; at 0 it is +Z, at pi / 2 it is +X
    longitude = np.pi * (1 - (np.arange(2 * LIGHT_ROWS) + 0.5) / LIGHT_ROWS)
    latitude = np.pi / 2 - np.pi * (np.arange(LIGHT_ROWS) + 0.5) / LIGHT_ROWS
    level = np.stack([np.sin(longitude), 0 * longitude, np.cos(longitude)], axis=1)
    read = np.cos(latitude)[:, None, None] * level + np.sin(latitude)[:, None, None] * [0, 1, 0]
    turn = np.array(UsdGeom.Xformable(dome).ComputeLocalToWorldTransform(Usd.TimeCode.Default()))[:3, :3]
    np.testing.assert_allclose(read @ turn, directions(LIGHT_ROWS), atol=1e-6)  # row vectors, as USD has them


def test_simulators_do_without_light_and_are_told_of_unknown_lengths(tmp_path):
    need_coacd()
    from pxr import Usd

    context = workspace(tmp_path, SIMULATION)
    (warning,) = EXPORT.run(context)["warnings"]
    assert "read the lengths" in warning["sentence"]
    assert "place.known_distance" in warning["command"]
    stage = Usd.Stage.Open(str(artifacts.simulation_path(context.out)))
    assert not stage.GetPrimAtPath("/light")
    assert stage.GetPrimAtPath("/model/collision/piece_00")


def test_without_usd_core_the_command_to_get_it_is_named(tmp_path, monkeypatch):
    import sys

    need_coacd()
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(SystemRequirementError) as caught:
        EXPORT.run(workspace(tmp_path, SIMULATION))
    assert "pip install usd-core" in caught.value.hint
