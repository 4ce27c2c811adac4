"""Held-out photos against drawings: closed forms of the scores, a field drawn whole, and the command."""

from __future__ import annotations

import json
import sys
import types
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from made_up_gaussians import some_gaussians
from sphere_scene import RADIUS, render, ring_of_cameras, sphere_scene, write_undistorted
from train_settings import small
from typer.testing import CliRunner

from hineus_cli.app import app
from stages import artifacts
from stages.artifacts import AtlasMesh
from stages.engine.fingerprint import Identity, file_sha256
from stages.engine.manifest import MANIFEST, Manifest, OutputFile, describe_outputs, load_manifest
from stages.engine.workspace import Workspace
from stages.evaluation.photos import images
from stages.evaluation.photos.images import find_lpips, score_image
from stages.evaluation.photos.regions import judge, laid_on_white
from stages.gaussians.keeping import write_gaussians
from stages.geometry.point_cloud import PointCloud
from stages.neural.drawing import FieldDrawer, FieldDrawing
from stages.neural.fields import Fields
from stages.neural.trained_field import field_state
from stages.neural.trainer import field_shape
from stages.pipeline import PIPELINE

PARAMS = small({
    "steps": 1, "sampling.rays": 64, "sampling.samples": 24, "field.levels": 3, "field.log2_rows": 9,
    "field.coarsest": 8, "field.finest": 64, "field.sdf_width": 32, "field.radiance_width": 16,
    "field.sphere_radius": RADIUS, "sampling.cache_resolution": 48, "field.background_log2_rows": 8,
    "sampling.background_samples": 4, "density.scale_end": 0.01,
})  # fmt: skip
SIZE = (24, 32)


def noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(40, 200, (*SIZE, 3)).astype(np.uint8)


def drawing(colors: np.ndarray, background: bool, opacity: float = 1.0, left: int = 0) -> FieldDrawing:
    crossing = np.ones(SIZE, bool)
    crossing[:, :left] = False
    return FieldDrawing(colors, np.full(SIZE, opacity, np.float32), crossing, background)


# ---------------------------------------------------------------- scores
def test_scores_of_the_whole_and_of_a_mask_and_lpips_where_it_is_there():
    photo = noise(0)
    shifted = photo + np.uint8(51)  # a fifth of the range: 20 log10(5)
    mask = np.zeros(SIZE, bool)
    mask[4:20, 4:20] = True
    assert score_image(shifted, photo).psnr == pytest.approx(20 * np.log10(5))
    half_right = np.where(mask[..., None], photo, shifted)
    inside = score_image(half_right, photo, mask, lambda a, b: float(np.abs(a.astype(int) - b).max()))
    assert (inside.psnr, inside.pixels, inside.lpips) == (pytest.approx(100), 256, 0)  # black outside for LPIPS, too
    assert score_image(half_right, photo).lpips is None
    assert score_image(half_right, photo).psnr == pytest.approx(20 * np.log10(5) - 10 * np.log10(1 - 256 / 768))


def test_without_a_mask_the_silhouette_is_the_object_and_a_background_makes_the_photo_whole():
    photo, silhouette = noise(0), np.zeros(SIZE, bool)
    silhouette[2:22, 2:30] = True
    mesh = np.where(silhouette[..., None], photo, np.uint8(255))
    found = judge(photo, None, drawing(photo, background=True), mesh, silhouette)
    assert (found.field.whole.psnr, found.field.whole.pixels) == (pytest.approx(100), photo[..., 0].size)
    assert (found.mesh.object.psnr, found.mesh.object.pixels) == (pytest.approx(100), silhouette.sum())
    assert found.mesh.whole is None
    everywhere = judge(photo, None, drawing(photo, background=True), mesh, silhouette, None, photo, True)
    assert everywhere.splats.whole.pixels == photo[..., 0].size
    assert judge(photo, None, drawing(photo, background=True), mesh, silhouette, None, photo).splats.whole is None
    alone = judge(photo, None, drawing(photo, background=False, left=8), mesh, silhouette)
    assert alone.field.whole is None
    assert alone.field.object.pixels == alone.mesh.object.pixels == silhouette[:, 8:].sum()  # the same for both


