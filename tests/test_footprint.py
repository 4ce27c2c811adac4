"""The texture's size from the photos' pixels on the surface."""

from __future__ import annotations

import numpy as np
import pytest

from stages.drawing.rendering import look_at
from stages.texture.footprint import CHARTS_FILL, LARGEST, SMALLEST, pixels_per_area, texture_size_for


def test_a_square_seen_from_the_front_has_the_density_of_its_pixels():
    vertices = np.array([[-0.5, 0, -0.5], [0.5, 0, -0.5], [0.5, 0, 0.5], [-0.5, 0, 0.5]])
    faces = np.array([[0, 1, 2], [0, 2, 3], [0, 2, 1]])  # the last faces away
    camera = look_at(np.array([0, -2.0, 0]), np.zeros(3), np.array([0, 0, 1.0]), 100, 100)
    density, areas = pixels_per_area(vertices, faces, camera)
    np.testing.assert_allclose(areas, 0.5)
    # at the middle of each half: depth is 2, and the angle a little off the front
    np.testing.assert_allclose(density[:2], (camera.intrinsics[0, 0, 0] / 2) ** 2, rtol=0.05)
    assert density[2] == 0


def test_the_size_gives_a_texel_to_a_pixel_and_follows_the_middle_of_the_surface():
    areas = np.ones(10)
    density = np.full(10, 2000**2 * CHARTS_FILL / 10)  # as many pixels as 2000 squared holds
    assert texture_size_for(density, areas) == 2048
    assert texture_size_for(4 * density, areas) == 4096
    assert texture_size_for(density * 1.3**2, areas) == 4096  # 2600: 2048 would lose too much
    closer = density.copy()
    closer[:4] *= 100
    assert texture_size_for(closer, areas) == 2048
    hidden = density.copy()
    hidden[:8] = 0
    assert texture_size_for(hidden, areas) == 2048


@pytest.mark.parametrize(("density", "size"), [(0.0, SMALLEST), (1e-6, SMALLEST), (1e12, LARGEST)])
def test_the_size_has_bounds(density, size):
    assert texture_size_for(np.full(4, density), np.ones(4)) == size
