"""Export: frames, handedness, and each file read back by another program."""

from __future__ import annotations

import json
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rigs import shell
from tetrahedron import (
    COLORS,
    CORNERS,
    FACES,
    UP,
    WORLD,
    color_of,
    expect_marks,
    packed_image,
    rotation_about,
    tetrahedron,
    to_gltf,
    workspace,
)
from validators import gltf_reports, usd_errors

from configs.params import ExportParams
from stages import artifacts
from stages.artifacts import AtlasMesh
from stages.engine.fingerprint import Identity
from stages.engine.manifest import Manifest
from stages.engine.stage import StageContext
from stages.errors import ReconstructionError, SystemRequirementError
from stages.export import EXPORT
from stages.files.contents import Textures
from stages.files.glb import glb_bytes, read_glb, shapes_glb_bytes
from stages.files.obj import obj_text
from stages.files.ply_stl import ply_bytes
from stages.geometry.place import Place
from stages.geometry.similarity import Similarity
from stages.geometry.up import y_up_rotation
from stages.surface.placing import unit_normals


@pytest.fixture
def exported(tmp_path) -> tuple[Path, dict]:
    context = workspace(tmp_path)
    return context.out, EXPORT.run(context)


def test_numbers(exported):
    folder, numbers = exported
    assert numbers["faces"] == 4
    np.testing.assert_allclose(numbers["extent"], np.ptp(WORLD.apply(CORNERS), axis=0), atol=1e-5)
    for suffix in ("glb", "usdz", "obj", "ply", "stl"):
        assert (folder / f"model.{suffix}").stat().st_size == numbers["bytes"][suffix]


def test_glb_read_by_trimesh_is_y_up_and_not_mirrored(exported):
    import trimesh

    mesh = trimesh.load(exported[0] / "model.glb", force="mesh", process=False)
    texture = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
    assert mesh.visual.material.metallicFactor == 0
    centers = np.asarray(mesh.visual.uv)[mesh.faces].mean(1)  # trimesh turns v back to a bottom-left origin
    expect_marks(np.asarray(mesh.vertices), np.asarray(mesh.faces), color_of(texture, centers), to_gltf)
    assert mesh.volume > 0
    up = to_gltf(np.array([UP, np.zeros(3)]))
    np.testing.assert_allclose((up[0] - up[1]) / WORLD.scale, [0, 1, 0], atol=1e-9)
    outward = np.asarray(mesh.vertex_normals)
    assert ((np.asarray(mesh.vertices) - mesh.vertices.mean(0)) * outward).sum(1).min() > 0


def test_glb_names_normals_occlusion_and_the_frame_they_are_for(exported):
    import trimesh

    mesh = trimesh.load(exported[0] / "model.glb", force="mesh", process=False)
    assert np.asarray(mesh.visual.material.normalTexture).reshape(-1, 3)[0].tolist() == [128, 128, 255]
    assert np.asarray(mesh.visual.material.occlusionTexture).ravel()[0] == 200
    data = (exported[0] / "model.glb").read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    tree = json.loads(data[20 : 20 + length])
    accessor = tree["accessors"][tree["meshes"][0]["primitives"][0]["attributes"]["TANGENT"]]
    view = tree["bufferViews"][accessor["bufferView"]]
    assert (accessor["type"], accessor["count"]) == ("VEC4", 12)
    tangents = np.frombuffer(data, np.float32, 48, 28 + length + view["byteOffset"]).reshape(12, 4)
    for face in mesh.faces:  # the charts' u runs from the first corner to the second
        along_u = mesh.vertices[face[1]] - mesh.vertices[face[0]]
        np.testing.assert_allclose(tangents[face, :3], np.tile(along_u / np.linalg.norm(along_u), (3, 1)), atol=1e-5)
        assert (tangents[face, 3] == 1).all()


