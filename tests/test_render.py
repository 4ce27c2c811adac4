"""`hineus render`: films of a workspace's model, as mesh and as splats, around it and along given cameras."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from relit_workspace import BASE, GREY, make_workspace
from typer.testing import CliRunner

from hineus_cli.app import build_app
from stages import artifacts
from stages.artifacts import AtlasMesh
from stages.drawing.rendering import look_at, render_together
from stages.engine.workspace import Workspace
from stages.errors import ConfigError, HineusError, InputError, WorkspaceError
from stages.files.video import count_frames
from stages.relight import Wish, relight
from stages.render import Film, read_path, render

SMALL = (64, 48)
ORBIT = Film("mesh", "orbit", Path("a.png"), SMALL)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_workspace(tmp_path_factory.mktemp("whole") / "ws", materials=True, until="splats")


def picture(workspace: Path, film: Film) -> np.ndarray:
    render(workspace, film, lambda done, total: None)
    return cv2.imread(str(film.out))[..., ::-1].astype(int)


def write_path(file: Path, eyes: list[np.ndarray], size: tuple[int, int] = SMALL) -> Path:
    """Cameras at `eyes` that look at the origin, up +Z, as nerfstudio writes them."""
    frames = []
    for k, eye in enumerate(eyes):
        camera = look_at(np.asarray(eye, float), np.zeros(3), np.array([0.0, 0, 1]), *size)
        world_from_cam = np.linalg.inv(np.vstack([camera.extrinsics[0], [0, 0, 0, 1]]))
        frames.append(
            {
                "file_path": f"{k:03d}.png",
                "transform_matrix": (world_from_cam @ np.diag([1, -1, -1, 1])).tolist(),
                "fl_x": camera.intrinsics[0, 0, 0],
                "w": size[0],
                "h": size[1],
            }
        )
    file.write_text(json.dumps({"frames": frames}))
    return file


# ---------------------------------------------------------------- pictures
@pytest.mark.slow
@pytest.mark.parametrize(("what", "middle"), [("mesh", (GREY, GREY, GREY)), ("splats", (255, 0, 0))])
def test_the_ball_is_in_the_middle_before_white(workspace, tmp_path, what, middle):
    drawn = picture(workspace, replace(ORBIT, what=what, out=tmp_path / "a.png"))
    assert drawn.shape == (48, 64, 3)
    assert np.abs(drawn[24, 32] - middle).max() <= 20
    assert (drawn[[0, 0, -1, -1], [0, -1, 0, -1]] == 255).all()


@pytest.mark.slow
def test_mesh_and_splats_cover_the_same(workspace, tmp_path):
    drawn = [picture(workspace, replace(ORBIT, what=what, out=tmp_path / "a.png")) for what in ("mesh", "splats")]
    mesh, splats = (255 - each.min(2) > (255 - each[24, 32].min()) / 2 for each in drawn)
    assert mesh.sum() > 500
    assert (mesh & splats).sum() > 0.75 * (mesh | splats).sum()  # Gaussians reach beyond their centers


@pytest.mark.slow
def test_the_orbit_is_that_of_relight(workspace, tmp_path):
    relight(workspace, Wish("studio", tmp_path / "b.png", size=SMALL, background="white"), lambda done, total: None)
    lit = cv2.imread(str(tmp_path / "b.png")).astype(int)
    drawn = picture(workspace, replace(ORBIT, out=tmp_path / "a.png"))
    assert BASE[0] < GREY
    assert ((drawn.min(2) < 250) == (lit.min(2) < 250)).mean() > 0.99


@pytest.mark.slow
def test_cameras_of_a_file_are_in_the_world_a_frame_each_and_keep_what_they_see_from_top_to_bottom(workspace, tmp_path):
    file = write_path(tmp_path / "path.json", [(0, -5, 0), (0, -9, 0), (0, -20, 0)], (400, 400))
    drawn = picture(workspace, Film("mesh", str(file), tmp_path / "a.png", SMALL, sides=3))
    rows = [(drawn[:, k * 72 : k * 72 + 64].min(2) < 250).any(1).sum() for k in range(3)]
    halves = np.tan(np.arcsin(1 / np.array([5, 9, 20]))) / np.tan(np.radians(35 / 2))
    np.testing.assert_allclose(rows, np.minimum(48 * halves, 48), atol=2)


def test_the_path_is_read_in_the_order_of_its_names_and_scaled(tmp_path):
    file = write_path(tmp_path / "path.json", [(0, -5, 0), (0, -9, 0)], (400, 200))
    cameras = read_path(file, (64, 48))
    np.testing.assert_allclose(cameras.centers, [[0, -5, 0], [0, -9, 0]], atol=1e-9)
    assert cameras.sizes.tolist() == [[64, 48]] * 2
    expected = look_at(np.array([0.0, -5, 0]), np.zeros(3), np.array([0.0, 0, 1]), 64, 48)
    np.testing.assert_allclose(cameras.intrinsics[0], expected.intrinsics[0])


# ---------------------------------------------------------------- films
@pytest.mark.slow
def test_a_film_of_splats_has_its_frames_and_progress_is_told(workspace, tmp_path):
    told = []
    film = Film("splats", "orbit", tmp_path / "a.mp4", SMALL, frames=5)
    about = render(workspace, film, lambda done, total: told.append((done, total)))
    assert count_frames(film.out) == about["frames"] == 5
    assert told == [(k, 5) for k in range(6)]
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]


# ---------------------------------------------------------------- what cannot be drawn
@pytest.mark.parametrize(
    ("film", "error", "words"),
    [
        (replace(ORBIT, what="splat"), ConfigError, "--what splats"),
        (replace(ORBIT, out=Path("a.gif")), ConfigError, ".mp4"),
        (replace(ORBIT, size=(63, 48)), ConfigError, "even"),
        (replace(ORBIT, path="no.json"), InputError, "export-transforms"),
    ],
)
def test_wishes_that_cannot_be_fulfilled_are_explained(workspace, tmp_path, monkeypatch, film, error, words):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(error) as caught:
        render(workspace, film, lambda done, total: None)
    assert words in caught.value.message + caught.value.hint
    assert not list(tmp_path.iterdir())


def test_without_splats_the_command_says_how_to_make_them(tmp_path):
    before = make_workspace(tmp_path / "ws", materials=False)
    with pytest.raises(WorkspaceError, match="no splats") as caught:
        render(before, replace(ORBIT, what="splats", out=tmp_path / "a.png"), lambda done, total: None)
    assert "--splats" in caught.value.hint


def test_damaged_splats_are_named(tmp_path):
    whole = make_workspace(tmp_path / "ws", materials=False, until="splats")
    artifacts.SPLATS.load(Workspace.open(whole).stage_folder("splats")).write_bytes(b"PK and no more")
    with pytest.raises(HineusError) as caught:
        render(whole, replace(ORBIT, what="splats", out=tmp_path / "a.png"), lambda done, total: None)
    assert "splats" in caught.value.message


@pytest.mark.slow
def test_the_command_says_what_it_drew(workspace, tmp_path):
    words = [
        "render",
        str(workspace),
        "--what",
        "splats",
        "--out",
        str(tmp_path / "a.png"),
        "--size",
        "64x48",
        "--json",
    ]
    done = CliRunner().invoke(build_app(), words)
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout.strip().splitlines()[-1])
    assert (found["what"], found["sides"], found["path"]) == ("splats", 1, "orbit")
    assert (tmp_path / "a.png").exists()


def test_of_meshes_drawn_together_the_nearest_is_seen():
    def square(depth: float, side: float) -> AtlasMesh:
        corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * side + [0, 0, depth]
        up = np.tile(np.float32([0, 0, -1]), (4, 1))
        faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
        return AtlasMesh(corners.astype(np.float32), up, np.zeros((4, 2), np.float32), faces, 1)

    camera = look_at(np.zeros(3), np.array([0, 0, 1.0]), np.array([0, -1.0, 0]), 40, 40, fov_deg=90)
    red, blue = (np.full((1, 1, 3), color, np.uint8) for color in ((200, 0, 0), (0, 0, 200)))
    near, far = (square(1.0, 0.5), red), (square(2.0, 1.5), blue)
    picture = render_together([near, far], camera)
    np.testing.assert_array_equal(picture, render_together([far, near], camera))
    assert picture[20, 20].tolist() == [200, 0, 0]
    assert picture[20, 8].tolist() == [0, 0, 200]
    assert picture[20, 2].tolist() == [255, 255, 255]
