import pytest
import torch

from stages.neural.radiance import REACHES, Radiance, encoded_srgb, openness
from stages.neural.sampling import SdfCache, beyond_too


def directions(count: int, seed: int = 0) -> torch.Tensor:
    drawn = torch.randn(count, 3, generator=torch.Generator().manual_seed(seed))
    return torch.nn.functional.normalize(drawn, dim=1)


def made(shaded: bool = True) -> Radiance:
    return Radiance(4, 1, 8, True, shaded, torch.Generator().manual_seed(0))


def plane(points: torch.Tensor) -> torch.Tensor:
    return points[:, 2]


def sees(radiance: Radiance, normals: torch.Tensor, views: torch.Tensor, features: torch.Tensor):
    return radiance(torch.zeros(len(normals), 3), normals, views, features, plane)


# ---------------------------------------------------------------- openness
def test_a_plane_and_a_ball_are_open_and_a_corner_is_not():
    reaches = torch.tensor(REACHES)
    up = torch.tensor([[0.0, 0, 1]])
    assert openness(plane, torch.zeros(1, 3), up, reaches).tolist() == [[1] * 5]
    ball = openness(lambda p: p.norm(dim=1) - 0.3, 0.3 * up, up, reaches)
    torch.testing.assert_close(ball, torch.ones(1, 5))
    # the corner of two walls, 0.05 from the other one: along the normal of the first that stays as near
    corner = openness(lambda p: torch.minimum(p[:, 0], p[:, 2]), torch.tensor([[0.05, 0, 0]]), up, reaches)
    assert corner[0].tolist() == pytest.approx([min(1, 0.05 / reach) for reach in REACHES])


def test_openness_is_not_negative_and_carries_no_gradient():
    points = torch.zeros(1, 3, requires_grad=True)
    found = openness(lambda p: -p[:, 2], points, torch.tensor([[0.0, 0, 1]]), torch.tensor(REACHES))
    assert found.tolist() == [[0] * 5]
    assert not found.requires_grad


# ---------------------------------------------------------------- colours
def test_without_shading_the_colour_is_the_networks():
    radiance, normals, views = made(shaded=False), directions(6), directions(6, 1)
    features = torch.rand(6, 4)
    colors, gloss = sees(radiance, normals, views, features)
    torch.testing.assert_close(colors, radiance.network(torch.zeros(6, 3), normals, views, features))
    assert gloss.tolist() == [1] * 6


def test_a_matte_surface_looks_alike_from_all_sides_and_a_glossy_one_does_not():
    radiance, normals = made(), directions(1).expand(8, 3)
    features = torch.rand(1, 4).expand(8, 4)
    assert sees(radiance, normals, directions(8, 1), features).colors.std(0).max() > 1e-3
    with torch.no_grad():
        radiance.shading.surface[-1].bias[3] = -30
    colors, gloss = sees(radiance, normals, directions(8, 1), features)
    assert gloss.max() < 1e-6
    assert colors.std(0).max() < 1e-6


def test_only_normal_and_surroundings_shade_a_matte_surface_of_one_albedo():
    radiance, views = made(), directions(2)
    features = torch.rand(1, 4).expand(2, 4)
    up = torch.tensor([[0.0, 0, 1]]).expand(2, 3)
    with torch.no_grad():
        radiance.shading.surface[-1].bias[3] = -30
    turned = sees(radiance, torch.stack([up[0], directions(1)[0]]), views, features).colors
    assert (turned[0] - turned[1]).abs().max() > 1e-3
    points = torch.zeros(2, 3)
    free = radiance(points, up, views, features, plane).colors
    closed = radiance(points, up, views, features, lambda p: 0.1 * p[:, 2]).colors
    assert (free - closed).abs().max() > 1e-3


def test_a_matte_colour_is_albedo_times_irradiance():
    radiance, normals, points = made(), directions(5), torch.rand(5, 3)
    features = torch.rand(5, 4)
    with torch.no_grad():
        radiance.shading.surface[-1].bias[3] = -30
    albedo, _ = radiance.shading.albedo_and_gloss(features)
    light = radiance.shading.irradiance(points, normals, torch.ones(5, len(REACHES)))
    colors = radiance(points, normals, normals, features, lambda p: torch.full((len(p),), 9.0)).colors
    torch.testing.assert_close(colors, encoded_srgb(albedo * light))


def test_srgb_is_black_where_there_is_no_light_and_the_curve_of_the_standard():
    linear = torch.tensor([0.0, 0.001, 0.0031308, 0.2140411, 1.0], requires_grad=True)
    encoded = encoded_srgb(linear)
    assert encoded.tolist() == pytest.approx([0, 0.01292, 0.04045, 0.5, 1], abs=1e-5)
    encoded.sum().backward()
    assert linear.grad.isfinite().all()
    assert linear.grad.min() > 0


def test_a_ball_that_fills_the_region_is_open():
    cache = SdfCache(64, "cpu")
    cache.refresh(lambda p: p.norm(dim=1) - 0.85)
    normals = directions(20)
    found = openness(lambda p: beyond_too(cache.lookup, p), 0.85 * normals, normals, torch.tensor(REACHES))
    assert found[:, 1:].min() > 0.97


def test_colours_give_finite_gradients_in_the_dark():
    radiance, features = made(), torch.rand(3, 4, requires_grad=True)
    with torch.no_grad():
        radiance.shading.surface[-1].bias[:] = -200
    sees(radiance, directions(3), directions(3, 1), features).colors.sum().backward()
    assert features.grad.isfinite().all()


def test_what_is_known_to_be_shiny_is_painted_by_the_network_alone():
    radiance, normals, views, features = made(), directions(6), directions(6, 1), torch.rand(6, 4)
    with torch.no_grad():
        radiance.shading.surface[-1].bias[3] = -30
    radiance.shiny.fill_(1)
    colors, gloss = sees(radiance, normals, views, features)
    torch.testing.assert_close(colors, radiance.network(torch.zeros(6, 3), normals, views, features))
    assert gloss.tolist() == [1] * 6
