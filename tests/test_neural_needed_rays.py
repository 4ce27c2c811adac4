"""Rays by need: the cells of the photos, what they show, how often they are drawn."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from ball_training import TINY, make_trainer
from sphere_scene import render, ring_of_cameras
from train_settings import changed

from stages.neural.needed_rays import NeededRays
from stages.neural.sampling import SdfCache
from stages.neural.training_photos import Photos

BALL = 0.5


@pytest.fixture(scope="module")
def photos() -> Photos:
    cameras = ring_of_cameras()
    training = torch.ones(len(cameras), dtype=torch.bool)
    training[1] = False
    return Photos(cameras, [render(cameras, i)[0] for i in range(len(cameras))], None, "cpu", training)


@pytest.fixture(scope="module")
def cache() -> SdfCache:
    cache = SdfCache(48, "cpu")
    cache.refresh(lambda p: p.norm(dim=1) - BALL)
    return cache


def closest_to_center(batch) -> torch.Tensor:
    """Distance of each ray's line from the origin, which the ball lies around."""
    return torch.linalg.vector_norm(torch.linalg.cross(batch.origins, batch.directions), dim=1)


def test_each_pixel_of_a_box_lies_in_one_cell_and_none_of_a_held_out_photo(photos):
    needed = NeededRays(photos, 0.7)
    assert 1 not in needed.images
    for image in (0, 2):
        x0, y0, x1, y1 = photos.boxes[image].int().tolist()
        pixels = torch.tensor([(x, y) for y in range(y0, y1) for x in range(x0, x1)]).float()
        cells = needed.cells(torch.full((len(pixels),), image), pixels)
        assert (needed.images[cells] == image).all()
        low, size = needed.low[cells], needed.size[cells]
        assert ((pixels >= low) & (pixels < low + size)).all()
        own = needed.images == image
        assert needed.size[own].prod(1).sum() == len(pixels)
        counts = torch.bincount(cells, minlength=len(needed.images))
        assert torch.equal(counts[own].float(), needed.size[own].prod(1))


def test_cells_become_larger_where_they_would_be_too_many(photos, monkeypatch):
    many = NeededRays(photos, 0.7)
    few = len(many.images) // 3
    monkeypatch.setattr("stages.neural.needed_rays._MOST_CELLS", few)
    needed = NeededRays(photos, 0.7)
    assert needed.side > many.side
    assert len(needed.images) <= few


def test_the_rays_by_need_meet_the_surface_and_the_others_are_drawn_as_before(photos, cache):
    generator = torch.Generator().manual_seed(0)
    needed = NeededRays(photos, 0.7)
    before, _ = needed.draw(4000, generator)
    needed.look(cache)
    after, cells = needed.draw(4000, generator)
    even = (closest_to_center(before) < BALL).float().mean()
    hit = (closest_to_center(after) < BALL).float().mean()
    # the rays by need that miss pass beside the ball within their cell's reach
    assert 0.3 * even + 0.7 * 0.45 < hit < 0.3 * even + 0.7 * 0.8
    far_before, far_after = ((closest_to_center(batch) > 0.8).float().mean().item() for batch in (before, after))
    assert far_after == pytest.approx(0.3 * far_before, rel=0.2)
    assert 1 not in after.images
    assert torch.equal(needed.images[cells], after.images)


def test_all_cells_that_show_the_surface_have_a_weight(photos, cache):
    """Each ray that meets the ball lies in a weighted cell: against all pixels of a photo."""
    needed = NeededRays(photos, 0.7)
    needed.look(cache)
    width, height = photos.sizes[0].tolist()
    pixels = torch.tensor([(x, y) for y in range(height) for x in range(width)]).float()
    batch = photos.rays(torch.zeros(len(pixels), dtype=torch.long), pixels)
    met = batch.drawn[closest_to_center(batch) < BALL]
    assert len(met) > 100
    assert (needed.weights[needed.cells(torch.zeros(len(met), dtype=torch.long), pixels[met])] > 0).all()
    assert (needed.weights == 0).float().mean() > 0.2


def test_cells_are_drawn_by_what_is_known_of_their_errors(photos, cache):
    needed = NeededRays(photos, 1.0)
    needed.look(cache)
    shown = needed.weights > 0
    first, second, third = torch.nonzero(shown).squeeze(1)[[3, 20, 40]].tolist()
    needed.learn(torch.tensor([first, second, first]), torch.tensor([0.5, 0.1, 0.3]))
    needed.learn(torch.tensor([first]), torch.tensor([0.6]))
    needed.look(cache)
    # 0.4, then 0.6 in one cell, 0.1 in the other: a tenth of each, and the mean for what is not known
    of_first, known_first = 0.9 * 0.04 + 0.06, 1 - 0.9**2
    mean = (of_first + 0.01) / (known_first + 0.1)
    expected = {first: of_first + (1 - known_first) * mean, second: 0.01 + 0.9 * mean, third: mean}
    areas = needed.size.prod(1)
    for cell, error in expected.items():
        assert needed.weights[cell].item() == pytest.approx((areas[cell] * (error + mean)).item(), rel=1e-5)
    assert torch.equal(needed.weights > 0, shown)

    needed.learn(torch.tensor([first] * 50), torch.full((50,), 30.0))
    needed.look(cache)
    _, cells = needed.draw(30000, torch.Generator().manual_seed(0))
    share, weight = (cells == first).float().mean().item(), (needed.weights[first] / needed.weights.sum()).item()
    assert share == pytest.approx(weight, rel=0.25)


def test_cells_that_were_hardly_drawn_are_drawn_like_others_of_the_same_error(photos, cache):
    """A cell of which nothing is known has no larger error than those of which much is."""
    needed = NeededRays(photos, 1.0)
    needed.look(cache)
    shown = torch.nonzero(needed.weights > 0).squeeze(1)
    for _ in range(30):
        needed.learn(shown[::2], torch.full((len(shown[::2]),), 0.02))
    needed.learn(shown[1:2], torch.tensor([0.02]))
    needed.look(cache)
    by_area = needed.weights[shown] / needed.size[shown].prod(1)
    torch.testing.assert_close(by_area, torch.full_like(by_area, 0.04))


def test_training_goes_on_from_a_checkpoint_with_the_same_rays():
    params = changed(TINY, {"sampling.cache_every": 4})
    through, killed = make_trainer(params), make_trainer(params)
    for step in range(20):
        through.step(step / 40)
        killed.step(step / 40)
    assert (through.needed.weights > 0).any()
    going_on = make_trainer(params)
    going_on.load_state(killed.state())
    for step in range(20, 23):
        expected, got = through.step(step / 40), going_on.step(step / 40)
        assert float(expected["loss"]) == float(got["loss"])


def test_all_rays_are_drawn_evenly_where_none_is_to_go_by_need():
    trainer = make_trainer(changed(TINY, {"sampling.needed_share": 0.0, "sampling.cache_every": 4}))
    for step in range(12):
        trainer.step(0.2 + step / 40)
    assert not np.asarray(trainer.needed.weights).any()
