"""Visibility against brute force and the paper's numbers; the ambiguity weight against hand-made colours."""

from __future__ import annotations

import math
import sys
from functools import lru_cache

import numpy as np
import pytest
import torch
from sphere_scene import render, ring_of_cameras
from train_settings import small

from stages.errors import ReconstructionError, SystemRequirementError
from stages.neural import visibility as vis
from stages.neural.fields import Fields
from stages.neural.sampling import SdfCache, free_outside
from stages.neural.terms import ambiguity as amb
from stages.neural.trainer import field_shape
from stages.neural.training_photos import Photos


@lru_cache
def ball_cache(*balls: tuple[float, float, float, float], resolution: int = 96) -> SdfCache:
    """Union of balls (x, y, z, radius). Shared between tests: not to be written to."""
    cache = SdfCache(resolution, "cpu")
    cache.refresh(lambda p: torch.stack([(p - torch.tensor(b[:3])).norm(dim=1) - b[3] for b in balls]).amin(0))
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


def paths(start: tuple[float, float, float], end: tuple[float, float, float], count: int = 1):
    return tuple(torch.tensor([place], dtype=torch.float32).expand(count, 3).contiguous() for place in (start, end))


@pytest.mark.parametrize(("num_samples", "mean"), [(16, 0.957), (64, 0.837), (256, 0.491), (1024, 0.058)])
def test_algorithm_1_fades_with_its_samples_as_the_closed_form_says(num_samples, mean):
    # f = distance to the surface along a path of 2.5 at a right angle: the mean of a factor is 1 - ln 2 / (beta L).
    assert (1 - math.log(2) / (100 * 2.5)) ** num_samples == pytest.approx(mean, abs=5e-4)
    count = 1 << 17 >> int(math.log2(num_samples))
    points, centers = paths((0, 0, 0.5), (0, 0, 3), count)
    cache, generator = ball_cache((0, 0, 0, 0.5)), torch.Generator().manual_seed(0)
    literal = vis.visibility_literal(cache.lookup, points, centers, num_samples, generator)
    assert literal.mean().item() == pytest.approx(mean, abs=0.03)
    smallest = vis.smallest_sdf_on_paths(cache, points[:1], centers[:1], torch.tensor([0.04]), num_samples)
    assert vis.sdf_visibility(smallest).item() > 0.95


def test_algorithm_1_hides_what_is_behind_and_depends_on_its_sharpness_and_draw():
    cache = ball_cache((0, 0, 0, 0.5))
    points, centers = paths((0, 0, -0.5), (0, 0, 3), 50)
    draw = torch.Generator().manual_seed
    assert vis.visibility_literal(cache.lookup, points, centers, 64, draw(0)).max() < 1e-6
    front, centers = paths((0, 0, 0.5), (0, 0, 3), 50)
    soft, sharp = (vis.visibility_literal(cache.lookup, front, centers, 64, draw(1), beta) for beta in (10, 1000))
    assert soft.mean() < 0.3
    assert sharp.mean() > 0.95
    assert torch.equal(sharp, vis.visibility_literal(cache.lookup, front, centers, 64, draw(1), 1000))
    assert not torch.equal(soft, vis.visibility_literal(cache.lookup, front, centers, 64, draw(2), 10))


def test_algorithm_1_is_the_paper_s_loop():
    cache = ball_cache((0, 0, 0, 0.4), (0.3, 0, 0.6, 0.1))
    points, centers = torch.tensor([[0.0, 0, 0.4], [0.4, 0, 0]]), torch.tensor([[0.4, 0.1, 2.5], [0.3, 0.2, -2.0]])
    fast = vis.visibility_literal(cache.lookup, points, centers, 8, torch.Generator().manual_seed(5))
    draws = torch.rand(2, 8, 1, generator=torch.Generator().manual_seed(5))
    for i in range(2):
        product, length = 1.0, (points[i] - centers[i]).norm()
        direction = (points[i] - centers[i]) / length
        for k in range(8):
            place = centers[i] + draws[i, k] * length * direction
            f = max(cache.lookup(place[None]).item(), place.norm().item() - 1)
            product /= 1 + math.exp(-100 * f)
        assert fast[i].item() == pytest.approx(product, rel=1e-4, abs=1e-9)


def test_algorithm_1_misses_a_thin_occluder_that_the_others_find():
    cache = ball_cache((0, 0, 0, 0.3), (0, 0, 0.7, 0.06))
    points, centers = paths((0, 0, 0.3), (0, 0, 3), 400)
    literal = vis.visibility_literal(cache.lookup, points, centers, 16, torch.Generator().manual_seed(0))
    assert (literal > 0.5).float().mean() > 0.3  # no sample falls into 0.12 of 2.7 in (1 - 0.12 / 2.7)^16 = 48 %
    assert (literal < 0.1).float().mean() > 0.1
    start = torch.full((400,), 0.05)
    assert (vis.sdf_visibility(vis.smallest_sdf_on_paths(cache, points, centers, start)) < 0.3).all()
    assert (vis.MeshVisibility(cache)(points, centers, start) == 0).all()


