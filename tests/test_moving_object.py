"""An object that is turned over between two passes: one model, from what the masks show alone."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from turned_over import PHOTOS, write_passes
from typer.testing import CliRunner

from configs.params import IngestParams
from hineus_cli.app import app
from hineus_cli.options import settings
from stages import artifacts, ingest
from stages.engine.stage import StageContext
from stages.errors import InputError
from stages.geometry.similarity import align_points


@pytest.mark.slow
def test_two_passes_become_one_model_in_the_objects_frame(tmp_path: Path):
    import pycolmap

    true = write_passes(tmp_path)
    command = ["sfm", str(tmp_path / "photos"), "-w", str(tmp_path / "ws"), "--preset", "tiny", "--device", "cpu"]
    result = CliRunner().invoke(app, [*command, "--masks", str(tmp_path / "masks"), "--moving-object", "--json"])
    assert result.exit_code == 0, result.output
    numbers = {stage["name"]: stage["numbers"] for stage in json.loads(result.stdout)["stages"]}
    assert numbers["sfm"]["registered"] == 2 * PHOTOS
    model = pycolmap.Reconstruction(str(artifacts.MODEL.load(tmp_path / "ws" / "sfm")))
    names = sorted(true)
    centers = {image.name: image.projection_center() for image in model.images.values()}
    found, wanted = np.array([centers[name] for name in names]), np.array([true[name] for name in names])
    errors = np.linalg.norm(align_points(found, wanted).apply(found) - wanted, axis=1)
    assert errors.max() < 0.1  # of 2.2, on a pebble that fills half of the frame; on the table's matches it is 3


def test_the_option_stands_for_settings_that_somebody_may_have_chosen():
    every = {"sfm.masks=" + json.dumps("always"), "undistort.masks=" + json.dumps("alone"), "place.gps=false"}
    assert set(settings(None, moving_object=True)) == every | {'ingest.auto_mask="object"'}
    assert set(settings(None, moving_object=True, masks=Path("masks"))) == every
    assert set(settings(["ingest.auto_mask=plain"], moving_object=True)) == every | {"ingest.auto_mask=plain"}
    assert settings(None) == ()


class Outline:
    """Stands for the network: marks the left half of pictures that are not black."""

    def mask(self, rgb: np.ndarray) -> np.ndarray | None:
        mask = np.zeros(rgb.shape[:2], bool)
        mask[:, : rgb.shape[1] // 2] = True
        return mask if rgb.mean() > 10 else None


def test_masks_that_are_made_are_believed_and_photos_without_left_out(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(ingest, "SalientNetwork", Outline)
    photos = tmp_path / "photos"
    photos.mkdir()
    for number, level in enumerate((50, 90, 130, 0)):
        noise = np.random.default_rng(number).integers(0, 20, (90, 120, 3)) if level else np.zeros((90, 120, 3))
        Image.fromarray((noise + level).astype(np.uint8)).save(photos / f"{number}.png")
    out, scratch = tmp_path / "ingest", tmp_path / "scratch"
    out.mkdir()
    scratch.mkdir()
    context = StageContext({}, {"photos": photos}, out, scratch, IngestParams(auto_mask="object"), workers=2)
    ingest.INGEST.run(context)
    found = artifacts.IMAGE_SET.load(out)
    assert [(record.name, record.has_mask, record.made_mask) for record in found.images] == [
        (f"{number}.png", True, "object") for number in range(3)
    ]
    assert [(item.source, item.reason) for item in found.skipped] == [
        ("3.png", "nothing stands out in it, so it has no mask")
    ]
    assert not artifacts.Pictures(out).path("3.png").exists()


def test_an_object_that_moved_and_photos_without_masks(tmp_path: Path):
    for number in range(3):
        Image.effect_noise((120, 90), 60).convert("RGB").save(tmp_path / f"{number}.png")
    command = ["sfm", str(tmp_path), "-w", f"{tmp_path}_ws", "--preset", "tiny", "--moving-object", "--json"]
    result = CliRunner().invoke(app, [*command, "--set", "ingest.auto_mask=off"])
    assert result.exit_code == InputError.exit_code
    assert "3 of 3 photos have no mask" in result.stdout
    assert "ingest.auto_mask=object" in result.stdout