def test_with_a_mask_all_is_laid_on_white():
    photo, mask = noise(0), np.zeros(SIZE, bool)
    mask[4:20, 4:20] = True
    opaque = drawing(np.where(mask[..., None], photo, np.uint8(0)), background=False)
    clear = FieldDrawing(opaque.colors, mask.astype(np.float32), opaque.crossing, False)
    on_white = np.where(mask[..., None], photo, np.uint8(255))
    np.testing.assert_array_equal(laid_on_white(clear), on_white)
    found = judge(photo, mask, clear, on_white, mask)
    assert found.field.whole.psnr == found.mesh.whole.psnr == pytest.approx(100)
    np.testing.assert_array_equal(found.pictures["photo"], on_white)
    too_small = np.where(np.arange(SIZE[1])[None, :, None] < 12, on_white, np.uint8(255))
    lacking = judge(photo, mask, clear, too_small, mask)
    assert lacking.mesh.whole.psnr < 20
    assert lacking.mesh.object.psnr < 20
    nothing = judge(photo, np.zeros(SIZE, bool), clear, on_white, mask)
    assert nothing.field.object is None
    assert nothing.mesh.whole is not None


# ---------------------------------------------------------------- the field
def test_a_field_is_drawn_whole_and_covers_what_the_ball_covers():
    cameras = ring_of_cameras()
    fields = Fields(field_shape(PARAMS, len(cameras), background=False))
    drawer = FieldDrawer(fields, PARAMS, "cpu")
    found = drawer.draw(cameras, 1)
    assert found.colors.shape == (40, 48, 3)
    covered = render(cameras, 1)[1]
    brush = np.ones((3, 3), np.uint8)
    assert (found.opacity[cv2.erode(covered, brush) > 0] > 0.5).all()
    assert (found.opacity[cv2.dilate(covered, brush) == 0] < 0.5).all()
    assert found.crossing[covered > 0].all()
    assert (found.colors[~found.crossing] == 0).all()  # nothing is said there
    again = FieldDrawer(fields, PARAMS, "cpu").draw(cameras, 1)
    np.testing.assert_array_equal(found.colors, again.colors)


def test_a_background_fills_what_the_region_leaves_open():
    cameras = ring_of_cameras()
    fields = Fields(field_shape(PARAMS, len(cameras), background=True))
    found = FieldDrawer(fields, PARAMS, "cpu").draw(cameras, 0)
    assert found.drawn.all()
    assert not found.crossing.all()
    assert (found.colors[~found.crossing] > 0).any()


# ---------------------------------------------------------------- LPIPS
def test_lpips_is_left_out_with_a_reason_and_nothing_is_downloaded(tmp_path, monkeypatch):
    monkeypatch.setattr(images.importlib.util, "find_spec", lambda name: None)
    assert find_lpips()[0] is None
    assert "not installed" in find_lpips()[1]
    monkeypatch.setattr(images.importlib.util, "find_spec", lambda name: object())
    weights = types.SimpleNamespace(IMAGENET1K_V1=types.SimpleNamespace(url="https://host/alexnet-1234.pth"))
    models = types.SimpleNamespace(AlexNet_Weights=weights)
    monkeypatch.setitem(sys.modules, "torchvision", types.SimpleNamespace(models=models))

    class Network(torch.nn.Module):
        def __init__(self, net: str, verbose: bool) -> None:
            super().__init__()

        def forward(self, a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
            assert a.shape == (1, 3, *SIZE)
            assert a.abs().max() <= 1
            return (a - b).abs().mean()

    monkeypatch.setitem(sys.modules, "lpips", types.SimpleNamespace(LPIPS=Network))
    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    function, reason = find_lpips()
    assert function is None
    assert str(tmp_path / "checkpoints" / "alexnet-1234.pth") in reason
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "alexnet-1234.pth").touch()
    monkeypatch.setattr(images.metadata, "version", lambda name: "0.1.4")
    function, reason = find_lpips()
    assert function is not None
    assert "0.1.4" in reason
    assert function(noise(0), noise(0)) == 0
    assert function(noise(0), noise(1)) > 0.1


