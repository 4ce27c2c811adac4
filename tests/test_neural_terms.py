"""The method's parts in a whole training step: each form of each does something, and only what it should."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from ball_training import SMALL, TINY, even_rays, make_trainer
from sphere_scene import RADIUS, ring_of_cameras
from train_settings import changed

from configs.dotted import flatten
from configs.load import load_config
from configs.training import TrainParams
from stages.neural import visibility
from stages.neural.terms.ambiguity import Ambiguity
from stages.neural.terms.planar import Planar
from stages.neural.trainer import Trainer

FORMS = {
    "terms.ambiguity.form": ["paper", "stable"],
    "terms.reflection.form": ["paper", "stable"],
    "terms.planar.form": ["paper", "stable"],
    "terms.eikonal.form": ["paper", "stable"],
    "density.form": ["neus"],
    "density.scale": ["learned"],
    "field.gradients": ["numerical"],
    "field.encoding": ["frequency"],
    "sampling.sampler": ["proposal"],
}
DEFAULTS = flatten(TrainParams().model_dump())
OFF = {name: DEFAULTS[name] for name in FORMS} | {
    "terms.ambiguity.form": "off", "terms.reflection.form": "off", "terms.planar.form": "off",
    "terms.eikonal.form": "plain",
}  # fmt: skip

SHARP_BALL = {"field.sphere_radius": RADIUS, "density.scale_start": 0.01}
# so that the ball reaches the floor of `put_on_a_floor`
FLOOR = {"sampling.cache_resolution": 64, "terms.reflection.reach": 0.5}


def rough_trainer(settings: dict[str, Any] | None = None) -> Trainer:
    """A trainer whose surface is dented: a perfect sphere has no Eikonal error and mirrors nothing of itself."""
    trainer = make_trainer(changed(TINY, {**OFF, "density.scale_start": 0.02, **(settings or {})}))
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        if trainer.fields.sdf.table is not None:
            trainer.fields.sdf.table += 0.02 * torch.randn(trainer.fields.sdf.table.shape, generator=generator)
    return trainer


def ambiguity_of(trainer: Trainer) -> Ambiguity:
    return next(term for term in trainer.terms.all if isinstance(term, Ambiguity))


def put_on_a_floor(trainer: Trainer) -> None:
    """Let the cached grid say that the ball stands on a floor, which it mirrors; the networks know nothing of it."""
    cache, side = trainer.cache, trainer.cache.resolution
    places = cache.points(torch.arange(side**3))
    floor = places[:, 2] + TINY.field.sphere_radius
    cache.values.view(-1).copy_(torch.minimum(places.norm(dim=1) - TINY.field.sphere_radius, floor))
    trainer.cache_step = trainer.step_index


def gradients_of(trainer: Trainer) -> dict[str, torch.Tensor]:
    return {name: p.grad for name, p in trainer.fields.named_parameters() if p.grad is not None}


@pytest.mark.parametrize(("setting", "form"), [(name, form) for name, forms in FORMS.items() for form in forms])
def test_each_form_of_each_part_changes_the_gradients_of_a_step(setting, form):
    base, other = rough_trainer(FLOOR), rough_trainer({**FLOOR, setting: form})
    for trainer in (base, other):
        put_on_a_floor(trainer)
    numbers = [trainer.step(0.5) for trainer in (base, other)]
    assert {k for k, v in numbers[1].items() if not torch.isfinite(v)} == set()
    before, after = gradients_of(base), gradients_of(other)
    assert all(torch.isfinite(g).all() for g in after.values())
    changed = [
        name
        for name in after
        if name not in before
        or before[name].shape != after[name].shape
        or (before[name] - after[name]).abs().max() > 1e-4 * before[name].abs().max()
    ]
    assert any(name.startswith("sdf.") for name in changed)


def test_terms_that_are_off_count_nothing():
    trainer = rough_trainer()
    numbers = trainer.step(0.5)
    assert (numbers["planar"], numbers["reflected"]) == (0, 0)
    assert {name.split(".")[0] for name, _ in trainer.fields.named_parameters()} == {
        "sdf", "radiance", "background", "log_gains",
    }  # fmt: skip


@pytest.mark.parametrize(("visibility", "doubt"), [("paper", 0.95), ("network", 0.95), ("stable", 0.7), ("mesh", 0.7)])
def test_the_ambiguity_weight_trusts_a_painted_ball_and_doubts_a_shifting_one(visibility, doubt):
    """Every second photo shows other colours in its upper half: rays at the ball's upper half are doubted."""
    settings = {"terms.ambiguity.form": "stable", "terms.ambiguity.visibility": visibility, **SHARP_BALL}
    trainer = make_trainer(changed(TINY, settings))
    trainer._refresh_cache(trainer.moment(0.5))
    batch = even_rays(trainer.photos, 400)
    with torch.no_grad():
        rendered = trainer.render(batch, 0.5)
    on_ball = rendered.opacity > 0.5
    assert 50 < int(on_ball.sum()) < 350
    height = rendered.surface[0][:, 2]
    upper, lower = on_ball & (height > 0.05), on_ball & (height < -0.05)

    def trust(progress: float = 0.5) -> torch.Tensor:
        weights = trainer.terms.color_weight(rendered, rendered.colors, trainer.moment(progress))
        assert torch.equal(weights[~on_ball], torch.ones(400)[~on_ball])  # nothing is known there
        return weights

    assert torch.equal(trust(0.1), torch.ones(400))  # not yet
    consistent = trust()
    assert consistent[on_ball].mean().item() == pytest.approx(1)
    pixels = trainer.photos.pixels.view(8, 40, 48, 3)
    pixels[::2, :20] = 255 - pixels[::2, :20]
    shifting = trust()
    ratio = [weights[upper].mean() / weights[lower].mean() for weights in (consistent, shifting)]
    assert ratio[1] < doubt * ratio[0]  # the paper's visibility leaves few views to disagree


