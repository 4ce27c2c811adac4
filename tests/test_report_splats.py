"""Gaussian splats in the report's 3D view, drawn by Spark in headless Chromium."""

from __future__ import annotations

import numpy as np
import pytest
from chromium import BROWSER, opened
from made_up_gaussians import some_gaussians
from report_inputs import bare_inputs, page, pyramid

from hineus_cli.viewing import serving, watch
from stages import artifacts
from stages.engine.stage import StageContext
from stages.engine.workspace import Workspace
from stages.gaussians.gaussians import Gaussians
from stages.gaussians.keeping import write_gaussians

COUNT = 8_000
SIZE = 0.012


def painted_pyramid() -> Gaussians:
    """The report's pyramid as Gaussians: red where its texture is red, blue where that is blue."""
    mesh, random = pyramid(), np.random.default_rng(0)
    faces = mesh.faces[random.integers(0, len(mesh.faces), COUNT)]
    corners = random.dirichlet(np.ones(3), COUNT)
    points = np.einsum("nc,ncd->nd", corners, mesh.vertices[faces])
    red = np.einsum("nc,nc->n", corners, mesh.uvs[faces][..., 1]) > 0.5
    some = some_gaussians(COUNT, 0)
    colors = np.where(red[:, None], (230, 40, 40), (40, 70, 220)) / 255
    return Gaussians(
        centers=points.astype(np.float32),
        rotations=some.rotations,
        log_scales=np.full((COUNT, 3), np.log(SIZE), np.float32),
        opacity_logits=np.full(COUNT, 5.0, np.float32),
        harmonics=((colors - 0.5) / 0.28209479)[:, None].astype(np.float32),
        anchored=np.ones(COUNT, bool),
    )


@pytest.fixture
def with_splats(tmp_path) -> StageContext:
    context = bare_inputs(tmp_path)
    write_gaussians(artifacts.SPLATS.load(context.inputs["splats"]), painted_pyramid())
    return context


def is_red(picture: np.ndarray) -> np.ndarray:
    return (picture[..., 0] > 180) & (picture[..., 1:] < 110).all(2)


def is_blue(picture: np.ndarray) -> np.ndarray:
    return (picture[..., 2] > 180) & (picture[..., :2] < 130).all(2)


def is_shown(picture: np.ndarray) -> np.ndarray:
    """Where the view has colours: its surroundings are grey."""
    return np.ptp(picture, axis=2) > 60


SHOW_TEXTURE = """
  const surface = document.getElementById("surface");
  surface.value = "texture";
  surface.dispatchEvent(new Event("change"));
"""
WHILE = "new Promise((done) => setTimeout(done, 1500))"  # splats are sorted in a worker, then drawn again


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="needs Chromium")
def test_splats_lie_where_the_mesh_lies_in_its_colours_from_a_file_and_under_the_policy_of_view(with_splats, tmp_path):
    workspace = Workspace.open(tmp_path / "ws", create=True)
    with workspace.lock():
        workspace.remember({"photos": None}, "cpu", {})
    text = page(with_splats)
    report = artifacts.PAGE.load(workspace.stage_folder("report"))
    report.parent.mkdir()
    report.write_text(text, encoding="utf-8")
    shown = []
    with serving(watch(workspace.root, ())) as served, opened(tmp_path) as tab:
        for url in (report.as_uri(), served):
            tab.go(f"{url}#show=splats", 600, 700)
            tab.wait_for('document.documentElement.dataset.viewer === "ready"')
            tab.value(WHILE)
            shown.append(tab.screenshot())
        tab.value(f"{SHOW_TEXTURE} {WHILE}")
        mesh = tab.screenshot()
    for splats in shown:
        assert np.abs(splats - mesh).sum() > 1e5
        assert (is_shown(splats) & is_shown(mesh)).sum() > 0.85 * (is_shown(splats) | is_shown(mesh)).sum()
        for shade in (is_red, is_blue):  # which the texture blends where they meet
            assert shade(mesh).sum() > 1000
            assert (shade(splats) & shade(mesh)).sum() > 0.97 * shade(mesh).sum()


@pytest.mark.slow
def test_a_page_without_splats_carries_no_program_for_them(tmp_path):
    text = page(bare_inputs(tmp_path))
    assert "SPARK" not in text
    assert '"spz"' not in text


@pytest.mark.slow
def test_damaged_splats_are_left_out(tmp_path):
    context = bare_inputs(tmp_path)
    artifacts.SPLATS.load(context.inputs["splats"]).write_bytes(b"PK no archive")
    assert '"spz"' not in page(context)
