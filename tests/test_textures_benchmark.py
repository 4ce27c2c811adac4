"""The texture benchmark's measures, on made-up meshes and results."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.textures import BOUND, NAIVE, OURS, VERTEX, Look, Score, SetResult, matched, seam, tables_of
from stages.artifacts import AtlasMesh
from stages.drawing.rendering import look_at
from stages.drawing.view_scores import draw_view
from stages.texture.filling import face_neighbors


@pytest.fixture
def strip() -> AtlasMesh:
    """A strip of eight squares on the ground, the first four in the left chart, the others in the right one."""
    vertices, uvs, faces = [], [], []
    for chart in (0, 1):
        for x in range(5):
            for y in (0, 1):
                vertices.append([x + 4 * chart, y, 0])
                uvs.append([0.05 + 0.5 * chart + 0.1 * x, 0.3 + 0.1 * y])
        for x in range(4):
            a = 10 * chart + 2 * x
            faces += [[a, a + 2, a + 3], [a, a + 3, a + 1]]
    normals = np.tile(np.float32([0, 0, 1]), (len(vertices), 1))
    return AtlasMesh(np.float32(vertices), normals, np.float32(uvs), np.int32(faces), 80)


def test_a_seam_is_seen_where_charts_disagree_and_not_where_colours_run_on(strip):
    pairs = face_neighbors(strip.vertices, strip.faces)
    shared = (strip.faces[pairs[:, 0], :, None] == strip.faces[pairs[:, 1], None]).sum((1, 2))
    border = shared < 2
    assert border.sum() == 1
    # 8 texels are one unit; the colour rises by 20 a unit along the strip, on through the second chart
    x = (np.arange(80) + 0.5) / 8 - 0.5
    along = np.where(x < 4.25, x, x - 1)
    smooth = np.repeat((20 + 20 * along)[None, :, None], 80, 0).repeat(3, 2).astype(np.uint8)
    parts = np.where(x < 4.25, 0, 60)[None, :, None].astype(np.uint8)
    step = 0.1
    level = seam(strip, smooth, pairs, border, step)
    broken = seam(strip, smooth + parts, pairs, border, step)
    assert level < 2
    assert broken > 5 * level
    assert seam(strip, smooth, pairs, np.zeros(len(pairs), bool), step) == 1


def test_many_drawings_are_those_of_the_renderer(strip):
    texture = np.random.default_rng(0).integers(0, 255, (80, 80, 3)).astype(np.uint8)
    camera = look_at(np.array([4.0, 0.4, 9]), np.array([4.0, 0.5, 0]), np.array([0.0, 1, 0]), 48, 40, 60)
    look = Look.of(strip, camera, 0)
    drawn = look.draw(texture)
    assert (drawn == draw_view(strip, texture, camera, 0)).all()
    assert 50 < look.covered.sum() < 48 * 40
    assert (drawn[look.covered] < 255).any(1).all()


def test_exposure_is_fitted_for_each_channel():
    image = np.random.default_rng(0).integers(40, 120, (8, 8, 3)).astype(np.uint8)
    photo = np.round(image * np.array([1.5, 1.0, 0.5])).astype(np.uint8)
    counted = np.ones((8, 8), bool)
    assert np.abs(matched(image, photo, counted).astype(int) - photo).max() <= 1


def test_tables_hold_a_row_a_texture_and_its_lead():
    scores = [Score(name, psnr, psnr, 0.9, psnr, 1.2, 1.1) for name, psnr in
              ((OURS, 27.0), (VERTEX, 24.5), (NAIVE, 25.0), (BOUND, 29.0))]  # fmt: skip
    result = SetResult("viking", 1024, 6, "silhouette", 1.0, tuple(scores), {"4096": (60.0, 90.0, 3 << 30)}, {})
    made = tables_of([result])
    assert "| viking | ours | 27.00 | +2.50 | +2.00 | 27.00 | 0.900 | 27.00 | 1.20 | 1.10 |" in made["textures"]
    assert "| viking | 4096 | 60 | 90 | 3.00 |" in made["texture cost"]
    assert set(tables_of([]).values()) == {"Not measured yet."}