def test_files_do_without_normals_and_occlusion_that_were_not_baked(tmp_path):
    context = workspace(tmp_path)
    artifacts.NORMAL_MAP.load(context.inputs["bake"]).unlink()
    artifacts.OCCLUSION.load(context.inputs["bake"]).unlink()
    EXPORT.run(context)
    data = artifacts.asset_path(context.out, "glb").read_bytes()
    for word in (b"TANGENT", b"normalTexture", b"occlusionTexture"):
        assert word not in data
    assert "norm" not in artifacts.asset_path(context.out, "mtl").read_text()
    assert not artifacts.obj_map_path(context.out, "normal").exists()


def test_mtl_names_the_normal_map(exported):
    lines = (exported[0] / "model.mtl").read_text().splitlines()
    assert {"norm model_normal.png", "map_bump model_normal.png"} <= set(lines)
    assert (exported[0] / "model_normal.png").read_bytes().startswith(b"\x89PNG")


def test_glb_read_by_open3d(exported):
    import open3d as o3d

    model = o3d.io.read_triangle_model(str(exported[0] / "model.glb"))
    mesh = model.meshes[0].mesh
    texture = np.asarray(model.materials[0].albedo_img)
    assert texture.shape[:2] == (32, 32)
    assert len(mesh.triangles) == 4
    assert mesh.has_triangle_uvs()
    np.testing.assert_allclose(np.asarray(mesh.vertices).min(0), to_gltf(CORNERS).min(0), atol=1e-4)


def test_ply_read_by_open3d_is_coloured(exported):
    import open3d as o3d

    mesh = o3d.io.read_triangle_mesh(str(exported[0] / "model.ply"))
    assert (len(mesh.vertices), len(mesh.triangles)) == (4, 4)
    assert mesh.has_vertex_normals()
    near = [int(np.argmin(np.linalg.norm(np.asarray(mesh.vertices) - p, axis=1))) for p in WORLD.apply(CORNERS)]
    for k, vertex in enumerate(near):
        expected = COLORS[(k == FACES).any(1)].mean(0)
        np.testing.assert_allclose(np.asarray(mesh.vertex_colors)[vertex] * 255, expected, atol=1.1)


def test_levels_of_detail_have_the_same_textures_and_place(tmp_path):
    import trimesh

    context = workspace(tmp_path, ExportParams(formats=("glb",), lods=2))
    numbers = EXPORT.run(context)
    assert numbers["lod_faces"] == [4, 4]  # a tetrahedron cannot lose any
    assert sorted(p.name for p in context.out.iterdir()) == ["model.glb", "model_lod1.glb", "model_lod2.glb"]
    for level in (1, 2):
        path = artifacts.lod_path(context.out, level)
        mesh = trimesh.load(path, force="mesh", process=False)
        texture = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"))
        centers = np.asarray(mesh.visual.uv)[mesh.faces].mean(1)
        expect_marks(np.asarray(mesh.vertices), np.asarray(mesh.faces), color_of(texture, centers), to_gltf)
        assert mesh.visual.material.normalTexture is not None
        assert numbers["bytes"][f"lod{level}"] == path.stat().st_size


def test_collision_pieces_read_by_trimesh_and_open3d(tmp_path):
    import open3d as o3d
    import trimesh

    pytest.importorskip("coacd")
    context = workspace(tmp_path, ExportParams(formats=("glb",), collision="hulls"))
    numbers = EXPORT.run(context)
    assert numbers["collision_pieces"] == 1  # a tetrahedron is convex
    scene = trimesh.load(artifacts.collision_path(context.out))
    assert list(scene.geometry) == ["UCX_model_00"]
    piece = scene.to_mesh()
    assert piece.is_watertight
    assert piece.is_convex
    expected = trimesh.load(context.out / "model.glb", force="mesh")
    assert piece.volume == pytest.approx(expected.volume, rel=1e-3)
    np.testing.assert_allclose(piece.bounds, expected.bounds, atol=1e-3)
    other = o3d.io.read_triangle_mesh(str(artifacts.collision_path(context.out)))
    assert len(other.triangles) == len(piece.faces)


