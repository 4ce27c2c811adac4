"""Tiles of one surface: they meet without a seam, and what moves vertices leaves their borders alone."""

from __future__ import annotations

import numpy as np
import pytest

from stages.geometry.tiling import BlockBox, lattice_cell
from stages.surface.isosurface import extract_box
from stages.surface.tiles import BlockField, TileValues, blended, extract_tile, fading, heights_above
from stages.surface.triangle_mesh import edge_use

CELL = lattice_cell(0.1)
MARGIN = np.array([12, 12, 12]) * CELL


def box(x: int, y: int, wide: int = 48, deep: int = 48) -> BlockBox:
    """Of so many cells from the lattice point (x, y) on."""
    low = np.array([x, y, -20]) * CELL
    return BlockBox(np.stack([low, low + np.array([wide, deep, 45]) * CELL]), MARGIN)


def hills(phase: float):
    """A landscape that another phase makes a bit higher, as another block would learn it."""
    return lambda p: p[:, 2] - np.sin(p[:, 0] * 1.1 + 0.3) * np.cos(p[:, 1] * 0.9) - 0.05 * np.sin(phase + p[:, 1])


# Two above one another beside one that is as long as both: the border of this has a corner of theirs in it.
BOXES = {"b00": box(0, 0, deep=96), "b01": box(48, 0), "b02": box(48, 48)}


def tile(name: str, fields: dict[str, BlockField], block: int = 32):
    own = BOXES[name]
    beside = [fields[other] for other in sorted(fields) if own.touches(fields[other].box)]
    return extract_tile(beside, own.core, CELL, block)


def border(mesh, side: tuple[int, float]) -> np.ndarray:
    """Vertices of the mesh's open edges on the plane with this axis and coordinate, sorted."""
    use = edge_use(mesh.faces)
    lone = use.counts[use.edge] == 1
    corners = mesh.faces[use.face[lone]]
    ends = [corners[np.arange(len(corners)), (use.slot[lone] + k) % 3] for k in (0, 1)]
    axis, at = side
    found = mesh.vertices[np.unique(ends)]
    found = found[found[:, axis] == at]
    return found[np.lexsort(found.T)]


def fields_of(kinds) -> dict[str, BlockField]:
    return {name: BlockField(BOXES[name], kind) for name, kind in zip(BOXES, kinds, strict=True)}


@pytest.mark.parametrize(("first", "second"), [("b00", "b01"), ("b00", "b02"), ("b01", "b02")])
def test_tiles_share_the_vertices_of_their_border_bit_for_bit(first, second):
    fields = fields_of([hills(0.0), hills(2.0), hills(4.0)])
    one, other = tile(first, fields), tile(second, fields, block=16)
    side = (0, 48 * CELL) if first == "b00" else (1, 48 * CELL)
    found, again = border(one, side), border(other, side)
    shared = BOXES[first].core[:, :2], BOXES[second].core[:, :2]
    low, high = np.max([each[0] for each in shared], 0), np.min([each[1] for each in shared], 0)
    found = found[((found[:, :2] >= low) & (found[:, :2] <= high)).all(1)]
    again = again[((again[:, :2] >= low) & (again[:, :2] <= high)).all(1)]
    assert len(found) > 40
    assert found.tobytes() == again.tobytes()


