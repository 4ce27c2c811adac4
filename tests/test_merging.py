"""Several textured meshes to one: its shape, its colours, and what it says it misses."""

from __future__ import annotations

import numpy as np
import pytest

from stages.artifacts import AtlasMesh
from stages.drawing.rasterizing import rasterize_atlas, surface_points
from stages.surface.triangle_mesh import edge_use, unique_positions
from stages.texture import merging
from stages.texture.charts import ChartsError
from stages.texture.merging import Textured, merged

SIDE = 64


@pytest.fixture(autouse=True)
def projected_charts(monkeypatch):
    """UVAtlas takes a second to start."""

    def refuse(*_):
        raise ChartsError("not here")

    monkeypatch.setattr(merging, "unwrap_uvatlas", refuse)


def ground(west: float, bump: float = 0.0, cells: int = 12) -> Textured:
    """A square of side 1 with its west border at x = `west`, up to `bump` high in its middle, in colours by place."""
    x, y = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(0, 1, cells + 1)]))
    z = bump * np.sin(np.pi * x) * np.sin(np.pi * y)
    i = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + cells + 2], 1), np.stack([i, i + cells + 2, i + cells + 1], 1)])
    mesh = AtlasMesh(
        np.column_stack([west + x, y, z]),
        np.tile([0.0, 0, 1], (len(x), 1)).astype(np.float32),
        np.column_stack([x, y]).astype(np.float32),
        faces.astype(np.int32),
        SIDE,
    )
    u, v = np.meshgrid((np.arange(SIDE) + 0.5) / SIDE, 1 - (np.arange(SIDE) + 0.5) / SIDE)
    return Textured(mesh, color(west + u, v).astype(np.uint8))


def color(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return np.stack([60 + 70 * x, 40 + 150 * y, 200 - 50 * x], axis=-1)


def test_a_texel_is_the_root_of_area_over_texels():
    assert ground(0.0).texel_side == pytest.approx(1 / SIDE, rel=1e-5)


def test_two_that_meet_are_one_surface_in_their_colours():
    parts = [ground(0.0), ground(1.0)]
    found, missed = merged(parts, 100, 128)
    assert 4 <= len(found.mesh.faces) <= 100
    assert missed < 1e-5  # flat
    positions, index = unique_positions(found.mesh.vertices)
    use = edge_use(index[found.mesh.faces])
    lone = use.counts[use.edge] == 1
    corners = index[found.mesh.faces][use.face[lone]]
    ends = np.stack([corners[np.arange(len(corners)), (use.slot[lone] + k) % 3] for k in (0, 1)])
    at_border = np.isclose(positions % [2, 1, 1], 0, atol=1e-4) | np.isclose(positions, [2, 1, 9], atol=1e-4)
    assert (at_border[ends[0]] & at_border[ends[1]])[:, :2].any(1).all()  # no open edge where the two meet
    texels = rasterize_atlas(found.mesh.uvs, found.mesh.faces, 128)
    points, _ = surface_points(found.mesh, texels.face_ids, texels.corner)
    error = np.abs(found.texture.reshape(-1, 3)[texels.index] - color(points[:, 0], points[:, 1]))
    assert np.quantile(error, 0.99) < 4
    np.testing.assert_allclose(np.abs(found.mesh.normals[:, 2]), 1, atol=1e-5)


def test_what_a_bump_loses_is_measured():
    _, little = merged([ground(0.0, 0.2), ground(1.0)], 400, 128)
    _, much = merged([ground(0.0, 0.2), ground(1.0)], 6, 128)
    assert little < 0.03
    assert 0.03 < much <= 0.21


def test_what_has_no_area_is_refused():
    flat = ground(0.0)
    point = Textured(AtlasMesh(0 * flat.mesh.vertices, *list(vars(flat.mesh).values())[1:]), flat.texture)
    with pytest.raises(ValueError, match="area"):
        merged([point], 100, 64)
