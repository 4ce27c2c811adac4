"""The dense point cloud as files: read back by programs that are not ours."""

from __future__ import annotations

import datetime
import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rigs import shell

from stages.files.points import laz_bytes, points_ply_bytes
from stages.geometry.point_cloud import PointCloud

UTM = (465123.0, 5247811.0, 410.0)


@pytest.fixture
def ply(tmp_path: Path) -> Path:
    path = tmp_path / "points.ply"
    path.write_bytes(points_ply_bytes(shell(), "metres +- 1 %"))
    return path


def test_open3d_reads_the_ply(ply: Path) -> None:
    import open3d as o3d

    cloud, found = shell(), o3d.t.io.read_point_cloud(str(ply)).point
    np.testing.assert_allclose(found["positions"].numpy(), cloud.points, atol=1e-7)
    np.testing.assert_allclose(found["normals"].numpy(), cloud.normals, atol=1e-7)
    np.testing.assert_array_equal(found["colors"].numpy(), cloud.colors)
    np.testing.assert_allclose(found["quality"].numpy()[:, 0], cloud.trust, atol=1e-7)
    np.testing.assert_array_equal(found["photos"].numpy()[:6, 0], [1, 2, 3, 4, 1, 2])


def test_meshlab_and_trimesh_read_the_ply(ply: Path) -> None:
    import pymeshlab
    import trimesh

    cloud, meshes = shell(), pymeshlab.MeshSet()
    meshes.load_new_mesh(str(ply))
    found = meshes.current_mesh()
    np.testing.assert_allclose(found.vertex_matrix(), cloud.points, atol=1e-7)
    np.testing.assert_allclose(found.vertex_normal_matrix(), cloud.normals, atol=1e-7)
    np.testing.assert_allclose(255 * found.vertex_color_matrix()[:, :3], cloud.colors, atol=0.01)
    np.testing.assert_allclose(found.vertex_scalar_array(), cloud.trust, atol=1e-7)
    np.testing.assert_array_equal(trimesh.load(ply).colors[:, :3], cloud.colors)
    assert b"\ncomment metres +- 1 %\n" in ply.read_bytes()


def test_laspy_reads_the_laz_in_its_coordinate_system() -> None:
    import laspy

    cloud = shell()
    found = laspy.read(io.BytesIO(laz_bytes(cloud, UTM, "EPSG:32632", "hineus 0.1.0")[0]))
    assert found.header.parse_crs().to_epsg() == 32632
    assert found.header.global_encoding.wkt
    assert found.header.vlrs.get("WktCoordinateSystemVlr")[0].string.startswith("PROJCS[")  # not PROJCRS
    assert (str(found.header.version), found.point_format.id) == ("1.4", 7)
    assert found.header.are_points_compressed
    assert found.header.generating_software == "hineus 0.1.0"
    np.testing.assert_allclose(found.xyz, cloud.points + UTM, rtol=0, atol=1e-6)  # a float32 would miss by 0.25 m
    np.testing.assert_array_equal(np.stack([found.red, found.green, found.blue], 1) // 257, cloud.colors)
    assert found.red.max() > 65000
    normals = np.stack([found["NormalX"], found["NormalY"], found["NormalZ"]], 1)
    np.testing.assert_allclose(normals, cloud.normals, atol=1e-6)
    np.testing.assert_allclose(found["trust"], cloud.trust, atol=1e-6)
    np.testing.assert_array_equal(found["photos"], np.diff(cloud.starts))


def test_without_a_coordinate_system_the_laz_names_none() -> None:
    import laspy

    found = laspy.read(io.BytesIO(laz_bytes(shell())[0]))
    assert found.header.parse_crs() is None
    np.testing.assert_allclose(found.xyz, shell().points, atol=1e-6)


@given(st.floats(-6, 6), st.floats(0, 9))
@settings(max_examples=30, deadline=None)
def test_whole_numbers_suffice_for_any_size_and_any_stray(size: float, stray: float) -> None:
    import laspy

    cloud = shell(20, 10**size)
    points = cloud.points.copy()
    points[0] *= 10**stray
    data, lacking = laz_bytes(replace(cloud, points=points))
    found = laspy.read(io.BytesIO(data))
    away = np.abs(points[0]).max() / 10**size
    assert lacking == 0 if away < 1e3 else lacking == 1 if away > 3e4 else lacking in (0, 1)
    # a hundred-thousandth of the usual distance, however far the stray
    assert np.abs(found.xyz - points[lacking:]).max() <= 1e-5 * 10**size
    np.testing.assert_array_equal(found["photos"], np.diff(cloud.starts)[lacking:])


def test_each_point_is_its_pulses_one_return() -> None:
    import laspy

    found = laspy.read(io.BytesIO(laz_bytes(shell())[0]))
    assert (found.return_number == 1).all()
    assert (found.number_of_returns == 1).all()
    assert found.header.number_of_points_by_return.tolist() == [400] + 14 * [0]


def test_the_laz_is_the_same_on_another_day(monkeypatch: pytest.MonkeyPatch) -> None:
    import laspy.header

    today = laz_bytes(shell())

    class Tomorrow(datetime.date):
        @classmethod
        def today(cls) -> Tomorrow:
            return cls(2099, 1, 2)

    monkeypatch.setattr(laspy.header, "date", Tomorrow)
    assert laz_bytes(shell()) == today


def test_a_cloud_at_one_place_and_none_at_all() -> None:
    import laspy

    one = shell(1)
    np.testing.assert_allclose(laspy.read(io.BytesIO(laz_bytes(one)[0])).xyz, one.points, atol=1e-3)
    with pytest.raises(ValueError, match="got 0"):
        laz_bytes(PointCloud.empty())
