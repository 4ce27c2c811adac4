"""Two meshes held against each other: spheres and boxes whose distances are known, and the command."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest
import trimesh

from stages.errors import InputError
from stages.meshing.comparing import THRESHOLDS, align_by_icp, compare_surfaces, distance_colors, plane_step


def sphere(radius: float = 1.0, center=(0.0, 0, 0)) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(4, radius)
    return mesh.vertices + np.array(center), np.asarray(mesh.faces)


def slab(turn_deg: float = 0.0, shift=(0.0, 0, 0)) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.box((1.0, 2.0, 0.5))
    angle = np.radians(turn_deg)
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return mesh.vertices @ turn.T + np.array(shift), np.asarray(mesh.faces)


def test_spheres_in_each_other_are_their_radii_apart():
    found = compare_surfaces(sphere(1.0), sphere(1.01), samples=20_000)
    for way in (found.a_to_b, found.b_to_a):
        assert way.mean == pytest.approx(0.01, abs=1e-3)
        assert way.median == pytest.approx(0.01, abs=1e-3)
        assert way.max < 0.012
    assert found.extent == pytest.approx(2.02)
    # 0.01 lies between 0.2 % and 1 % of the extent
    assert [found.f_scores[t] for t in THRESHOLDS] == pytest.approx([0, 50, 100, 100], abs=50)
    assert found.f_scores[0.002] == 0
    assert found.f_scores[0.01] == 100


def test_what_one_mesh_lacks_shows_in_one_direction_only():
    vertices, faces = sphere()
    half = faces[(vertices[faces][:, :, 2] >= -1e-9).all(1)]
    found = compare_surfaces((vertices, half), (vertices, faces), samples=20_000)
    assert found.a_to_b.max < 1e-4
    assert found.b_to_a.max == pytest.approx(np.sqrt(2), abs=0.05)  # from the far pole to the rim
    assert found.f_scores[0.002] == pytest.approx(200 / 3, abs=2)  # all of one, half of the other


def test_a_mesh_far_from_the_origin_is_measured_as_well():
    far = np.array([1e5, -2e5, 3e4])
    found = compare_surfaces(sphere(1.0, far), sphere(1.0, far), samples=5000)
    assert found.a_to_b.max < 1e-4


def test_icp_finds_the_way_back():
    moved, still = slab(8.0, (0.05, -0.04, 0.03)), slab()
    motion = align_by_icp(moved, still)
    np.testing.assert_allclose(motion.apply(moved[0]), still[0], atol=5e-3)
    assert motion.scale == 1.0


def test_a_step_undoes_a_small_motion_and_leaves_what_planes_cannot_tell():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(200, 3))
    normals = np.eye(3)[rng.integers(0, 3, 200)]
    shift = np.array([0.1, -0.2, 0.3])
    step = plane_step(points, np.tile(shift, (200, 1)), normals)
    np.testing.assert_allclose(step.apply(points), points + shift, atol=1e-9)
    upward = np.tile([0.0, 0, 1], (200, 1))  # one plane says nothing of motion within it
    step = plane_step(points, np.tile([0.0, 0, 0.3], (200, 1)), upward)
    np.testing.assert_allclose(step.translation, [0, 0, 0.3], atol=1e-9)


def test_colours_run_from_blue_to_red():
    near, far, beyond = distance_colors(np.array([0.1, 1.0, 9.0]), 1.0).astype(int)
    assert near[2] > near[0]
    assert far[0] > far[2]
    assert (far == beyond).all()


# ---------------------------------------------------------------- the command
def hineus(*args: str, monkeypatch, capsys) -> tuple[int, str]:
    from hineus_cli import app

    monkeypatch.setattr(sys, "argv", ["hineus", *args])
    with pytest.raises(SystemExit) as ended:
        app.main()
    return int(ended.value.code or 0), capsys.readouterr().out


def test_the_command_tells_numbers_and_writes_the_map(tmp_path, monkeypatch, capsys):
    workspace = tmp_path / "run"
    (workspace / "export").mkdir(parents=True)
    for path, mesh in ((tmp_path / "a.stl", sphere(1.0)), (workspace / "export" / "model.ply", sphere(1.1))):
        trimesh.Trimesh(*mesh, process=False).export(path)
    colored = tmp_path / "map.ply"
    arguments = ("compare", str(tmp_path / "a.stl"), str(workspace), "--map", str(colored))
    code, out = hineus(*arguments, "--json", monkeypatch=monkeypatch, capsys=capsys)
    found = json.loads(out)
    assert (code, found["ok"], found["alignment"]) == (0, True, "same frame")
    assert found["a_to_b"]["mean"] == pytest.approx(0.1, abs=2e-3)
    assert len(trimesh.load(colored, process=False).faces) == len(sphere()[1])
    code, out = hineus(*arguments, "--icp", monkeypatch=monkeypatch, capsys=capsys)
    assert code == 0
    assert "moved onto B by ICP" in out


def test_what_is_no_mesh_is_explained(tmp_path):
    from hineus_cli.comparison import mesh_path, read_mesh

    with pytest.raises(InputError, match=r"holds no exported PLY") as caught:
        mesh_path(tmp_path)
    assert "hineus export" in caught.value.hint
    (tmp_path / "a.ply").write_text("no mesh")
    for name in ("a.ply", "absent.ply", "a.docx"):
        with pytest.raises(InputError, match="cannot be read as a mesh"):
            read_mesh(tmp_path / name)
