"""The timing of a training step's parts: its scene, what all variants start from, and the table."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from benchmarks import ball_heap, step_speed
from benchmarks.ablate import VARIANTS
from configs.load import load_config


def test_the_first_hit_is_the_first_place_on_the_ray_inside_a_ball():
    rng = np.random.default_rng(0)
    origins = rng.normal(size=(120, 3))
    origins *= 2 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.uniform(-0.7, 0.7, (120, 3)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    distance, ball = ball_heap.first_hit(origins, directions)
    t = np.linspace(0, 4, 4001)
    places = origins[:, None] + t[:, None] * directions[:, None]
    inside = np.linalg.norm(places[:, :, None] - ball_heap.CENTERS, axis=3) < ball_heap.RADII  # [ray, place, ball]
    hit = inside.any((1, 2))
    assert 12 < hit.sum() < 108
    grazes = np.isfinite(distance) & ~hit
    assert grazes.sum() <= 3
    first = inside.any(2).argmax(1)
    assert np.abs(t[first] - distance)[hit].max() < 1.1e-3
    assert inside[np.arange(120), first, ball][hit].all()


def test_the_heap_lies_in_the_region_and_its_points_are_seen_where_the_photos_show_them():
    cameras = ball_heap.dome_of_cameras()
    scene = ball_heap.posed_scene(cameras)
    assert (np.linalg.norm(ball_heap.CENTERS, axis=1) + ball_heap.RADII).max() < 1
    image, point = scene.observations[::97].T
    assert len(image) > 100
    for i, place in zip(image.tolist(), scene.points[point].astype(float), strict=True):
        pixel, depth = cameras.project(i, place[None])
        assert depth > 0
        assert (pixel >= 0).all()
        assert (pixel < cameras.sizes[i]).all()
        _, ball = ball_heap.first_hit(*cameras.rays(i, pixel))
        assert np.linalg.norm(place - ball_heap.CENTERS[ball[0]]) == pytest.approx(ball_heap.RADII[ball[0]], abs=1e-6)


def test_variants_start_from_what_the_base_learned_and_timing_teaches_them_nothing(monkeypatch):
    for name, value in {"NUM_PHOTOS": 3, "WIDTH": 60, "HEIGHT": 45, "FOCAL": 62.0}.items():
        monkeypatch.setattr(ball_heap, name, value)
    small = [f"train.{text}" for text in ("cache_resolution=24", "rays=64", "log2_rows=10", "background_log2_rows=9")]
    monkeypatch.setattr(
        step_speed, "load_config", lambda preset, file, sets: load_config(preset, file, [*sets, *small])
    )
    monkeypatch.setattr(step_speed, "LEARNING_STEPS", 2)
    monkeypatch.setattr(step_speed, "STEPS_PER_TURN", 1)
    trainers = step_speed.variant_trainers(["terms-off", "all", "scale-learned"])
    first = trainers["terms-off"]
    base = first.fields.state_dict()
    assert (base["sdf.table"] - step_speed.noise_trainer(first.params).fields.sdf.table).abs().max() > 1e-3
    for trainer in trainers.values():
        state = trainer.fields.state_dict()
        assert all(torch.equal(state[name], value) for name, value in base.items())
        assert torch.equal(trainer.cache.values, first.cache.values)
    widths = [trainer.moment(step_speed.PARTS_PROGRESS).width for trainer in trainers.values()]
    assert widths == pytest.approx(widths[:1] * 3, rel=0.1)
    before = {name: {k: v.clone() for k, v in t.fields.state_dict().items()} for name, t in trainers.items()}
    seconds = step_speed.time_in_turn(trainers, rounds=1)
    assert all(wall > 0 and cpu > 0 for wall, cpu in seconds.values())
    for name, trainer in trainers.items():
        assert all(torch.equal(before[name][key], value) for key, value in trainer.fields.state_dict().items())


def test_the_table_compares_with_the_base_and_the_share_is_of_the_whole_step():
    seconds = {"terms-off": (0.1, 0.18), "all": (0.16, 0.24)}
    assert step_speed.parts_table(seconds).splitlines()[2:] == [
        "| terms-off | 100 | 180 | 1.00 | 1.00 |",
        "| all | 160 | 240 | 1.60 | 1.33 |",
    ]
    assert step_speed.share_of_terms(seconds) == (
        "The method's terms together take 38 % of a step's wall time and 25 % of its CPU time."
    )


def test_variants_must_exist(capsys):
    assert set(step_speed.PARTS) < set(VARIANTS)
    with pytest.raises(SystemExit):
        step_speed.main(["parts", "--variants", "terms-off,nonsense"])
    assert "no variant nonsense" in capsys.readouterr().err
