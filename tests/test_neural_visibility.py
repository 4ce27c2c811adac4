"""Visibility against brute force and the paper's numbers; the ambiguity weight against hand-made colours."""

from __future__ import annotations

import math

import pytest
import torch
from sphere_scene import render, ring_of_cameras

from stages.neural import visibility as vis
from stages.neural.photos import Photos
from stages.neural.sampling import SdfCache


def ball_cache(*balls: tuple[float, float, float, float], resolution: int = 96) -> SdfCache:
    """Union of balls (x, y, z, radius)."""
    cache = SdfCache(resolution, "cpu")
    centers, radii = torch.tensor(balls)[:, :3], torch.tensor(balls)[:, 3]
    cache.refresh(lambda p: (torch.cdist(p, centers) - radii).min(1).values)
    return cache


def directions_at(angle_deg: float, count: int = 16) -> torch.Tensor:
    """Unit directions [count, 3] at an angle to +z."""
    around = torch.arange(count) * 2 * math.pi / count
    angle = math.radians(angle_deg)
    return torch.stack(
        [math.sin(angle) * around.cos(), math.sin(angle) * around.sin(), torch.full((count,), math.cos(angle))], 1
    )


@pytest.mark.parametrize("incidence", [0, 30, 60, 75])
def test_a_lone_ball_is_visible_from_everywhere_in_front(incidence):
    directions = directions_at(incidence)
    points = torch.tensor([[0.0, 0, 0.5]]).expand(len(directions), 3).contiguous()
    margin = vis.path_margin(directions[:, 2], scale=0.005, voxel=2 / 96)
    smallest = vis.smallest_sdf_on_paths(ball_cache((0, 0, 0, 0.5)), points, points + 3 * directions, margin)
    assert (vis.sdf_visibility(smallest) > vis.VISIBLE).all()


def test_the_literal_product_fades_with_the_number_of_samples_the_sound_form_does_not():
    for count in (16, 64, 256):
        path = torch.linspace(0, 1, count) * 1.0  # f from 0 on the surface to 1 at the camera
        literal = vis.sdf_visibility_literal(path).item()
        assert vis.sdf_visibility(path.min()).item() > vis.VISIBLE
        assert literal < 0.5 + 1e-6
    assert literal < 0.1  # 256 samples: the surface hides itself


def test_a_thin_occluder_hides_and_the_one_behind_does_not():
    cache = ball_cache((0, 0, 0, 0.3), (0, 0, 0.7, 0.06))
    points = torch.tensor([[0.0, 0, 0.3], [0, 0, 0.3], [0, 0, -0.3]])
    targets = torch.tensor([[0.0, 0, 3], [3, 0, 1.2], [0, 0, -3]])
    smallest = vis.smallest_sdf_on_paths(cache, points, targets, torch.full((3,), 0.05))
    visible = vis.sdf_visibility(smallest)
    assert visible[0] < 0.3  # the cache blurs a ball of three cells
    assert (visible[1:] > vis.VISIBLE).all()


def test_sphere_tracing_meets_the_same_minimum_as_dense_samples():
    cache = ball_cache((0, 0, 0, 0.4), (0.5, 0.3, 0.2, 0.15), (-0.4, 0.4, 0.5, 0.1))
    generator = torch.Generator().manual_seed(0)
    points = torch.nn.functional.normalize(torch.randn(300, 3, generator=generator), dim=1) * 0.45
    targets = torch.nn.functional.normalize(torch.randn(300, 3, generator=generator), dim=1) * 3
    start = torch.full((300,), 0.03)
    traced = vis.smallest_sdf_on_paths(cache, points, targets, start)
    length = (targets - points).norm(dim=1, keepdim=True)
    t = torch.linspace(0.03, 4, 4000)
    places = points[:, None] + t[None, :, None] * ((targets - points) / length)[:, None]
    dense = cache.lookup(places)
    dense[(places.norm(dim=2) > 1) | (t[None] > length)] = 9.0
    dense = dense.min(1).values.clamp(max=2.0)
    agree = (vis.sdf_visibility(traced) > vis.VISIBLE) == (vis.sdf_visibility(dense) > vis.VISIBLE)
    assert agree.float().mean() > 0.98
    assert (traced >= dense - 1e-5).all()  # it looks at a subset of the path


def test_margin_grows_towards_grazing_angles_and_is_bounded():
    margin = vis.path_margin(torch.tensor([1.0, 0.5, 0.1, -1]), scale=0.01, voxel=0.004)
    assert margin.tolist() == pytest.approx([0.04, 0.08, 0.2, 0.2])


def test_trust_falls_with_ambiguity_and_keeps_its_mean():
    weights = vis.trust(torch.tensor([0.0, 1.0, 3.0]))
    assert weights.mean().item() == pytest.approx(1)
    assert (weights / weights[0]).tolist() == pytest.approx([1, 0.5, 0.25])


def test_mahalanobis_is_euclidean_for_unit_covariance_and_scales_with_it():
    colors, others = torch.tensor([[0.3, 0.4, 0.0]]), torch.zeros(1, 3)
    assert vis.mahalanobis(colors, others, torch.eye(3)).item() == pytest.approx(0.5)
    assert vis.mahalanobis(colors, others, 4 * torch.eye(3)).item() == pytest.approx(1.0)


def test_precision_is_the_inverse_covariance_of_the_photos():
    cameras = ring_of_cameras()
    photos = Photos(cameras, [render(cameras, i)[0] for i in range(8)], None, "cpu")
    precision = vis.color_precision(photos, torch.Generator().manual_seed(0))
    covariance = torch.cov((photos.pixels.float() / 255).T)
    torch.testing.assert_close(precision @ covariance, torch.eye(3), atol=0.05, rtol=0.05)


def test_ambiguity_counts_visible_views_only():
    visibility = torch.tensor([[0.95, 0.5, 1.0], [0.1, 0.2, 0.3]])
    distance = torch.tensor([[2.0, 100, 4], [5, 5, 5]])
    assert vis.ambiguity(visibility, distance).tolist() == pytest.approx([(1.9 + 4) / 2, 0])
