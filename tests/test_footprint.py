"""The texture's size from the photos' pixels on the surface."""

from __future__ import annotations

import numpy as np
import pytest

from stages.drawing.rendering import look_at
from stages.texture.footprint import LARGEST, SMALLEST, pixels_per_area, texels_needed, texture_size_for


def test_a_square_seen_from_the_front_has_the_density_of_its_pixels():
    vertices = np.array([[-0.5, 0, -0.5], [0.5, 0, -0.5], [0.5, 0, 0.5], [-0.5, 0, 0.5]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 2, 1]])  # the last faces away
    camera = look_at(np.array([0, -2.0, 0]), np.zeros(3), np.array([0, 0, 1.0]), 100, 100)
    density, areas = pixels_per_area(vertices, faces, camera)
    np.testing.assert_allclose(areas, 0.5)
    # at the middle of each half: depth is 2, and the angle a little off the front
    np.testing.assert_allclose(density[:2], (camera.intrinsics[0, 0, 0] / 2) ** 2, rtol=0.05)
    assert density[2] == 0


def test_a_texel_for_a_pixel_follows_the_middle_of_the_surface():
    areas, density = np.ones(10), np.full(10, 200.0)
    assert texels_needed(density, areas) == pytest.approx(2000)
    closer = density.copy()
    closer[:4] *= 100
    assert texels_needed(closer, areas) == pytest.approx(2000)
    hidden = density.copy()
    hidden[:8] = 0
    assert texels_needed(hidden, areas) == pytest.approx(2000)
    assert texels_needed(np.zeros(10), areas) == 0


def test_the_size_has_room_for_the_texels():
    texels = 0.5 * 2000**2  # as many as half of 2000 squared
    assert texture_size_for(texels, 0.5) == 2048
    assert texture_size_for(4 * texels, 0.5) == 4096
    assert texture_size_for(1.3**2 * texels, 0.5) == 4096  # 2600: 2048 would lose too much


def test_charts_that_fill_more_of_it_need_a_smaller_texture_for_the_same_texels_on_the_surface():
    assert [texture_size_for(1400**2, fill) for fill in (0.3, 0.7)] == [4096, 2048]


@pytest.mark.parametrize(("texels", "size"), [(0.0, SMALLEST), (1e-6, SMALLEST), (1e12, LARGEST)])
def test_the_size_has_bounds(texels, size):
    assert texture_size_for(texels, 0.5) == size
