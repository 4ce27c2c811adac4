"""Spheres under lights that are known: what must be seen, and where."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from stages.artifacts import AtlasMesh
from stages.drawing.relighting import Material, behind, relit
from stages.drawing.rendering import look_at
from stages.drawing.tone_mapping import neutral, on_screen, picture
from stages.geometry.cameras import PinholeCameras
from stages.light.built_in import LIGHTS
from stages.light.environment import directions, turned
from stages.light.levels import Levels, levels_of
from stages.texture.tangents import vertex_tangents

SIDE = 64
UP = np.array([0.0, 1, 0])
WHITE, GOLD = (255, 255, 255), (255, 196, 88)


def sphere() -> AtlasMesh:
    ball = trimesh.creation.icosphere(4)
    points = ball.vertices.astype(np.float32)
    uvs = np.stack([0.5 + 0.3 * points[:, 0], 0.5 + 0.3 * points[:, 1]], axis=1)
    return AtlasMesh(points, points.copy(), uvs, ball.faces.astype(np.int32), 64)


def camera(azimuth_deg: float = 0.0) -> PinholeCameras:
    """From far away; 0: from +Z, towards +X where positive."""
    angle = np.radians(azimuth_deg)
    return look_at(20 * np.array([np.sin(angle), 0, np.cos(angle)]), np.zeros(3), UP, SIDE, SIDE, fov_deg=6.4)


def material(
    color: tuple[int, ...] = WHITE, roughness: float = 1, metallic: float = 0, occlusion: float = 1
) -> Material:
    orm = np.rint(255 * np.array([[[occlusion, roughness, metallic]]])).astype(np.uint8)
    return Material(np.array([[color]], np.uint8), orm)


def uniform(color: tuple[float, ...] = (1, 1, 1)) -> Levels:
    return levels_of(np.full((8, 16, 3), color, np.float32))


def lamp(towards: tuple[float, ...], radius_deg: float = 4) -> np.ndarray:
    light = np.zeros((64, 128, 3), np.float32)
    light[directions(64) @ (np.asarray(towards) / np.linalg.norm(towards)) > np.cos(np.radians(radius_deg))] = 100
    return light


def on_picture(normal: np.ndarray) -> np.ndarray:
    """The pixel (column, row) of the sphere's point with a normal, seen from +Z."""
    xy, _ = camera().project(0, normal[None])
    return xy[0]


# ---------------------------------------------------------------- furnace
@pytest.mark.parametrize("roughness", [0, 0.15, 0.5, 1])
def test_a_white_sphere_in_a_uniform_light_shows_the_light(roughness: float) -> None:
    radiance, coverage = relit(sphere(), material(WHITE, roughness), uniform((0.5, 1, 2)), camera())
    inside = coverage == 1
    assert inside.mean() > 0.4
    np.testing.assert_allclose(radiance[inside], np.tile((0.5, 1, 2), (inside.sum(), 1)), rtol=2e-3)
    assert (radiance[coverage == 0] == 0).all()