def test_without_coacd_the_command_to_get_it_is_named(tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "coacd", None)
    with pytest.raises(SystemRequirementError) as caught:
        EXPORT.run(workspace(tmp_path, ExportParams(formats=(), collision="hulls")))
    assert "pip install coacd" in caught.value.hint


def test_the_glb_says_its_units_and_where_on_earth_it_is(tmp_path):
    context = workspace(tmp_path)
    assert extras_of(context)["units"] == "arbitrary units"
    model = Similarity(3.0, np.eye(3), np.array([1.0, 2, 3]))
    located = Place(model, True, "GPS", 0.01, (47.0, 8.5, 400.0), 1.2)
    for place, units in ((Place(model), "arbitrary units"), (located, "metres")):
        artifacts.WORLD_PLACE.save(context.inputs["place"], place)
        extras = extras_of(context)
        assert extras["units"] == units
        np.testing.assert_allclose(extras["world_from_model"], model.matrix())
    assert extras["scale_from"] == "GPS"
    assert extras["scale_relative_error"] == 0.01
    assert extras["world_origin"] == {"latitude_deg": 47.0, "longitude_deg": 8.5, "altitude_m": 400.0}
    assert extras["gps_residual_m"] == 1.2
    for name in ("model.obj", "model.ply"):
        head = (context.out / name).read_bytes()[:300].decode("ascii")
        assert "Lengths are in metres +- 1 %, from GPS. The origin is at latitude 47.000000" in head
    import trimesh

    assert len(trimesh.load(context.out / "model.ply", process=False).faces) == 4


def test_where_on_earth_it_lies_is_beside_the_files(tmp_path):
    context = workspace(tmp_path)
    EXPORT.run(context)
    beside = {name: context.out / name for name in (artifacts.GEOREFERENCE, artifacts.METADATA)}
    assert not any(file.exists() for file in beside.values())
    place = Place(Similarity.identity(), True, "GPS", 0.01, (47.0, 8.5, 400.0), 1.2)
    artifacts.WORLD_PLACE.save(context.inputs["place"], place)
    EXPORT.run(context)
    said = json.loads(beside[artifacts.GEOREFERENCE].read_text())
    assert said["origin"] == {"latitude_deg": 47.0, "longitude_deg": 8.5, "altitude_m": 400.0}
    assert "<SRS>ENU:47.000000000,8.500000000</SRS>" in beside[artifacts.METADATA].read_text()
    assert all(artifacts.ASSET.covers(name) for name in beside)
    in_grid = replace(place, origin=None, crs="EPSG:32632", offset=(465000.0, 5200000.0, 400.0))
    artifacts.WORLD_PLACE.save(context.inputs["place"], in_grid)
    assert extras_of(context)["world_crs"] == "EPSG:32632"
    assert json.loads(beside[artifacts.GEOREFERENCE].read_text())["offset"] == [465000.0, 5200000.0, 400.0]


def extras_of(context: StageContext) -> dict:
    EXPORT.run(context)
    data = artifacts.asset_path(context.out, "glb").read_bytes()
    return json.loads(data[20 : 20 + struct.unpack("<I", data[12:16])[0]])["asset"]["extras"]


def test_obj_read_by_pymeshlab_is_in_the_world_frame(exported):
    pymeshlab = pytest.importorskip("pymeshlab")
    import cv2

    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(exported[0] / "model.obj"))
    mesh = meshes.current_mesh()
    assert mesh.texture_number() == 1  # found through the MTL
    texture = cv2.imread(str(exported[0] / "model.png"))[..., ::-1]
    centers = mesh.wedge_tex_coord_matrix().reshape(-1, 3, 2).mean(1)
    expect_marks(mesh.vertex_matrix(), mesh.face_matrix(), color_of(texture, centers), WORLD.apply)


def test_obj_read_by_open3d_has_its_texture(exported):
    import open3d as o3d

    mesh = o3d.io.read_triangle_mesh(str(exported[0] / "model.obj"), enable_post_processing=True)
    assert mesh.has_triangle_uvs()
    assert len(mesh.textures) == 1
    assert len(mesh.triangles) == 4