# ---------------------------------------------------------------- the command
def patch_of_the_ball() -> AtlasMesh:
    """The ball as one chart: its colour is the same all over."""
    import trimesh

    mesh = trimesh.creation.icosphere(3, RADIUS)
    vertices = np.asarray(mesh.vertices, np.float32)
    uvs = np.full((len(vertices), 2), 0.5, np.float32)
    return AtlasMesh(vertices, vertices / np.float32(RADIUS), uvs, np.asarray(mesh.faces, np.int32), 8)


def publish(workspace: Workspace, stage: str, write, params: dict | None = None) -> None:
    """Publish what `write` leaves as if the stage had made it from what is published."""
    reads = next(each.reads for each in PIPELINE if each.name == stage)
    found = ((artifact, workspace.published(artifact.stage)) for artifact in reads)
    inputs = {artifact.name: manifest.artifact_digest(artifact) for artifact, manifest in found if manifest}
    with workspace.lock():
        out, _ = workspace.begin(stage, "")
        write(out)
        files = {
            path.relative_to(out).as_posix(): OutputFile(path.stat().st_size, file_sha256(path))
            for path in out.rglob("*")
            if path.is_file()
        }
        workspace.publish(stage, Manifest(Identity(stage, 1, params or {}, inputs), files))


@pytest.fixture
def workspace(tmp_path: Path) -> Workspace:
    """A ball that was not trained: the field it starts from, and a grey texture; two photos are held out."""
    cameras = ring_of_cameras()
    opened = Workspace.open(tmp_path / "run", create=True)
    with opened.lock():
        opened.remember({}, None, {})
    publish(opened, "undistort", lambda out: write_undistorted(out, cameras, masks=True))
    publish(opened, "densify", lambda out: artifacts.POINT_CLOUD.save(out, PointCloud.empty()))

    def train(out: Path) -> None:
        fields = Fields(field_shape(PARAMS, len(cameras), background=False))
        torch.save(field_state(fields), artifacts.FIELD.load(out))
        artifacts.HELD_OUT.save(out, [cameras.names[i] for i in (2, 6)])
        artifacts.SCENE.save(out, sphere_scene(cameras))

    publish(opened, "train", train, PARAMS.model_dump(mode="json"))
    publish(opened, "extract", lambda out: None)  # nothing lies around the mesh
    publish(opened, "atlas", lambda out: artifacts.ATLAS_MESH.save(out, patch_of_the_ball()))
    gray = np.full((8, 8, 3), 128, np.uint8)
    publish(opened, "bake", lambda out: artifacts.write_png(artifacts.BASE_COLOR.load(out), gray))
    return opened


def evaluate(*words: object) -> tuple[int, dict]:
    done = CliRunner().invoke(app, ["evaluate", "views", *map(str, words), "--json", "--device", "cpu"])
    return done.exit_code, json.loads(done.stdout.strip().splitlines()[-1])