def test_a_grey_matte_sphere_shows_its_share_and_its_occlusion() -> None:
    grey = (188, 188, 188)  # half of the light
    whole, _ = relit(sphere(), material(grey), uniform(), camera())
    hidden, _ = relit(sphere(), material(grey, occlusion=0.5), uniform(), camera())
    middle = whole[SIDE // 2, SIDE // 2, 0]
    assert 0.5 < middle < 0.54  # what is no metal reflects four hundredths on top
    assert hidden[SIDE // 2, SIDE // 2, 0] == pytest.approx(middle / 2, rel=0.05)


@pytest.mark.slow
def test_metals_tint_what_they_mirror_and_others_do_not() -> None:
    light = levels_of(lamp((0, 0, 1), 20))
    for metallic, expected in ((1, (1, 0.552, 0.098)), (0, (1, 1, 1))):
        shiny, _ = relit(sphere(), material(GOLD, 0, metallic), light, camera())
        dark, _ = relit(sphere(), material((0, 0, 0), 0, metallic), light, camera())
        mirrored = (shiny if metallic else dark)[SIDE // 2, SIDE // 2]
        np.testing.assert_allclose(mirrored / mirrored[0], expected, atol=0.02)


# ---------------------------------------------------------------- where it is seen
@pytest.mark.parametrize("towards", [(0, 0, 1), (1, 0, 1), (-1, 0.5, 1), (0.3, 1, 0.2), (1, -0.7, 0.1)])
def test_a_mirror_shows_the_light_where_it_comes_from(towards: tuple[float, ...]) -> None:
    mirror = material(WHITE, 0, 1)
    radiance, _ = relit(sphere(), mirror, levels_of(lamp(towards)), camera())
    halfway = np.asarray(towards) / np.linalg.norm(towards) + np.array([0, 0, 1])
    lit = np.argwhere(radiance[..., 0] > 0.5 * radiance.max())[:, ::-1] + 0.5
    assert np.linalg.norm(lit.mean(0) - on_picture(halfway / np.linalg.norm(halfway))) < 1.0


def test_a_matte_sphere_is_brightest_towards_the_light() -> None:
    towards = np.array([-1, 1, 1]) / np.sqrt(3)
    radiance, _ = relit(sphere(), material(), levels_of(lamp((-1, 1, 1), 8)), camera())
    brightest = np.argwhere(radiance[..., 0] > 0.99 * radiance.max())[:, ::-1] + 0.5
    assert np.linalg.norm(brightest.mean(0) - on_picture(towards)) < 2.5


def test_the_background_shows_the_light_behind() -> None:
    ahead = levels_of(lamp((0, 0, -1)))
    seen = behind(ahead, camera())
    assert seen[SIDE // 2, SIDE // 2, 0] > 10
    assert behind(levels_of(lamp((0, 0, 1))), camera()).max() < 1
    sideways = behind(ahead, camera(), turn_deg=90)
    assert sideways.max() < 1


@pytest.mark.slow
@pytest.mark.parametrize("of", [material(WHITE, 0, 1), material(WHITE, 0.4, 1), material()])
def test_a_light_turned_by_90_degrees_turns_the_picture(of: Material) -> None:
    """Seen from a quarter further on, it is the same; and it is what the turned map gives."""
    light = LIGHTS["studio"](64)
    straight, _ = relit(sphere(), of, levels_of(light), camera())
    by_angle, _ = relit(sphere(), of, levels_of(light), camera(), turn_deg=90)
    assert np.abs(by_angle - straight).mean() > 0.02
    by_map, _ = relit(sphere(), of, levels_of(turned(light, 90)), camera())
    assert np.abs(by_map - by_angle).mean() < 0.01 * straight.mean()
    # from φ to φ + 90 degrees is from +Z to -X
    followed, _ = relit(sphere(), of, levels_of(light), camera(-90), turn_deg=90)
    assert np.abs(followed - straight).mean() < 0.02 * straight.mean()


def test_relief_leans_the_normals_along_u_and_v() -> None:
    mesh = sphere()
    tangents = vertex_tangents(mesh)
    lamps = levels_of(lamp((1, 0, 0.3), 20) + lamp((0, 1, 0.3), 20) * np.array([0, 1, 0], np.float32))
    middle = (SIDE // 2, SIDE // 2)
    flat, _ = relit(
        mesh, replace(material(), normal=np.array([[(128, 128, 255)]], np.uint8)), lamps, camera(), tangents
    )
    plain, _ = relit(mesh, material(), lamps, camera())
    np.testing.assert_allclose(flat[middle], plain[middle], rtol=0.03)
    to_u, _ = relit(
        mesh, replace(material(), normal=np.array([[(218, 128, 218)]], np.uint8)), lamps, camera(), tangents
    )
    to_v, _ = relit(
        mesh, replace(material(), normal=np.array([[(128, 218, 218)]], np.uint8)), lamps, camera(), tangents
    )
    assert to_u[middle][0] > 1.5 * plain[middle][0]
    assert to_v[middle][1] > 1.2 * to_v[middle][0]
    assert to_v[middle][1] > 1.2 * plain[middle][1]
    with pytest.raises(ValueError, match="a normal map and tangents"):
        relit(mesh, material(), lamps, camera(), tangents)


def test_textures_are_read_where_the_uvs_say() -> None:
    halves = np.zeros((64, 64, 3), np.uint8)
    halves[:, 32:] = 255  # white where u is large, on the right
    radiance, _ = relit(sphere(), replace(material(), base_color=halves), uniform(), camera())
    assert radiance[SIDE // 2, SIDE // 2 + 8, 0] > 0.9
    assert radiance[SIDE // 2, SIDE // 2 - 8, 0] < 0.1


# ---------------------------------------------------------------- onto the screen
def test_the_tone_mapping_keeps_base_colours_and_ends_at_white() -> None:
    """A matte thing under a light of 1 shows its colour and 0.04 on top; that is what the curve takes away."""
    color = np.array([0.6, 0.3, 0.2])
    np.testing.assert_allclose(neutral(color + 0.04), color, atol=1e-6)
    bright = neutral(np.array([[0.8, 0.2, 0.1]]) * np.array([[1.0], [4], [1e6]]))
    assert (np.diff(bright.max(1)) > 0).all()
    assert bright.max() <= 1
    np.testing.assert_allclose(bright[-1], 1, atol=1e-3)
    # the reference code of github.com/KhronosGroup/ToneMapping, by hand for (2, 1, 0.5)
    np.testing.assert_allclose(neutral(np.array([2.0, 1, 0.5])), (0.96, 0.534091, 0.321136), atol=1e-5)
    np.testing.assert_allclose(on_screen(np.full(3, 0.25), 1), on_screen(np.full(3, 0.5)))


def test_pictures_over_white_over_light_and_over_nothing() -> None:
    radiance, coverage = np.zeros((1, 3, 3), np.float32), np.array([[0, 0.5, 1]], np.float32)
    radiance[0, 1:] = [[0.1] * 3, [0.2] * 3]
    own = picture(np.full((1, 1, 3), 0.2), np.ones((1, 1)), None)[0, 0, 0]
    over_white = picture(radiance, coverage, 1.0)[0, :, 0]
    assert over_white[0] == 255
    assert over_white[2] == own
    assert over_white[1] == pytest.approx((255 + int(own)) / 2, abs=1)
    clear = picture(radiance, coverage, None)[0]
    np.testing.assert_array_equal(clear[:, 3], [0, 128, 255])
    np.testing.assert_array_equal(clear[1:, 0], [own, own])
    over_light = picture(radiance, coverage, np.full((1, 3, 3), 0.2, np.float32))[0, :, 0]
    np.testing.assert_array_equal(over_light, [own] * 3)