def test_a_network_gives_tiles_the_same_border_whatever_else_they_ask_for():
    """Of a trained network, whose last bits depend on what it is asked for at once."""
    import torch

    from stages.neural.encoding_shapes import HashGrid
    from stages.neural.fields import Fields, FieldShape
    from stages.neural.trained_field import TrainedField

    def learned(name: str, seed: int):
        grid = HashGrid(levels=4, log2_rows=10, coarsest=8, finest=64)
        shape = FieldShape(grid, 1, 32, 1, 16, False, 8, 0.5, None, 1)
        fields = Fields(shape, seed)
        torch.nn.init.normal_(fields.sdf.table, std=0.1, generator=torch.Generator().manual_seed(seed))
        field, where = TrainedField(fields, "cpu"), BOXES[name]
        middle = where.core.mean(0)
        radius = float(np.linalg.norm(where.region[1] - middle)) * 1.05
        return BlockField(where, lambda p: radius * field.sdf((p - middle) / radius))

    fields = [learned(name, seed) for seed, name in enumerate(BOXES)]
    rng = np.random.default_rng(0)
    shared = np.column_stack([rng.integers(48, 97, 400), np.full(400, 48), rng.integers(-20, 26, 400)])
    low, high = (np.round(corner / CELL).astype(int) for corner in BOXES["b01"].core)
    at_once = TileValues(blended(fields, 1.0), low, high, CELL)(shared)
    low, high = (np.round(corner / CELL).astype(int) for corner in BOXES["b02"].core)
    another = TileValues(blended(fields, 1.0), low, high, CELL)
    one_by_one = np.concatenate([another(point[None]) for point in shared])
    assert at_once.tobytes() == one_by_one.tobytes()
    inside = shared + np.array([0, 5, 0])
    apart = np.concatenate([another(point[None]) for point in inside])
    np.testing.assert_allclose(another(inside), apart, atol=1e-5)


def test_no_crack_where_one_tile_looks_less_closely_than_the_other():
    """A wall of one cell is missed by the coarse look of the larger tile, which skips every other point."""
    wall = lambda p: np.where((np.abs(p[:, 1] - 33 * CELL) < 0.6 * CELL) & (p[:, 0] > 31 * CELL), -5.0, 5.0)  # noqa: E731
    fields = fields_of([wall] * 3)
    one, other = tile("b00", fields), tile("b01", fields)
    found, again = border(one, (0, 48 * CELL)), border(other, (0, 48 * CELL))
    assert len(found) > 40
    assert found.tobytes() == again.tobytes()


def test_together_tiles_are_the_surface_of_the_whole():
    """With one field for all, the tiles have the vertices of one extraction of everything, each once or at a border."""
    fields = fields_of([hills(0.0)] * 3)
    low, high = np.array([0, 0, -20]), np.array([96, 96, 25])
    whole = extract_box(lambda i: hills(0.0)(i * CELL), low, high, CELL)
    parts = [tile(name, fields) for name in BOXES]
    apart = np.unique(np.round(np.concatenate([part.vertices for part in parts]) / CELL, 5), axis=0)
    np.testing.assert_allclose(apart, np.unique(np.round(whole.vertices / CELL, 5), axis=0), atol=1e-4)
    assert sum(len(part.faces) for part in parts) == len(whole.faces)


def test_the_blend_is_between_its_fields_and_pure_where_only_one_is_known():
    fields = [
        BlockField(BOXES["b01"], lambda p: np.full(len(p), 1.0)),
        BlockField(BOXES["b02"], lambda p: -2.0 + 0 * p[:, 0]),
    ]
    y = np.linspace(0, 96, 97)
    values = blended(fields, 9.0)(np.column_stack([np.full(97, 70.0), y, np.zeros(97)]) * CELL)
    assert values[20] == 1.0
    assert values[80] == -2.0
    assert (np.diff(values[36:61]) <= 0).all()
    assert values[48] == pytest.approx(-0.5)
    assert blended(fields, 9.0)(np.array([[0.0, 0.0, 0.0]])).tolist() == [9.0]


def test_movements_fade_out_at_the_sides():
    sides = [(np.array([1.0, 0, 0]), 2.0), (np.array([-1.0, 0, 0]), -10.0)]
    vertices = np.array([[2.0, 5, 5], [2.3, 5, 5], [6.0, 0, 0], [10.0, 1, 1]])
    assert heights_above(vertices, sides).tolist() == pytest.approx([0.0, 0.3, 4.0, 0.0])
    faded = fading(vertices, sides, 0.1)
    assert faded[[0, 3]].tolist() == [0.0, 0.0]
    assert faded[2] == 1.0
    assert faded[1] == pytest.approx(0.5)
    assert fading(vertices, [], 0.1).tolist() == [1.0] * 4
