"""Two meshes held against each other by `hineus compare`."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest
import trimesh

from stages.errors import InputError
from stages.evaluation.coloring import distance_colors


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
    assert (code, found["ok"], found["alignment"]) == (0, True, "same frame")
    assert found["a_to_b"]["mean"] == pytest.approx(0.1, abs=2e-3)
    assert len(trimesh.load(colored, process=False).faces) == len(sphere()[1])
    code, out = hineus(*arguments, "--icp", monkeypatch=monkeypatch, capsys=capsys)
    assert code == 0
    assert "moved onto B by ICP" in out


def test_what_is_no_mesh_is_explained(tmp_path):
    from stages.evaluation.comparison import mesh_path, read_mesh

    with pytest.raises(InputError, match=r"holds no exported PLY") as caught:
        mesh_path(tmp_path)
    assert "hineus export" in caught.value.hint
    (tmp_path / "a.ply").write_text("no mesh")
    for name in ("a.ply", "absent.ply", "a.docx"):
        with pytest.raises(InputError, match="cannot be read as a mesh"):
            read_mesh(tmp_path / name)
