"""Patches of the photos compared across a surface's tangent plane: a textured table seen by four cameras."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from rigs import NORTH, capture, look_at
from test_neural_terms import gradients_of, rough_trainer

from stages.geometry.cameras import PinholeCameras
from stages.neural import consistency
from stages.neural.consistency import NO_PATCH, mean_of_best, patch_errors, patch_trust, slide_to_surface, views_beside
from stages.neural.training_photos import Photos

UP = torch.tensor([[0.0, 0, 1]])


def cameras_over_a_table(width: int = 96, height: int = 80) -> PinholeCameras:
    """Four cameras, up to 30 degrees aside, that look down at the origin of the table z = 0."""
    centers = ((0.0, 0.0, 2.0), (0.8, 0.1, 2.0), (-0.7, 0.5, 2.0), (0.1, -1.2, 2.0))
    poses = [look_at(np.array(center), np.zeros(3), NORTH) for center in centers]
    return capture(poses, size=(width, height), focal=120.0)


def pattern(places: np.ndarray) -> np.ndarray:
    """Smooth colours [M, 3] uint8 of places [M, 2] on the table, different along both axes."""
    x, y = places.T
    waves = [np.sin(11 * x + 3 * y), np.sin(13 * y - 4 * x), np.cos(9 * x + 8 * y)]
    return np.uint8(255 * (0.5 + 0.4 * np.stack(waves, 1)))


def table_photos(paint=pattern) -> Photos:
    cameras = cameras_over_a_table()
    images = []
    for i, (width, height) in enumerate(cameras.sizes):
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        origins, directions = cameras.rays(i, np.stack([x.ravel(), y.ravel()], 1))
        depth = -origins[:, 2] / directions[:, 2]
        places = (origins + depth[:, None] * directions)[:, :2]
        images.append(paint(places).reshape(height, width, 3))
    return Photos(cameras, images, None, "cpu")


def errors_at(photos: Photos, points: torch.Tensor, step: int = 1, normals: torch.Tensor = UP) -> torch.Tensor:
    """Errors [Q, 3] of the first photo's patches at points [Q, 3] against the three others."""
    images = torch.zeros(len(points), dtype=torch.long)
    planes = consistency.tangent_planes(photos, images, points, normals.expand_as(points))
    views = torch.tensor([[1, 2, 3]]).expand(len(points), 3).contiguous()
    return patch_errors(photos, images, consistency.pixels_of(photos, images, points), planes, views, step)


def test_photos_agree_on_the_surface_and_differ_off_it():
    photos = table_photos()
    on_table = torch.tensor([[0.0, 0, 0], [0.1, -0.05, 0], [-0.15, 0.1, 0]])
    right, wrong = errors_at(photos, on_table), errors_at(photos, on_table + 0.1 * UP)
    assert (right >= 0).all()
    assert right.max() < 0.01
    assert (wrong.mean(1) > 50 * right.mean(1)).all()


def test_a_plane_that_leans_the_wrong_way_costs():
    photos, point = table_photos(), torch.zeros(1, 3)
    leaning = torch.nn.functional.normalize(torch.tensor([[0.5, 0.2, 1.0]]), dim=1)
    assert errors_at(photos, point, 2, leaning).mean() > 5 * errors_at(photos, point, 2).mean()


def test_flat_patches_say_nothing_and_unrelated_ones_differ_by_one():
    grey = table_photos(lambda places: np.full((len(places), 3), 90, np.uint8))
    assert errors_at(grey, torch.zeros(1, 3)).abs().max() < 1e-3
    rng = np.random.default_rng(0)
    noise = table_photos(lambda places: rng.integers(0, 256, (len(places), 3), dtype=np.uint8))
    points = torch.rand(60, 3, generator=torch.Generator().manual_seed(0)) * 0.3 * torch.tensor([1.0, 1, 0])
    assert errors_at(noise, points).mean() == pytest.approx(1, abs=0.05)


def test_exposure_makes_little_difference():
    dark = table_photos(lambda places: np.uint8(0.7 * pattern(places)))
    bright = table_photos()
    half = len(bright.pixels) // 4
    bright.pixels[half:] = dark.pixels[half:]  # all but the first photo
    assert errors_at(bright, torch.zeros(1, 3)).max() < 0.02


def test_patches_that_leave_a_photo_have_no_error():
    photos = table_photos()
    outside = torch.tensor([[0.79, 0, 0]])  # in the first photo's last columns
    assert (errors_at(photos, outside) == NO_PATCH).all()
    assert (errors_at(photos, torch.tensor([[0.0, 0, 2.5]])) == NO_PATCH).all()  # behind the cameras