def test_the_ambiguity_weight_is_that_of_a_loop_over_rays_and_photos():
    settings = {"terms.ambiguity.form": "stable", **SHARP_BALL}
    trainer = make_trainer(changed(TINY, settings))
    photos, moment, cameras = trainer.photos, trainer.moment(0.5), ring_of_cameras()
    photos.training[3] = False
    trainer.fields.log_gains.data.copy_(0.1 * torch.randn(8, 3, generator=torch.Generator().manual_seed(0)))
    gains, precision = trainer.fields.log_gains.exp().detach(), ambiguity_of(trainer).color_precision
    trainer._refresh_cache(moment)
    batch = even_rays(photos, 60)
    with torch.no_grad():
        rendered = trainer.render(batch, 0.5)
    surface, normals = rendered.surface
    margin = max(moment.voxel, trainer.cache.cell / 2)
    doubt = []
    for ray, own in enumerate(batch.images.tolist()):
        summed, count = 0.0, 0
        for view in {*range(8)} - {own, 3}:
            to_camera = torch.nn.functional.normalize(photos.centers[view] - surface[ray], dim=0)
            facing = (to_camera * normals[ray]).sum()
            pixel, _ = cameras.project(view, surface[ray, None].double().numpy())
            x, y = np.floor(pixel[0]).astype(int)
            in_frame = 0 <= x < 48 and 0 <= y < 40
            if rendered.opacity[ray] <= 0.5 or facing <= 0 or not in_frame:
                continue
            start = visibility.path_margin(facing, moment.width, margin)[None]
            path = surface[ray, None], photos.centers[view, None]
            seen = visibility.sdf_visibility(visibility.smallest_sdf_on_paths(trainer.cache, *path, start)).item()
            if seen > visibility.VISIBLE:
                color = photos.pixels[photos.first[view] + 48 * y + x] / 255 / gains[view]
                difference = batch.colors[ray] / gains[own] - color
                summed += seen * (difference @ precision @ difference).sqrt().item()
                count += 1
        doubt.append(summed / max(count, 1))
    assert 10 < sum(each > 0 for each in doubt) < 50
    weights, met = 1 / (1 + torch.tensor(doubt)), rendered.opacity > 0.5
    weights[met] /= weights[met].mean()
    fast = trainer.terms.color_weight(rendered, rendered.colors, moment)
    torch.testing.assert_close(fast, weights, rtol=1e-4, atol=1e-5)


