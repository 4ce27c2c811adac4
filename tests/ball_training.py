"""A small training on the photos of a ball."""

from __future__ import annotations

import torch
from sphere_scene import RADIUS, render, ring_of_cameras, sphere_cloud, sphere_scene
from train_settings import changed, small

from configs.training import TrainParams
from stages.geometry.cameras import PinholeCameras
from stages.neural.needed_rays import NeededRays
from stages.neural.sightings import Sightings
from stages.neural.trainer import Trainer
from stages.neural.training_photos import Photos, RayBatch

SMALL = {
    "steps": 60, "sampling.rays": 128, "sampling.samples": 12, "field.levels": 4, "field.log2_rows": 10,
    "field.coarsest": 8, "field.finest": 32, "field.sdf_width": 16, "field.radiance_width": 16,
    "schedule.start_levels": 2, "sampling.free_points": 64, "losses.sparse_batch": 32, "losses.dense_batch": 32,
    "sampling.cache_resolution": 24, "sampling.cache_every": 16, "field.background_log2_rows": 9,
    "sampling.background_samples": 4,
}  # fmt: skip
TINY = small(SMALL)


def make_trainer(params: TrainParams = TINY, masks: bool = False, device: str = "cpu") -> Trainer:
    cameras = ring_of_cameras()
    views = [render(cameras, i) for i in range(len(cameras))]
    photos = Photos(cameras, [v[0] for v in views], [v[1] for v in views] if masks else None, device)
    return Trainer(photos, *ball_sightings(cameras, device), params, device)


def even_rays(photos: Photos, count: int) -> RayBatch:
    """Drawn evenly from the photos that are trained on."""
    return NeededRays(photos, share=0.0).draw(count, torch.Generator().manual_seed(0))[0]


def ball_sightings(cameras: PinholeCameras, device: str = "cpu") -> tuple[Sightings, Sightings]:
    """Of sparse points and of dense ones on the ball."""
    dense = Sightings.from_cloud(sphere_cloud(cameras), cameras.centers, device)
    return Sightings.from_scene(sphere_scene(cameras), device), dense


def color_error(trainer: Trainer, progress: float) -> float:
    """Mean error on the masks of rays drawn evenly; those of the training are drawn where errors are large."""
    batch = even_rays(trainer.photos, 512)
    with torch.no_grad():
        error = (trainer.render(batch, progress).colors - batch.colors).abs().mean(1) * batch.masks
    return float(error.mean())


def assert_finds_the_ball(settings: dict[str, object]) -> None:
    params = changed(TINY, {"steps": 300, "sampling.rays": 256, "field.sphere_radius": 0.6, **settings})
    trainer = make_trainer(params, masks=True)
    first = color_error(trainer, 0.0)
    for i in range(params.steps):
        trainer.step(i / params.steps)
    assert color_error(trainer, 1.0) < 0.4 * first
    points = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    # The sides the cameras see: within 60 degrees of the horizon.
    points = RADIUS * points[points[:, 2].abs() < 0.8]
    with torch.no_grad():
        assert trainer.fields.sdf.sdf(points, params.field.levels).abs().median() < 0.02
