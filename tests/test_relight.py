"""`hineus relight`: pictures and turntables of a workspace's asset in another light."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from relit_workspace import ball, make_workspace
from typer.testing import CliRunner, Result

from hineus_cli.app import build_app
from stages import artifacts
from stages.drawing.relighting import Material, relit
from stages.drawing.rendering import look_at
from stages.engine.workspace import Workspace
from stages.errors import ConfigError, HineusError, InputError, WorkspaceError
from stages.files.light_files import write_exr, write_hdr
from stages.files.video import count_frames, write_mp4
from stages.light.built_in import window
from stages.light.levels import levels_of
from stages.relight import Wish, relight, views

SMALL = (64, 48)


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_workspace(tmp_path_factory.mktemp("plain") / "ws", materials=False)


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_workspace(tmp_path_factory.mktemp("learned") / "ws", materials=True)


def drawn(workspace: Path, out: Path, light: str = "studio", **more: object) -> np.ndarray:
    """The picture as OpenCV reads it, in RGB(A)."""
    relight(workspace, replace(Wish(light, out, size=SMALL), **more), lambda done, total: None)  # type: ignore[arg-type]
    found = cv2.imread(str(out), cv2.IMREAD_UNCHANGED)
    return cv2.cvtColor(found, cv2.COLOR_BGRA2RGBA if found.shape[2] == 4 else cv2.COLOR_BGR2RGB)


def uniform(path: Path, radiance: float) -> str:
    write_hdr(path, np.full((8, 16, 3), radiance, np.float32))
    return str(path)


# ---------------------------------------------------------------- pictures
@pytest.mark.slow
def test_the_light_from_above_lights_the_top_and_colours_are_the_materials(learned: Path, tmp_path: Path) -> None:
    """The scene's up is +Z, the light's is +Y: that of the GLB."""
    picture = drawn(learned, tmp_path / "a.png", "learned", background="white").astype(int)
    column = picture[:, SMALL[0] // 2]
    ball_rows = np.flatnonzero(column[:, 0] < 250)
    top, bottom = column[ball_rows[4]], column[ball_rows[-4]]
    assert top.sum() > 2 * bottom.sum()
    assert top[2] > top[1] > top[0]  # BASE is blue
    assert (picture[0] == 255).all()


def test_without_materials_the_texture_is_shown_and_it_is_said(
    plain: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    picture = drawn(plain, tmp_path / "a.png", background="white").astype(int)
    assert np.ptp(picture, axis=2).max() < 12  # GREY
    assert "hineus run --workspace" in caplog.text
    assert "--relightable" in caplog.text
    with pytest.raises(WorkspaceError, match="No light was learned") as caught:
        drawn(plain, tmp_path / "b.png", "learned")
    assert "--relightable" in caught.value.hint
    assert not (tmp_path / "b.png").exists()


@pytest.mark.slow
def test_foreign_lights_are_metered_and_the_exposure_counts_from_there(learned: Path, tmp_path: Path) -> None:
    dim, bright = (
        drawn(learned, tmp_path / "a.png", uniform(tmp_path / f"{k}.hdr", 4.0**k)).astype(int) for k in (-2, 3)
    )
    assert np.abs(dim - bright).max() <= 2
    exposed = drawn(learned, tmp_path / "a.png", str(tmp_path / "3.hdr"), exposure_ev=-2).astype(int)
    assert exposed.mean() < 0.7 * bright.mean()


def test_sides_are_in_a_row_and_a_transparent_picture_has_alpha(learned: Path, tmp_path: Path) -> None:
    row = drawn(learned, tmp_path / "row.png", sides=3, background="transparent")
    assert row.shape == (SMALL[1], 3 * SMALL[0] + 2 * 8, 4)
    assert (row[:, 0, 3] == 0).all()
    assert (row[SMALL[1] // 2, SMALL[0] // 2 :: SMALL[0] + 8, 3] == 255).all()


def test_the_asset_turns_before_a_light_that_stays_or_the_light_turns() -> None:
    mesh = replace(ball(), vertices=ball().vertices @ np.array([[1, 0, 0], [0, 0, 1], [0, 1, 0]]))
    mesh = replace(mesh, normals=mesh.vertices)
    white = Material(np.full((1, 1, 3), 255, np.uint8), np.full((1, 1, 3), (255, 255, 0), np.uint8))
    light = np.full((32, 64, 3), 0.02, np.float32)
    light[8:16, 40:50] = 5
    levels = levels_of(light)

    def pictures(**how: object) -> list[np.ndarray]:
        wish = replace(Wish("studio", Path("a.png"), size=SMALL, sides=4), **how)  # type: ignore[arg-type]
        return [relit(mesh, white, levels, camera, turn_deg=turn)[0] for camera, turn in views(mesh.vertices, wish)]

    turning, lit = pictures(), pictures(turn_light=True)
    for picture in turning[1:]:  # a ball of one colour looks the same from everywhere
        assert np.abs(picture - turning[0]).mean() < 0.02 * turning[0].mean()
    assert np.abs(lit[2] - lit[0]).mean() > 0.2 * lit[0].mean()
    np.testing.assert_allclose(lit[0], turning[0], atol=1e-5)
    np.testing.assert_allclose(pictures(turn_deg=90, turn_light=True)[0], lit[1], atol=1e-5)


def test_the_first_picture_is_from_the_front() -> None:
    ((camera, turn),) = views(ball().vertices, Wish("studio", Path("a.png")))
    assert turn == 0
    assert abs(camera.centers[0][0]) < 1e-9
    assert camera.centers[0][2] > 2


# ---------------------------------------------------------------- turntables
@pytest.mark.slow
def test_a_turntable_opens_again_with_all_its_frames(learned: Path, tmp_path: Path) -> None:
    out, seen = tmp_path / "turn.mp4", []
    wish = Wish("window", out, size=SMALL, frames=7)
    told = relight(learned, wish, lambda done, total: seen.append((done, total)))
    assert (told["frames"], told["codec"]) == (7, "VP9")
    assert seen == [(k, 7) for k in range(8)]
    assert count_frames(out) == 7
    video = cv2.VideoCapture(str(out))
    assert (int(video.get(cv2.CAP_PROP_FRAME_WIDTH)), int(video.get(cv2.CAP_PROP_FRAME_HEIGHT))) == SMALL
    first = video.read()[1][..., ::-1].astype(int)
    assert np.abs(first - drawn(learned, tmp_path / "a.png", "window")).mean() < 6
    assert [file.name for file in tmp_path.iterdir() if file.suffix == ".mp4"] == ["turn.mp4"]


def test_a_video_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No such file"):
        write_mp4(tmp_path / "absent" / "a.mp4", [], SMALL, 30)
    (tmp_path / "text.mp4").write_text("no video")
    assert count_frames(tmp_path / "text.mp4") == 0


# ---------------------------------------------------------------- what is refused
@pytest.mark.parametrize(
    ("changes", "kind", "sentence"),
    [
        ({"out": Path("a.jpg")}, ConfigError, "neither a picture nor a video"),
        ({"size": (64, 49)}, ConfigError, "both must be even"),
        ({"size": (8192, 64)}, ConfigError, "16 to 4096 pixels"),
        ({"renderer": "mitsuba3"}, ConfigError, "--renderer mitsuba3 is not known"),
        ({"background": "black"}, ConfigError, "--background black is not known"),
        ({"out": Path("a.mp4"), "background": "transparent"}, ConfigError, "no transparent background"),
        ({"out": Path("absent/a.png")}, InputError, "There is no folder"),
        ({"light": "stdio"}, ConfigError, "neither known nor a file"),
        ({"light": "absent.hdr"}, InputError, "absent.hdr cannot be read as a light"),
    ],
)
def test_wishes_that_cannot_be_fulfilled(
    changes: dict[str, object],
    kind: type[HineusError],
    sentence: str,
    plain: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(kind, match=sentence) as caught:
        relight(plain, replace(Wish("studio", Path("a.png")), **changes), lambda done, total: None)  # type: ignore[arg-type]
    assert caught.value.hint
    assert not list(tmp_path.iterdir())


def test_lights_that_are_none(plain: Path, tmp_path: Path) -> None:
    write_exr(tmp_path / "square.exr", np.ones((8, 8, 3), np.float32))
    for light, sentence in ((str(tmp_path / "square.exr"), "twice as wide"), (uniform(tmp_path / "b.hdr", 0), "black")):
        with pytest.raises(InputError, match=sentence):
            drawn(plain, tmp_path / "a.png", light)


@pytest.mark.slow
def test_a_workspace_without_a_texture_or_with_one_of_another_mesh(tmp_path: Path) -> None:
    with pytest.raises(WorkspaceError):
        drawn(tmp_path / "absent", tmp_path / "a.png")
    workspace = make_workspace(tmp_path / "ws", materials=False)
    manifest = workspace / "bake" / "manifest.json"
    kept = manifest.read_bytes()
    manifest.unlink()
    with pytest.raises(WorkspaceError, match="no texture of its present mesh") as caught:
        drawn(workspace, tmp_path / "a.png")
    assert "--until bake" in caught.value.hint
    manifest.write_bytes(kept[:-9])
    with pytest.raises(WorkspaceError, match="bake is not as it was published: manifest damaged") as caught:
        drawn(workspace, tmp_path / "a.png")
    assert "--force bake" in caught.value.hint
    manifest.write_bytes(kept)
    texture = artifacts.BASE_COLOR.load(Workspace.open(workspace).stage_folder("bake"))
    texture.write_bytes(texture.read_bytes()[:-4] + b"abcd")
    with pytest.raises(WorkspaceError, match="not as it was published"):
        drawn(workspace, tmp_path / "a.png")


@pytest.mark.slow
@pytest.mark.parametrize("name", ["base_color.png", "orm.png", "light.exr"])
def test_materials_that_are_damaged_are_named(learned: Path, tmp_path: Path, name: str) -> None:
    workspace = shutil.copytree(learned, tmp_path / "ws")
    file = workspace / "materials" / name
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1  # of the same size
    file.write_bytes(data)
    with pytest.raises(WorkspaceError, match=f"output {name} damaged") as caught:
        drawn(workspace, tmp_path / "a.png", "learned")
    assert "--force materials" in caught.value.hint


# ---------------------------------------------------------------- the command
def run(*words: object) -> Result:
    return CliRunner().invoke(build_app(), ["relight", *map(str, words)])


@pytest.mark.slow
def test_the_command_draws_and_says_how(learned: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.png"
    done = run(learned, "--light", "sun", "--out", out, "--size", "64x48", "--exposure", -1, "--turn", 30, "--json")
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert told["ok"]
    assert Path(told["file"]) == out
    assert told["materials"]
    assert told["tone_mapping"] == "Khronos PBR Neutral"
    assert cv2.imread(str(out)).shape == (48, 64, 3)
    for words, sentence in ((("--size", "64"), "is no size"), (("--light", "snu"), "--light sun")):
        done = run(learned, "--out", out, *words)
        assert done.exit_code == 2
        assert sentence in done.output


# ---------------------------------------------------------------- against a path tracer
@pytest.mark.slow
def test_a_path_tracer_sees_nearly_the_same_of_a_ball() -> None:
    """Which throws no shadow on itself: what is left is Disney's matte part, and the split sum."""
    pytest.importorskip("mitsuba")
    from stages.drawing.path_tracing import EVERYWHERE, PathTracer

    mesh = ball()
    light = window(32)
    halves = np.full((16, 16, 3), 200, np.uint8)
    halves[:8, :8] = 220, 40, 40
    camera = look_at(np.array([0.5, 1, 3.5]), np.zeros(3), np.array([0, 1.0, 0]), 48, 48)
    for roughness, metallic in ((128, 0), (128, 255)):
        material = Material(halves, np.array([[[255, roughness, metallic]]], np.uint8))
        ours, coverage = relit(mesh, material, levels_of(light), camera, turn_deg=40)
        traced, traced_coverage = PathTracer(mesh, material, light, EVERYWHERE).relit(camera, 40, paths=64)
        inside = (coverage == 1) & (traced_coverage == 1)
        assert np.abs(coverage - traced_coverage).mean() < 0.01
        assert np.abs(ours[inside] - traced[inside]).mean() < 0.12 * traced[inside].mean()
