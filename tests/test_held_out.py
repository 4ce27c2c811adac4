"""Photos left out of the training: which, that nothing is drawn from them, and how well they are met."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from ball_training import ball_sightings, even_rays
from sphere_scene import render, ring_of_cameras, write_densified, write_undistorted
from train_settings import changed, small

from stages import artifacts, train
from stages.engine.stage import StageContext
from stages.errors import ConfigError
from stages.neural.held_out_psnr import held_out_psnr, left_out, photo_psnr
from stages.neural.needed_rays import NeededRays
from stages.neural.training_photos import Photos

TINY = small({
    "steps": 50, "sampling.rays": 64, "sampling.samples": 8, "field.levels": 2, "field.log2_rows": 9,
    "field.coarsest": 8, "field.finest": 16, "field.sdf_width": 8, "field.radiance_width": 8,
    "schedule.start_levels": 2, "sampling.free_points": 32, "losses.sparse_batch": 16, "losses.dense_batch": 16,
    "sampling.cache_resolution": 16, "field.background_log2_rows": 9, "sampling.background_samples": 4,
})  # fmt: skip


def make_photos(every: int = 4, masks: bool = False) -> Photos:
    cameras = ring_of_cameras()
    views = [render(cameras, i) for i in range(8)]
    return Photos(cameras, [v[0] for v in views], [v[1] for v in views] if masks else None, "cpu", ~left_out(8, every))


def run_train(folder: Path, **settings) -> dict:
    undistort, out, scratch = (folder / name for name in ("undistort", "out", "scratch"))
    write_undistorted(undistort, ring_of_cameras())
    out.mkdir()
    scratch.mkdir()
    inputs = {"undistort": undistort, "densify": write_densified(folder / "densify")}
    return train.run(StageContext(inputs, {}, out, scratch, changed(TINY, settings)))


def test_every_nth_photo_is_left_out_from_the_middle_of_the_first_n():
    assert torch.nonzero(left_out(20, 8)).flatten().tolist() == [4, 12]
    assert torch.nonzero(left_out(7, 3)).flatten().tolist() == [1, 4]
    assert not left_out(20, 0).any()


def test_rays_are_drawn_from_all_photos_but_those_left_out():
    photos = make_photos()
    batch = even_rays(photos, 2000)
    counts = torch.bincount(batch.images, minlength=8)
    assert counts[[2, 6]].tolist() == [0, 0]
    assert (counts[[0, 1, 3, 4, 5, 7]] > 200).all()


def test_leaving_none_out_draws_what_was_always_drawn():
    with_argument, without = make_photos(every=0), Photos(
        ring_of_cameras(), [render(ring_of_cameras(), i)[0] for i in range(8)], None, "cpu"
    )  # fmt: skip
    a, b = (even_rays(photos, 100) for photos in (with_argument, without))
    assert torch.equal(a.images, b.images)
    assert torch.equal(a.directions, b.directions)


def test_psnr_is_that_of_a_slow_loop():
    photos = make_photos()
    predicted = torch.tensor([0.5, 0.25, 0.75])
    seen = photos.rays(*_every_pixel(photos, 2)).colors
    loop = [sum((float(color[c]) - float(predicted[c])) ** 2 for c in range(3)) / 3 for color in seen]
    expected = -10 * np.log10(np.mean(loop))
    assert photo_psnr(photos, 2, lambda batch: predicted.expand_as(batch.colors)) == pytest.approx(expected, abs=1e-4)


def test_an_error_of_a_tenth_is_20_db_and_none_is_100_db():
    photos = make_photos()
    photos.pixels.clamp_(40, 200)  # so that no colour leaves [0, 1]
    assert held_out_psnr(photos, lambda batch: batch.colors + 0.1) == pytest.approx(20, abs=1e-3)
    assert held_out_psnr(photos, lambda batch: batch.colors) == pytest.approx(100)


def test_only_photos_left_out_are_judged_and_their_psnr_is_averaged():
    photos = make_photos()
    photos.pixels.clamp_(40, 200)
    offsets = torch.tensor([1, 1, 0.1, 1, 1, 1, 0.01, 1])  # of photos 2 and 6: 20 and 40 dB
    seen = set()

    def colors(batch):
        seen.update(batch.images.tolist())
        return batch.colors + offsets[batch.images, None]

    assert held_out_psnr(photos, colors) == pytest.approx(30, abs=1e-2)
    assert seen == {2, 6}
    assert held_out_psnr(make_photos(every=0), colors) is None


def test_what_lies_off_the_mask_does_not_count():
    photos = make_photos(masks=True)
    photos.pixels.clamp_(40, 200)
    assert held_out_psnr(photos, lambda batch: batch.colors + 0.1 + 0.5 * (batch.masks < 0.5)[:, None]) == (
        pytest.approx(20, abs=1e-3)
    )
    photos.masks.zero_()
    assert held_out_psnr(photos, lambda batch: batch.colors) is None


def test_large_photos_are_judged_on_a_grid_of_pixels(monkeypatch):
    monkeypatch.setattr("stages.neural.held_out_psnr.PIXELS", 200)
    rays = []
    photo_psnr(make_photos(), 2, lambda batch: (rays.extend(batch.drawn), batch.colors)[1])
    assert 100 < len(rays) <= 200


@pytest.mark.slow
def test_the_stage_reports_the_photos_left_out_and_trains_on_the_others(tmp_path, monkeypatch):
    drawn = set()
    original = NeededRays.draw

    def draw(self, num_rays, generator):
        batch, cells = original(self, num_rays, generator)
        drawn.update(batch.images.tolist())
        return batch, cells

    monkeypatch.setattr(NeededRays, "draw", draw)
    numbers = run_train(tmp_path, hold_out=4)
    assert drawn == {0, 1, 3, 4, 5, 7}
    assert (numbers["held_out"], numbers["photos"]) == (2, 8)
    assert 5 < numbers["held_out_psnr"] < 40
    assert len(artifacts.HELD_OUT.load(tmp_path / "out")) == 2


def test_judging_leaves_the_random_state_alone():
    from stages.neural.trainer import Trainer

    photos = make_photos()
    trainer = Trainer(photos, *ball_sightings(ring_of_cameras()), TINY, "cpu")
    trainer.step(0.1)
    before = trainer.generator.get_state(), torch.get_rng_state()

    def colors(batch):
        return trainer.render(batch, 1.0).colors

    assert held_out_psnr(photos, colors) == held_out_psnr(photos, colors)
    after = trainer.generator.get_state(), torch.get_rng_state()
    assert all(torch.equal(a, b) for a, b in zip(before, after, strict=True))


def test_without_a_hold_out_there_is_no_number(tmp_path):
    assert "held_out_psnr" not in run_train(tmp_path, steps=1)


@pytest.mark.parametrize(("every", "found"), [(1, "leaves 0 of 8"), (16, "leaves 8 of 8")])
def test_too_few_photos_left_or_none_left_out_is_an_error(tmp_path, every, found):
    with pytest.raises(ConfigError, match=found):
        run_train(tmp_path, hold_out=every)


def _every_pixel(photos: Photos, image: int) -> tuple[torch.Tensor, torch.Tensor]:
    width, height = photos.sizes[image].tolist()
    pixels = torch.tensor([[x, y] for y in range(height) for x in range(width)], dtype=torch.float32)
    return torch.full((len(pixels),), image), pixels