def test_nothing_outside_the_unit_sphere_hides():
    cache = SdfCache(48, "cpu")
    radius = cache.points(torch.arange(48**3)).norm(dim=1)
    cache.values.view(-1).copy_(torch.where(radius < 1.05, radius - 0.5, -torch.ones(48**3)))
    points, centers = paths((0.29, 0.29, 0.29), (2.0, 2.0, 2.0), 64)
    assert (cache.lookup(torch.linspace(0.7, 2, 9)[:, None].expand(9, 3)) < 0).all()
    assert vis.visibility_literal(cache.lookup, points, centers, 16, torch.Generator().manual_seed(0)).mean() > 0.8
    assert (vis.MeshVisibility(cache)(points, centers, torch.full((64,), 0.05)) == 1).all()
    assert free_outside(torch.tensor([0.3, -1.0, 0.2]), torch.tensor([0.5, 3.0, 1.1])).tolist() == pytest.approx(
        [0.3, 2.0, 0.2]
    )


def test_a_mesh_shows_the_front_and_hides_the_back_of_a_ball():
    cache = ball_cache((0.1, 0, 0, 0.5))  # off the centre: axes in the wrong order would show
    directions = torch.nn.functional.normalize(torch.randn(400, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    points = torch.tensor([0.1, 0, 0]) + 0.5 * directions
    centers = torch.tensor([[2.0, -1.5, 1.0]]).expand(400, 3)
    facing = (torch.nn.functional.normalize(centers - points, dim=1) * directions).sum(1)
    visible = vis.MeshVisibility(cache)(points, centers, vis.path_margin(facing, 0.002, 0.01))
    assert set(visible.tolist()) == {0.0, 1.0}
    assert (visible[facing > 0.1] == 1).all()
    assert (visible[facing < -0.3] == 0).all()


def test_the_mesh_follows_the_cache():
    cache = SdfCache(40, "cpu")
    cache.refresh(lambda p: p.norm(dim=1) - 0.3)
    mesh = vis.MeshVisibility(cache)
    points, centers = paths((0, 0, 0.3), (0, 0, 3))
    start = torch.tensor([0.05])
    assert mesh(points, centers, start).tolist() == [1]
    scene = mesh.scene
    mesh(points, centers, start)
    assert mesh.scene is scene
    cache.values.copy_(ball_cache((0, 0, 0, 0.3), (0, 0, 0.7, 0.2), resolution=40).values)
    assert mesh(points, centers, start).tolist() == [0]
    cache.refresh(lambda p: p.norm(dim=1) + 1)  # nothing solid, no face
    assert mesh(points, centers, start).tolist() == [1]


def test_a_camera_nearer_than_the_margin_sees():
    points, centers = paths((0, 0, 0.5), (0, 0, 0.52))
    assert vis.MeshVisibility(ball_cache((0, 0, 0, 0.5), resolution=40))(
        points, centers, torch.tensor([0.05])
    ).tolist() == [1]


def ambiguity_term(form: str, photos: Photos | None = None, visibility: str = "stable") -> amb.Ambiguity:
    params = small({"terms.ambiguity.form": form, "terms.ambiguity.visibility": visibility})
    return amb.Ambiguity(Fields(field_shape(params, 8, background=False)), ball_cache((0, 0, 0, 0.5)), params, photos)


def test_without_open3d_the_setting_that_needs_it_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(ModuleNotFoundError):
        vis.MeshVisibility(ball_cache((0, 0, 0, 0.5)))
    with pytest.raises(SystemRequirementError, match=r"train\.terms\.ambiguity\.visibility.*open3d") as error:
        _ = ambiguity_term("stable", visibility="mesh").mesh_visibility
    assert "train.terms.ambiguity.visibility=stable" in error.value.hint


def test_margin_grows_towards_grazing_angles_and_is_bounded():
    margin = vis.path_margin(torch.tensor([1.0, 0.5, 0.1, -1]), scale=0.01, voxel=0.004)
    assert margin.tolist() == pytest.approx([0.04, 0.08, 0.2, 0.2])


def test_trust_falls_with_ambiguity_and_keeps_its_mean():
    weights = amb.trust(torch.tensor([0.0, 1.0, 3.0]))
    assert weights.mean().item() == pytest.approx(1)
    assert (weights / weights[0]).tolist() == pytest.approx([1, 0.5, 0.25])


def test_literal_trust_is_not_renormalised():
    assert amb.trust_literal(torch.tensor([0.0, 1.0, 3.0])).tolist() == [1, 0.5, 0.25]


def test_the_loss_can_be_lowered_by_raising_literal_doubt_only():
    rendered = torch.tensor([[0.6, 0.2, 0.2]], requires_grad=True)
    others, visibility = torch.tensor([[[0.2, 0.2, 0.2], [0.4, 0.2, 0.2]]]), torch.tensor([[1.0, 0.96]])
    doubt = amb.ambiguity(visibility, amb.mahalanobis(rendered[:, None], others, 4 * torch.eye(3)))
    assert doubt.item() == pytest.approx((0.8 + 0.96 * 0.4) / 2)
    amb.trust_literal(doubt).sum().backward()
    # d lambda / d red = (1 + 0.96) / 2 * sqrt(4), and d weight / d lambda = -1 / (1 + lambda)^2.
    assert rendered.grad[0].tolist() == pytest.approx([-1.96 / 1.592**2, 0, 0], abs=1e-6)
    assert not amb.trust(doubt).requires_grad


def test_mahalanobis_has_a_finite_gradient_where_colours_agree():
    rendered = torch.full((1, 3), 0.3, requires_grad=True)
    distance = amb.mahalanobis(rendered, torch.full((1, 3), 0.3), 50 * torch.eye(3))
    distance.sum().backward()
    assert distance.item() < 2e-6
    assert rendered.grad[0].tolist() == [0, 0, 0]


def test_mahalanobis_is_euclidean_for_unit_covariance_and_scales_with_it():
    colors, others = torch.tensor([[0.3, 0.4, 0.0]]), torch.zeros(1, 3)
    assert amb.mahalanobis(colors, others, torch.eye(3)).item() == pytest.approx(0.5)
    assert amb.mahalanobis(colors, others, 4 * torch.eye(3)).item() == pytest.approx(1.0)


def test_precision_is_the_inverse_covariance_of_the_photos():
    cameras = ring_of_cameras()
    photos = Photos(cameras, [render(cameras, i)[0] for i in range(8)], None, "cpu")
    precision = amb.color_precision(photos, torch.Generator().manual_seed(0))
    covariance = torch.cov((photos.pixels.float() / 255).T)
    torch.testing.assert_close(precision @ covariance, torch.eye(3), atol=0.05, rtol=0.05)


def test_the_paper_s_precision_is_the_plain_inverse_and_fails_on_grey_photos():
    cameras = ring_of_cameras()
    images = [render(cameras, i)[0] for i in range(8)]
    draw = torch.Generator().manual_seed
    photos = Photos(cameras, images, None, "cpu")
    literal = amb.color_precision(photos, draw(0), floor=0.0)
    expected = np.linalg.inv(np.cov(photos.pixels.numpy().T / 255.0))
    assert np.abs(literal.numpy() - expected).max() < 0.05 * np.abs(expected).max()
    assert not torch.equal(literal, amb.color_precision(photos, draw(0)))

    half = torch.arange(8) < 4  # photos that are held out have no say
    painted = [image if known else np.zeros_like(image) for image, known in zip(images, half, strict=True)]
    known, all_known = (amb.color_precision(Photos(cameras, painted, None, "cpu", t), draw(0)) for t in (half, None))
    assert (known - all_known).abs().max() > 1

    grey = Photos(cameras, [image[..., :1].repeat(3, 2) for image in images], None, "cpu")
    with pytest.raises(ValueError, match="no inverse"):
        amb.color_precision(grey, draw(0), floor=0.0)
    assert amb.color_precision(grey, draw(0)).isfinite().all()
    with pytest.raises(ReconstructionError, match=r"train\.terms\.ambiguity\.form") as error:
        _ = ambiguity_term("paper", grey).color_precision
    assert "train.terms.ambiguity.form=stable" in error.value.hint
    assert torch.equal(ambiguity_term("stable", grey).color_precision, amb.color_precision(grey, draw(0)))


def test_ambiguity_counts_visible_views_only():
    visibility = torch.tensor([[0.95, 0.5, 1.0], [0.1, 0.2, 0.3]])
    distance = torch.tensor([[2.0, 100, 4], [5, 5, 5]])
    assert amb.ambiguity(visibility, distance).tolist() == pytest.approx([(1.9 + 4) / 2, 0])


def test_without_another_view_nothing_is_doubted():
    nothing = amb.ambiguity(torch.zeros(2, 3), torch.ones(2, 3)), amb.ambiguity(torch.ones(2, 0), torch.ones(2, 0))
    for doubt in nothing:
        assert doubt.tolist() == [0, 0]
        assert amb.trust(doubt).tolist() == amb.trust_literal(doubt).tolist() == [1, 1]