@pytest.mark.parametrize("step", [1, 2])
def test_the_kernel_and_plain_torch_agree(step, monkeypatch):
    photos = table_photos()
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(200, 3, generator=generator) * torch.tensor([1.8, 1.5, 0.2]) - torch.tensor([0.9, 0.75, 0.1])
    weights = torch.rand(200, 3, generator=generator)
    found = []
    for kernel in (True, False):
        monkeypatch.setattr(consistency, "takes_kernel", lambda *_, kernel=kernel: kernel)
        at = points.clone().requires_grad_()
        errors = errors_at(photos, at, step)
        (weights * errors * (errors >= 0)).sum().backward()
        found.append((errors.detach(), at.grad))
    (errors, slopes), (expected, expected_slopes) = found
    assert 0.2 < (errors >= 0).float().mean() < 0.98
    assert torch.equal(errors < 0, expected < 0)
    assert (errors - expected).abs().max() < 1e-4
    assert (slopes - expected_slopes).abs().max() < 1e-3 * expected_slopes.abs().max()


def test_the_slope_leads_back_to_the_surface():
    photos = table_photos()
    height = torch.tensor(0.06, requires_grad=True)
    optimizer = torch.optim.Adam([height], lr=0.003)
    for _ in range(80):
        optimizer.zero_grad()
        errors_at(photos, height * UP, step=2).mean().backward()
        optimizer.step()
    assert abs(height.item()) < 0.003


def test_points_slide_to_a_plane_along_their_rays():
    direction = torch.tensor([[0.6, 0.0, -0.8]])
    sdf = torch.tensor([0.008], requires_grad=True)  # of the plane z = 0
    point = torch.tensor([[0.0, 0.0, 0.008]])
    moved = slide_to_surface(point, direction, sdf, UP)
    assert torch.allclose(moved, torch.tensor([[0.006, 0, 0]]), atol=1e-6)
    moved.sum().backward()
    # x = p - f v / (g.v): d(sum x) / df = -(0.6 - 0.8) / -0.8
    assert sdf.grad.item() == pytest.approx(-0.25)
    grazing = torch.nn.functional.normalize(torch.tensor([[1.0, 0.0, -0.05]]), dim=1)
    assert torch.equal(slide_to_surface(point, grazing, sdf, UP), point)
    assert (slide_to_surface(point, direction, sdf + 9, UP) - point).norm().item() == pytest.approx(0.02)


def test_photos_from_beside_the_ray_are_chosen():
    angles = torch.deg2rad(torch.tensor([0.0, 3, 24, 60, 100, 27]))
    centers = torch.stack([angles.sin(), torch.zeros(6), angles.cos()], 1)
    candidates = torch.tensor([[True, True, True, True, True, False]])
    views, facing, fit = views_beside(centers, torch.zeros(1, 3), UP, -UP, candidates, 3)
    assert views[0, 0] == 2  # 24 degrees; not the one at 27, which is no candidate
    assert views[0, 1] == 3
    assert fit[0].tolist() == [True, True, False]  # along the ray, nearly so, or behind the surface
    assert torch.allclose(facing[0, :2], angles[[2, 3]].cos())


def test_the_best_photos_count():
    errors = torch.tensor([[0.1, 0.3, 0.9, 0.2], [0.1, 1.5, 0.2, 0.5], [0.4, 0.2, 0.3, 0.1]], requires_grad=True)
    valid = torch.tensor([[True, True, True, False], [True, True, False, False], [False] * 4])
    mean = mean_of_best(errors, valid, 2)
    assert torch.allclose(mean, torch.tensor([0.2, 0.0, 0.0]))  # two; one is too few; none
    mean.sum().backward()
    assert torch.allclose(errors.grad, torch.tensor([[0.5, 0.5, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0]]))


def test_doubtful_patches_count_less():
    doubt = torch.tensor([0.0, 0.5, 1.0], requires_grad=True)
    assert torch.allclose(patch_trust(doubt), torch.tensor([1, 0.5, 1 / 17]))
    assert not patch_trust(doubt).requires_grad


def test_in_a_step_the_term_reaches_the_surface_once_it_has_begun():
    settings = {"consistency_from": 0.4, "weight_consistency": 10.0}
    off, on = rough_trainer(consistency_from=0.4, weight_consistency=0.0), rough_trainer(**settings)
    before, after = (rough_trainer(**settings).step(progress) for progress in (0.39, 0.41))
    assert before["consistency"] == 0
    assert 0 < after["consistency"] < 1
    for trainer in (off, on):
        trainer.step(0.5)
    table = "sdf.table"
    assert (gradients_of(on)[table] - gradients_of(off)[table]).abs().max() > 1e-3 * gradients_of(off)[
        table
    ].abs().max()