def test_obj_read_by_trimesh(exported):
    import trimesh

    mesh = trimesh.load(exported[0] / "model.obj", process=False)
    texture = np.asarray(mesh.visual.material.image.convert("RGB"))
    centers = np.asarray(mesh.visual.uv)[mesh.faces].mean(1)
    expect_marks(np.asarray(mesh.vertices), np.asarray(mesh.faces), color_of(texture, centers), WORLD.apply)


def test_ply_read_by_pymeshlab_is_joined_and_coloured(exported):
    pymeshlab = pytest.importorskip("pymeshlab")

    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(exported[0] / "model.ply"))
    mesh = meshes.current_mesh()
    assert (mesh.vertex_number(), mesh.face_number()) == (4, 4)
    order = [int(np.argmin(np.linalg.norm(mesh.vertex_matrix() - p, axis=1))) for p in WORLD.apply(CORNERS)]
    np.testing.assert_allclose(mesh.vertex_matrix()[order], WORLD.apply(CORNERS), atol=1e-5)
    for k, vertex in enumerate(order):  # a corner has the mean colour of its three faces
        expected = COLORS[(k == FACES).any(1)].mean(0)
        np.testing.assert_allclose(mesh.vertex_color_matrix()[vertex, :3] * 255, expected, atol=1.1)


def test_ply_read_by_trimesh_is_watertight(exported):
    import trimesh

    mesh = trimesh.load(exported[0] / "model.ply", process=False)
    assert mesh.is_watertight
    assert mesh.volume > 0
    assert mesh.visual.kind == "vertex"


def test_stl_read_by_trimesh_and_open3d_is_the_same_solid(exported):
    import open3d as o3d
    import trimesh

    mesh = trimesh.load(exported[0] / "model.stl")
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(trimesh.load(exported[0] / "model.ply", process=False).volume, rel=1e-5)
    other = o3d.io.read_triangle_mesh(str(exported[0] / "model.stl"))
    assert len(other.triangles) == 4
    np.testing.assert_allclose(np.asarray(other.vertices).max(0), WORLD.apply(CORNERS).max(0), atol=1e-5)


def test_usdz_read_by_pxr_is_y_up_in_metres_and_not_mirrored(exported):
    from pxr import Usd, UsdGeom, UsdShade

    stage = Usd.Stage.Open(str(exported[0] / "model.usdz"))
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    extras = json.loads(stage.GetRootLayer().customLayerData["hineus"])
    assert extras["units"] == "arbitrary units"
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/model/mesh"))
    points, faces = np.array(mesh.GetPointsAttr().Get()), np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    uvs = np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Get())
    material, _ = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()
    surface = material.ComputeSurfaceSource("")[0]
    files = {}
    for name in ("diffuseColor", "normal", "occlusion"):
        source = surface.GetInput(name).GetConnectedSources()[0][0].source
        shader = UsdShade.Shader(source.GetPrim())
        files[name] = shader.GetInput("file").Get().resolvedPath
    expect_marks(points, faces, color_of(packed_image(files["diffuseColor"]), uvs[faces].mean(1)), to_gltf)
    assert packed_image(files["normal"])[0, 0].tolist() == [128, 128, 255]
    assert packed_image(files["occlusion"])[0, 0].tolist() == [200, 200, 200]


def test_usdz_passes_all_validators_of_usd(exported):
    assert usd_errors(exported[0] / "model.usdz") == []


def test_usdz_is_packed_as_arkit_asks(exported):
    import zipfile

    with zipfile.ZipFile(exported[0] / "model.usdz") as package:
        entries = package.infolist()
    assert [entry.filename for entry in entries] == ["model.usdc", "base_color.png", "normal.png", "occlusion.png"]
    data = (exported[0] / "model.usdz").read_bytes()
    for entry in entries:
        assert entry.compress_type == zipfile.ZIP_STORED
        name, extra = struct.unpack_from("<HH", data, entry.header_offset + 26)
        assert (entry.header_offset + 30 + name + extra) % 64 == 0


