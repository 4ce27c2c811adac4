"""Two meshes held against each other by `hineus compare`."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest
import trimesh

from stages.errors import InputError
from stages.evaluation.distance_map import distance_colors


def sphere(radius: float = 1.0, center=(0.0, 0, 0)) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(4, radius)
    return mesh.vertices + np.array(center), np.asarray(mesh.faces)


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


@pytest.mark.slow
def test_the_command_tells_numbers_and_writes_the_map(tmp_path, monkeypatch, capsys):
    workspace = tmp_path / "run"
    (workspace / "export").mkdir(parents=True)
    for path, mesh in ((tmp_path / "a.stl", sphere(1.0)), (workspace / "export" / "model.ply", sphere(1.1))):
        trimesh.Trimesh(*mesh, process=False).export(path)
    colored = tmp_path / "map.ply"
    arguments = ("compare", str(tmp_path / "a.stl"), str(workspace), "--map", str(colored))
    code, out = hineus(*arguments, "--json", monkeypatch=monkeypatch, capsys=capsys)
    found = json.loads(out)
    assert (code, found["ok"]) == (0, True)
    assert found["accuracy"]["mean"] == pytest.approx(0.1, abs=2e-3)
    assert found["completeness"]["mean"] == pytest.approx(0.1, abs=2e-3)
    assert [score["threshold"] for score in found["f_scores"]] == pytest.approx([0.0044, 0.011, 0.022, 0.044], rel=1e-2)
    assert "alignment: none, taken to be in one frame" in found["done"]
    assert any(line.startswith(f"map: {colored}") for line in found["done"])
    assert len(trimesh.load(colored, process=False).faces) == len(sphere()[1])
    code, out = hineus(*arguments, "--icp", monkeypatch=monkeypatch, capsys=capsys)
    assert code == 0
    assert "rigid point-to-plane ICP" in out
    assert "F-score" in out


@pytest.mark.slow
def test_it_is_evaluate_mesh_by_another_name(tmp_path, monkeypatch, capsys):
    for name, radius in (("a.ply", 1.0), ("b.ply", 1.1)):
        trimesh.Trimesh(*sphere(radius), process=False).export(tmp_path / name)
    files = (str(tmp_path / "a.ply"), str(tmp_path / "b.ply"), "--json")
    outs = [
        json.loads(hineus(*command, *files, monkeypatch=monkeypatch, capsys=capsys)[1])
        for command in (("compare",), ("evaluate", "mesh"))
    ]
    assert outs[0] == outs[1]


def test_a_cloud_cannot_be_coloured(tmp_path, monkeypatch, capsys):
    trimesh.PointCloud(sphere()[0]).export(tmp_path / "a.ply")
    trimesh.Trimesh(*sphere(), process=False).export(tmp_path / "b.ply")
    arguments = ("evaluate", "mesh", str(tmp_path / "a.ply"), str(tmp_path / "b.ply"), "--map", str(tmp_path / "m.ply"))
    code, out = hineus(*arguments, "--json", monkeypatch=monkeypatch, capsys=capsys)
    assert code == 3
    assert "no surface to colour" in json.loads(out)["error"]["message"]


def test_what_is_no_mesh_is_explained(tmp_path):
    from stages.evaluation.reading import mesh_path, read_mesh

    with pytest.raises(InputError, match=r"holds no exported PLY") as caught:
        mesh_path(tmp_path)
    assert "hineus export" in caught.value.hint
    (tmp_path / "a.ply").write_text("no mesh")
    (tmp_path / "a.docx").write_text("no mesh")
    for name, sentence in (
        ("a.ply", "no header of a PLY"),
        ("absent.ply", "There is no file"),
        ("a.docx", "is none of"),
    ):
        with pytest.raises(InputError, match=sentence):
            read_mesh(tmp_path / name)
