"""The continuous check's comparing code, on made-up figures, and its reading of a GLB."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest

from benchmarks import smoke
from benchmarks.smoke import Bound, judge, load_bounds, record, table
from stages.geometry.up import y_up_rotation


def _bound(value, better, slack):
    return Bound(value, better, slack, "made up")


@pytest.mark.parametrize(
    ("better", "found", "holds"),
    [
        ("higher", 18.0, True),  # just inside
        ("higher", 17.9, False),
        ("higher", 99.0, True),  # better is never a failure
        ("lower", 22.0, True),
        ("lower", 22.1, False),
        ("lower", 0.0, True),
        ("same", 18.0, True),
        ("same", 22.1, False),
        ("same", 17.9, False),
    ],
)
def test_a_figure_may_be_worse_by_the_slack_and_no_more(better, found, holds):
    assert _bound(20.0, better, 2.0).holds(found) is holds


@pytest.mark.parametrize("better", ["higher", "lower", "same"])
def test_not_a_number_never_holds(better):
    assert not _bound(1.0, better, 1e9).holds(float("nan"))


def test_a_bound_that_says_nothing_is_refused():
    with pytest.raises(ValueError, match="got bigger"):
        _bound(1.0, "bigger", 1.0)
    with pytest.raises(ValueError, match="slack >= 0"):
        _bound(1.0, "same", -1.0)


def test_figures_that_are_missing_or_not_recorded_fail():
    verdicts = judge({"a": 1.0, "new": 2.0}, {"a": _bound(1.0, "same", 0.0), "gone": _bound(3.0, "lower", 1.0)})
    assert [(verdict.figure, verdict.passed) for verdict in verdicts] == [("a", True), ("gone", False), ("new", False)]
    lines = table(verdicts).splitlines()
    assert lines[1].split() == ["a", "1", "1", "1", "ok"]
    assert "missing" in lines[2]
    assert "<= 4" in lines[2]
    assert lines[2].split()[-1] == "FAILED"
    assert "not recorded" in lines[3]


def test_recording_changes_the_values_only(tmp_path):
    path = tmp_path / "bounds.json"
    bounds = {"a": _bound(1.0, "higher", 0.5)}
    record({"a": 2.00004}, bounds, path)
    assert load_bounds(path) == {"a": _bound(2.0, "higher", 0.5)}
    with pytest.raises(ValueError, match="expected the figures"):
        record({"b": 2.0}, bounds, path)


def test_every_committed_bound_has_a_reason():
    for name, bound in load_bounds(smoke.EXPECTED).items():
        assert len(bound.why) > 15, name


@pytest.mark.parametrize(("found", "code"), [(1.0, 0), (3.0, 1)])
def test_the_command_fails_when_a_figure_left_its_bounds(found, code, tmp_path, monkeypatch, capsys):
    path = tmp_path / "bounds.json"
    path.write_text(json.dumps({"distance": {"value": 1.0, "better": "lower", "slack": 0.5, "why": "made up"}}))
    monkeypatch.setattr(smoke, "EXPECTED", path)
    monkeypatch.setattr(smoke, "measure", lambda folder: {"distance": found})
    monkeypatch.setattr("sys.argv", ["smoke"])
    assert smoke.main() == code
    assert ("out of bounds: distance" in capsys.readouterr().out) is bool(code)


def test_a_glb_is_read_back_into_the_frame_it_came_from(tmp_path):
    from PIL import Image

    from stages.artifacts import AtlasMesh
    from stages.files.contents import Textures
    from stages.files.glb import glb_bytes

    vertices = np.array([[0, 0, 0], [1, 0, 0.2], [0.3, 1, 0], [0.1, 0.2, 1]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]])
    uvs = np.array([[0, 0], [1, 0], [0, 1], [0.5, 0.25]])
    up = np.array([0.2, 0.3, 0.93]) / np.linalg.norm([0.2, 0.3, 0.93])
    turn = y_up_rotation(up)
    world_from_scene = np.eye(4)
    world_from_scene[:3] = np.hstack([3 * np.eye(3)[[1, 2, 0]], [[1], [2], [3]]])
    png = io.BytesIO()
    texture = np.zeros((8, 8, 3), np.uint8)
    texture[0, :, 0] = 255  # the top row, v = 1, is red
    Image.fromarray(texture).save(png, format="PNG")
    world = vertices @ world_from_scene[:3, :3].T + world_from_scene[:3, 3]
    path = tmp_path / "model.glb"
    extras = {"gltf_from_world_rotation": turn.tolist(), "world_from_scene": world_from_scene.tolist()}
    normals = np.tile([0, 1.0, 0], (4, 1))
    turned = AtlasMesh(world @ turn.T, normals, uvs, faces, 8)
    path.write_bytes(glb_bytes(turned, Textures(png.getvalue()), extras=extras))
    mesh, read_texture = smoke.read_glb(path)
    np.testing.assert_allclose(mesh.vertices, vertices, atol=1e-5)
    np.testing.assert_allclose(mesh.uvs, uvs, atol=1e-6)
    np.testing.assert_array_equal(mesh.faces, faces)
    np.testing.assert_array_equal(read_texture, texture)


def test_files_that_do_not_open_are_found(tmp_path):
    good, bad = tmp_path / "good.obj", tmp_path / "bad.glb"
    good.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    bad.write_bytes(b"glTF but not really")
    (tmp_path / "model.png").write_bytes(b"")
    assert smoke.exported(tmp_path) == [bad, good]
    assert smoke.opens(good)
    assert not smoke.opens(bad)