def test_masks_take_rays_out_of_the_ambiguity_weight():
    trainer = make_trainer(changed(TINY, {"terms.ambiguity.form": "stable", "density.scale_start": 0.01}), masks=True)
    trainer._refresh_cache(trainer.moment(0.5))
    batch = even_rays(trainer.photos, 400)
    with torch.no_grad():
        rendered = trainer.render(batch, 0.5)
    weights = trainer.terms.color_weight(rendered, rendered.colors, trainer.moment(0.5))
    counted = (rendered.opacity > 0.5) & (batch.masks > 0.5)
    assert int(counted.sum()) < int((rendered.opacity > 0.5).sum())  # the first sphere is larger than the ball
    assert weights[counted].mean().item() == pytest.approx(1)
    assert (weights[~counted] == 1).all()


def test_the_papers_weight_carries_a_gradient_and_the_stable_one_none():
    for form, carries in (("paper", True), ("stable", False)):
        settings = {"terms.ambiguity.form": form, **SHARP_BALL}
        trainer = make_trainer(changed(TINY, settings))
        trainer._refresh_cache(trainer.moment(0.5))
        batch = even_rays(trainer.photos, 200)
        rendered = trainer.render(batch, 0.5)
        weights = trainer.terms.color_weight(rendered, rendered.colors, trainer.moment(0.5))
        assert weights.requires_grad is carries


def test_a_learned_scale_learns_and_a_scheduled_one_ends_at_its_end():
    trainer = rough_trainer({"density.scale": "learned"})
    before = trainer.moment(0.5).width
    assert before == pytest.approx(0.02 + 0.1 * trainer.fields.shape.sdf_grid.voxel_size(), rel=1e-5)
    trainer.step(0.5)
    assert trainer.moment(0.5).width != before
    scheduled = rough_trainer({"density.scale_end": 0.011})
    half_voxel = 0.5 * scheduled.fields.shape.sdf_grid.voxel_size()
    assert scheduled.moment(1.0).width == pytest.approx(max(0.011, half_voxel))


def test_reflection_waits_for_its_start_and_colours_only_rays_that_meet_something():
    trainer = rough_trainer({"terms.reflection.form": "stable", **FLOOR})
    put_on_a_floor(trainer)
    batch = even_rays(trainer.photos, 400)
    with torch.no_grad():
        early, late = (trainer.render(batch, progress) for progress in (0.2, 0.5))
        trainer.fields.reflection = None
        plain = trainer.render(batch, 0.5)
    assert early.reflected.abs().max() == 0
    met, hit = late.reflected > 0, late.opacity > 0.5
    assert 0 < int(met.sum()) < int(hit.sum())
    assert not met[~hit].any()
    torch.testing.assert_close(late.colors[~met], plain.colors[~met])
    assert (late.colors[met] - plain.colors[met]).abs().max() > 1e-4


@pytest.mark.parametrize("backbone", ["neus2", "hfneus", "neuralangelo"])
def test_every_backbone_trains(backbone):
    trainer = make_trainer(changed(load_config(None, None, [f"train.backbone={backbone}"]).train, SMALL))
    first, second = (trainer.step(progress) for progress in (0.3, 0.31))
    assert torch.isfinite(first["loss"])
    assert second["rgb"] < first["rgb"] * 1.5
    assert all(p.grad is not None for p in trainer.fields.parameters())


def test_the_feature_mlp_is_trained_by_colours_where_a_stable_term_reads_it():
    trainer = rough_trainer({"terms.planar.features": "mlp", "terms.eikonal.form": "stable"})
    assert trainer.step(0.5)["appearance"] > 0
    assert trainer.fields.appearance.head.weight.grad.abs().max() > 0
    literal = rough_trainer({"terms.planar.features": "mlp", "terms.planar.form": "paper"})
    assert literal.step(0.5)["appearance"] == 0
    assert literal.fields.appearance.layers[0].weight.grad.abs().max() > 0  # by lambda_pla alone
    assert literal.fields.appearance.head.weight.grad is None