def test_without_usd_core_the_command_to_get_it_is_named(tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(SystemRequirementError) as caught:
        EXPORT.run(workspace(tmp_path))
    assert "pip install usd-core" in caught.value.hint


def test_only_the_wanted_formats_are_written(tmp_path):
    context = workspace(tmp_path, ExportParams(formats=("glb",)))
    EXPORT.run(context)
    assert [p.name for p in context.out.iterdir()] == ["model.glb"]


def test_glb_tells_the_way_back_to_the_world(exported):
    data = (exported[0] / "model.glb").read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    asset = json.loads(data[20 : 20 + length])["asset"]
    assert asset["generator"].startswith("hineus")
    turn = np.array(asset["extras"]["gltf_from_world_rotation"])
    np.testing.assert_allclose(WORLD.apply(CORNERS) @ turn.T, to_gltf(CORNERS))


def test_glb_names_the_run_it_comes_from(tmp_path):
    context = workspace(tmp_path)
    assert "run" not in extras_of(context)
    baked = Manifest(Identity("bake", 1, {}), {})
    assert extras_of(replace(context, manifests={"bake": baked}))["run"] == baked.identity.fingerprint


def test_gltf_validator_finds_nothing(tmp_path):
    context = workspace(tmp_path, ExportParams(formats=("glb",), lods=1))
    EXPORT.run(context)
    corners = {"UCX_model_00": (CORNERS, FACES), "UCX_model_01": (CORNERS + 1, FACES)}
    artifacts.collision_path(context.out).write_bytes(shapes_glb_bytes(corners, extras={"photos": 1}))
    files = [
        artifacts.asset_path(context.out, "glb"),
        artifacts.lod_path(context.out, 1),
        artifacts.collision_path(context.out),
    ]
    assert [report["info"]["totalTriangleCount"] for report in gltf_reports(files)] == [4, 4, 8]


@given(st.lists(st.floats(-1, 1), min_size=3, max_size=3).filter(lambda v: np.linalg.norm(v) > 1e-2))
def test_up_turns_to_y_by_a_proper_rotation(up):
    up = np.array(up) / np.linalg.norm(up)
    rotation = y_up_rotation(up)
    np.testing.assert_allclose(rotation @ up, [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
    assert np.linalg.det(rotation) == pytest.approx(1)


def test_up_at_the_poles():
    np.testing.assert_allclose(y_up_rotation(np.array([0.0, 1, 0])), np.eye(3))
    down = y_up_rotation(np.array([0.0, -1, 0]))
    np.testing.assert_allclose(down @ [0, -1, 0], [0, 1, 0])
    assert np.linalg.det(down) == pytest.approx(1)


def test_normals_without_length_are_mended():
    atlas, _ = tetrahedron()
    broken = atlas.normals.copy()
    broken[4] = 0
    broken[7] = np.nan
    mended = unit_normals(atlas.vertices, broken, atlas.faces)
    np.testing.assert_allclose(mended, atlas.normals, atol=1e-6)


@pytest.mark.parametrize("image", [b"\x89PNG of some length", b"\xff\xd8\xff\xe0 JPEG"])
def test_a_glb_is_read_as_it_was_written(image):
    atlas, _ = tetrahedron()
    data = glb_bytes(atlas, Textures(image, normal=b"\x89PNG"), extras={"photos": 3})
    mesh, found = read_glb(data)
    assert found == image
    for name in ("vertices", "normals", "faces"):
        np.testing.assert_array_equal(getattr(mesh, name), getattr(atlas, name))
    np.testing.assert_allclose(mesh.uvs, atlas.uvs, atol=1e-7)
    kind = b"image/jpeg" if image.startswith(b"\xff") else b"image/png"
    assert kind in data


def test_what_is_no_glb_of_ours_is_refused():
    atlas, _ = tetrahedron()
    data = glb_bytes(atlas, Textures(b"\x89PNG"))
    bare = shapes_glb_bytes({"shape": (atlas.vertices, atlas.faces)})
    for wrong in (
        b"",
        b"glTF",
        data[:200],
        data[:1500],
        b"x" + data[1:],
        bare,
        data.replace(b"TEXCOORD_0", b"TEXCOORD_9"),
    ):
        with pytest.raises(ValueError, match="no GLB of one textured mesh"):
            read_glb(wrong)


def test_wrong_arrays_are_refused():
    atlas, _ = tetrahedron()
    with pytest.raises(ValueError, match="unit normals"):
        glb_bytes(replace(atlas, normals=atlas.normals * 2), Textures(b""))
    with pytest.raises(ValueError, match=r"vertices in \[0, 12\)"):
        obj_text(replace(atlas, faces=atlas.faces + 5), "m.mtl")
    with pytest.raises(ValueError, match="finite"):
        glb_bytes(replace(atlas, vertices=atlas.vertices * np.nan), Textures(b""))


def test_ply_header_counts():
    atlas, _ = tetrahedron()
    data = ply_bytes(atlas.vertices, atlas.normals, np.zeros((12, 3)), atlas.faces)
    header, body = data.split(b"end_header\n")
    assert b"element vertex 4\n" in header
    assert len(body) == 4 * (24 + 3) + 4 * 13


def test_a_mesh_that_cannot_be_written_is_explained(tmp_path):
    context = workspace(tmp_path)
    atlas, _ = tetrahedron()
    artifacts.ATLAS_MESH.save(
        context.inputs["atlas"], AtlasMesh(atlas.vertices, atlas.normals, atlas.uvs, atlas.faces[:0], 32)
    )
    with pytest.raises(ReconstructionError, match="cannot be exported"):
        EXPORT.run(context)


# ---------------------------------------------------------------- dense points
POINTS = ExportParams(formats=("points",), points_trust=0.0)


def test_dense_points_lie_where_the_mesh_lies(tmp_path):
    import laspy
    import open3d as o3d

    context = workspace(tmp_path, POINTS)
    place = Place(Similarity(3.0, rotation_about(UP, 0.4), np.array([1.0, 2, 3])), metric=True)
    artifacts.WORLD_PLACE.save(context.inputs["place"], place)
    numbers = EXPORT.run(context)
    assert {path.name for path in context.out.iterdir()} == {"points.ply", "points.laz"}
    assert numbers["points"] == 400
    assert numbers["bytes"] == {f"points_{path.suffix[1:]}": path.stat().st_size for path in context.out.iterdir()}
    expected = place.world_from_poses.compose(WORLD).apply(shell().points)
    found = o3d.io.read_point_cloud(str(context.out / "points.ply"))
    np.testing.assert_allclose(found.points, expected, atol=1e-4)
    outward = shell().normals @ WORLD.rotation.T @ place.world_from_poses.rotation.T
    np.testing.assert_allclose(found.normals, outward, atol=1e-5)
    assert b"comment Lengths are in metres" in (context.out / "points.ply").read_bytes()
    np.testing.assert_allclose(laspy.read(context.out / "points.laz").xyz, expected, atol=1e-4)


def test_only_the_laz_has_the_map_s_own_coordinates(tmp_path):
    import laspy
    import open3d as o3d

    context = workspace(tmp_path, POINTS)
    offset = (465000.0, 5247000.0, 400.0)
    # poses that were given in the map's coordinates
    cloud = replace(shell(), points=shell().points + offset)
    artifacts.POINT_CLOUD.save(context.inputs["densify"], cloud)
    there = Similarity(1.0, np.eye(3), np.array(offset))
    scene = artifacts.SCENE.load(context.inputs["train"])
    artifacts.SCENE.save(context.inputs["train"], replace(scene, poses_from_scene=there))
    place = Place(there.inverse(), metric=True, crs="EPSG:32632", offset=offset)
    artifacts.WORLD_PLACE.save(context.inputs["place"], place)
    EXPORT.run(context)
    found = laspy.read(context.out / "points.laz")
    assert found.header.parse_crs().to_epsg() == 32632
    np.testing.assert_allclose(found.xyz, cloud.points, rtol=0, atol=1e-5)
    near = np.asarray(o3d.io.read_point_cloud(str(context.out / "points.ply")).points)
    np.testing.assert_allclose(near, shell().points, atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "kept"),
    [
        ({"points_trust": 0.75}, lambda cloud, away: cloud.trust >= 0.75),
        ({}, lambda cloud, away: away < 1),
        ({"points_from": "everywhere"}, lambda cloud, away: away > 0),
    ],
)
def test_untrusted_points_and_those_around_the_region_are_left_out(tmp_path, changes, kept):
    import open3d as o3d

    context = workspace(tmp_path, POINTS.model_copy(update=changes))
    cloud = shell()
    away = np.where(np.arange(400) % 2 > 0, 0.9, 1.1)
    cloud = replace(cloud, points=cloud.points / 0.7 * away[:, None])
    if "points_trust" in changes:
        cloud, away = shell(), np.full(400, 0.7)
    artifacts.POINT_CLOUD.save(context.inputs["densify"], cloud.moved(WORLD))
    rows = kept(cloud, away)
    assert 0 < EXPORT.run(context)["points"] == rows.sum()
    found = np.asarray(o3d.io.read_point_cloud(str(context.out / "points.ply")).points)
    np.testing.assert_allclose(found, WORLD.apply(cloud.points[rows]), atol=1e-4)


def test_a_box_that_was_given_crops_the_points_as_the_mesh(tmp_path):
    from stages.geometry.place import given_region

    context = workspace(tmp_path, POINTS)
    box = WORLD.translation + np.array([[-3, -3, -0.2], [3, 3, 0.5]])
    artifacts.GIVEN_REGION.save(
        context.inputs["place"], given_region("box", box.ravel().tolist(), Similarity.identity())
    )
    heights = shell().points @ WORLD.rotation[2] * WORLD.scale
    assert 0 < EXPORT.run(context)["points"] == ((heights > -0.2) & (heights < 0.5)).sum() < 400


def test_points_too_far_for_the_laz_are_told(tmp_path):
    import laspy
    import open3d as o3d

    context = workspace(tmp_path, ExportParams(formats=("points",), points_trust=0.0, points_from="everywhere"))
    points = shell().points.copy()
    points[:2] *= 1e6
    artifacts.POINT_CLOUD.save(context.inputs["densify"], replace(shell(), points=points))
    numbers = EXPORT.run(context)
    (warning,) = numbers["warnings"]
    assert "lacks the 2 dense points" in warning["sentence"]
    assert numbers["points"] == len(o3d.io.read_point_cloud(str(context.out / "points.ply")).points) == 400
    found = laspy.read(context.out / "points.laz")
    np.testing.assert_allclose(found.xyz, points[2:], atol=1e-5)


def test_without_points_no_file_is_written_and_it_is_said_why(tmp_path):
    from stages.geometry.point_cloud import PointCloud

    context = workspace(tmp_path, ExportParams(formats=("points",), points_trust=1.0))
    (warning,) = EXPORT.run(context)["warnings"]
    assert "of 400 none is trusted enough" in warning["sentence"]
    assert "--set export.points_trust=0 --set export.points_from=everywhere" in warning["command"]
    artifacts.POINT_CLOUD.save(context.inputs["densify"], PointCloud.empty())
    numbers = EXPORT.run(context)
    assert (numbers["points"], numbers["bytes"]) == (0, {})
    assert "no photos overlap enough" in numbers["warnings"][0]["sentence"]
    assert list(context.out.iterdir()) == []


def test_without_laspy_the_command_to_get_it_is_named(tmp_path, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, "laspy", None)
    with pytest.raises(SystemRequirementError) as caught:
        EXPORT.run(workspace(tmp_path, POINTS))
    assert "pip install laspy" in caught.value.hint