def test_the_command_scores_each_photo_and_writes_the_pictures(workspace, tmp_path):
    code, found = evaluate(workspace.root, "--renders", tmp_path / "renders")
    assert code == 0
    assert [photo["name"] for photo in found["photos"]] == ["view_02.png", "view_06.png"]
    for what in ("field", "mesh"):
        scores = [photo[what]["object"] for photo in found["photos"]]
        assert found["mean"][what]["object"]["psnr"] == pytest.approx(np.mean([score["psnr"] for score in scores]))
        assert all(5 < score["psnr"] < 30 and score["lpips"] is None for score in scores)
        for photo in found["photos"]:
            assert (tmp_path / "renders" / what / photo["name"]).is_file()
    # A grey ball against the photo, by hand.
    photo, mask = render(ring_of_cameras(), 2)
    error = ((photo[mask > 0].astype(float) - 128) / 255) ** 2
    assert found["photos"][0]["mesh"]["object"]["psnr"] == pytest.approx(-10 * np.log10(error.mean()), abs=1)
    assert "2 of 8" in found["done"][0]
    table = CliRunner().invoke(app, ["evaluate", "views", str(workspace.root), "--device", "cpu"]).stdout
    assert all(word in table for word in ("view_02.png", "mean", "ssim"))


@pytest.mark.slow
def test_splats_are_scored_where_there_are_some_of_the_mesh(workspace, tmp_path):
    _, without = evaluate(workspace.root)
    assert "splats" not in without["mean"]
    atlas = artifacts.ATLAS_MESH.load(workspace.stage_folder("atlas"))
    rows = np.repeat(np.arange(len(atlas.vertices)), 2)
    some = some_gaussians(len(rows), 0)
    grey = replace(
        some,
        centers=atlas.vertices[rows],
        log_scales=np.full_like(some.log_scales, np.log(np.ptp(atlas.vertices) / 25)),
        opacity_logits=np.full_like(some.opacity_logits, 4),
        harmonics=np.zeros_like(some.harmonics),
    )
    publish(workspace, "splats", lambda out: write_gaussians(artifacts.SPLATS.load(out), grey))
    _, found = evaluate(workspace.root, "--renders", tmp_path / "renders")
    assert f"splats: {len(rows):,} Gaussians" in " ".join(found["done"])
    for photo in found["photos"]:
        assert abs(photo["splats"]["object"]["psnr"] - photo["mesh"]["object"]["psnr"]) < 1.5  # the mesh is grey, too
        assert (tmp_path / "renders" / "splats" / photo["name"]).is_file()
    table = CliRunner().invoke(app, ["evaluate", "views", str(workspace.root), "--device", "cpu"]).stdout
    assert "splats" in table
    other = replace(atlas, texture_size=4)
    publish(workspace, "atlas", lambda out: artifacts.ATLAS_MESH.save(out, other))
    publish(
        workspace,
        "bake",
        lambda out: artifacts.write_png(artifacts.BASE_COLOR.load(out), np.zeros((4, 4, 3), np.uint8)),
    )
    _, stale = evaluate(workspace.root)
    assert "splats" not in stale["mean"]
    assert "another mesh" in " ".join(stale["done"])


def test_what_is_missing_or_stale_is_explained(workspace, tmp_path):
    publish(
        workspace, "atlas", lambda out: artifacts.ATLAS_MESH.save(out, replace(patch_of_the_ball(), texture_size=4))
    )
    code, refused = evaluate(workspace.root)
    assert code == 5
    assert "bake" in refused["error"]["message"]
    assert "another atlas" in refused["error"]["message"]
    train = workspace.stage_folder("train")
    (train / "held_out.json").write_text("[]")
    manifest = replace(load_manifest(train), outputs=describe_outputs(train))
    (train / MANIFEST).write_text(manifest.to_json())
    gray = np.full((8, 8, 3), 128, np.uint8)
    publish(workspace, "bake", lambda out: artifacts.write_png(artifacts.BASE_COLOR.load(out), gray))
    code, refused = evaluate(workspace.root)
    assert code == 3
    assert "holds out no photos" in refused["error"]["message"]
    assert "--hold-out 8" in refused["error"]["hint"]
    (train / "held_out.json").write_text("{}")
    code, refused = evaluate(workspace.root)
    assert code == 5
    assert "output held_out.json damaged (contents changed)" in refused["error"]["message"]
    assert refused["error"]["hint"].endswith("--force train`.")
    code, refused = evaluate(tmp_path)
    assert code == 5