def test_one_photo_each_shows_what_it_shows_among_all():
    photos = make_trainer(masks=True).photos
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) * 2 - 1
    images = torch.arange(50) % len(photos)
    colors, shown = photos.observe(points)
    found, seen = photos.colors_at(images, points)
    assert 5 < int(seen.sum()) < 45
    assert (seen == shown[torch.arange(50), images]).all()
    torch.testing.assert_close(found[seen], colors[torch.arange(50), images][seen])


def planar_of(trainer: Trainer, low: int, high: int, progress: float = 0.5) -> float:
    """The planar term on photos of random colours between two grey levels."""
    generator = torch.Generator().manual_seed(0)
    trainer.photos.pixels.random_(low, high + 1, generator=generator)
    trainer.generator.manual_seed(0)
    batch = even_rays(trainer.photos, 400)
    with torch.no_grad():
        rendered, moment = trainer.render(batch, progress), trainer.moment(progress)
        term = next(term for term in trainer.terms.all if isinstance(term, Planar))
        return float(term.losses(rendered, moment)["planar"][1])


def test_the_planar_term_waits_and_then_looks_at_even_places_only():
    trainer = rough_trainer({"terms.planar.form": "stable"})
    assert planar_of(trainer, 128, 128, progress=0.49) == 0
    even = planar_of(trainer, 128, 128)
    assert even > 0.01
    assert planar_of(trainer, 0, 255) < 0.6 * even  # neighbours in the same pixel stay


def test_the_planar_term_leaves_known_places_alone():
    trainer = rough_trainer({"terms.planar.form": "stable"})
    trainer.evidence.known.fill_(1)
    assert planar_of(trainer, 128, 128) == pytest.approx(0, abs=1e-6)


def test_the_planar_term_is_the_same_where_shapes_are_fixed(monkeypatch):
    trainer = rough_trainer({"terms.planar.form": "stable", "terms.planar.rays": 2000})
    shrinking = planar_of(trainer, 128, 128)
    monkeypatch.setattr("stages.neural.terms.planar.fixed_shapes", lambda device: True)
    assert planar_of(trainer, 128, 128) == pytest.approx(shrinking, rel=0.2)  # with other neighbours


def test_the_proposal_network_learns_in_its_steps_only():
    trainer = rough_trainer({"sampling.sampler": "proposal", "sampling.proposal_updates": 1})
    assert trainer.step(0.5)["proposal"] > 0
    assert all(p.grad.abs().max() > 0 for p in trainer.fields.proposal.parameters())
    assert trainer.step(0.5)["proposal"] == 0
    assert all(p.grad is None for p in trainer.fields.proposal.parameters())


def test_batches_that_meet_nothing_render(monkeypatch):
    """A strip of a preview may miss the region altogether."""
    trainer = rough_trainer({"terms.reflection.form": "stable"})
    batch = trainer.photos.rays(torch.zeros(3, dtype=torch.long), torch.full((3, 2), -1e6))
    assert len(batch.leave) == 0
    rendered = trainer.render(batch, 0.5)
    assert rendered.colors.shape == rendered.surface[0].shape == (0, 3)


def test_the_papers_preset_steps_with_small_networks():
    config = load_config("paper").train
    smaller = SMALL | {
        "terms.planar.rays": 16, "terms.ambiguity.samples": 8, "terms.reflection.samples": 4,
        "sampling.proposal_samples": 16, "field.finest": 64, "field.sdf_layers": 3, "losses.sparse_batch": 0,
    }  # fmt: skip
    trainer = make_trainer(changed(config, smaller))
    numbers = [trainer.step(progress) for progress in (0.0, 0.01)]
    assert all(torch.isfinite(value) for value in numbers[1].values())
    assert numbers[1]["planar"] > 0
    assert numbers[1]["reflected"] > 0.1  # S is at least about a half on every ray that hits
