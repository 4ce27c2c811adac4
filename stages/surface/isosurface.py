"""The zero level set of a signed distance function as a triangle mesh, block by block.

Marching cubes with one vertex per crossed grid edge and tables generated here so that the result is always an
orientable 2-manifold:
- on a face whose four corners alternate in sign, the two inside corners are always separated, by either cube that
  shares the face, so neighbours agree (Lorensen and Cline's 15 cases do not);
- no triangle edge inside a cube joins two vertices of one cube face, where the neighbour might draw the same edge.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Protocol

import numpy as np

SignedDistance = Callable[[np.ndarray], np.ndarray]

# Interpolated vertices keep this part of an edge away from its ends, or triangles at exact zeros would degenerate.
MIN_EDGE_FRACTION = 1e-3
# The whole region is sampled at this many to twice as many cells a side before anything is skipped.
COARSE_CELLS = 48
# Points handed to the signed distance function in one call.
MAX_POINTS = 1 << 19

# Corner c of a cube lies at (c & 1, c >> 1 & 1, c >> 2 & 1).
CORNERS = np.array([(c & 1, c >> 1 & 1, c >> 2 & 1) for c in range(8)])
# Edge e runs from corner EDGES[e][0] along axis e // 4.
EDGES = tuple((c, c | 1 << axis) for axis in range(3) for c in range(8) if not c >> axis & 1)
EDGE_STARTS = np.array([start for start, _ in EDGES])
# Face 2 * axis + side, its corners counter-clockwise seen from outside the cube.
_QUAD = {0: ((0, 0), (0, 1), (1, 1), (1, 0)), 1: ((0, 0), (1, 0), (1, 1), (0, 1))}


def _face_corners(axis: int, side: int) -> tuple[int, ...]:
    u, v = (axis + 1) % 3, (axis + 2) % 3
    return tuple(side << axis | a << u | b << v for a, b in _QUAD[side])


FACES = tuple(_face_corners(axis, side) for axis in range(3) for side in range(2))


@dataclass(frozen=True)
class CubeTables:
    """What marching cubes does in each of the 256 sign patterns (bit c is set where corner c is inside).

    Attributes:
        counts: [256] number of triangles.
        triangles: [256, max(counts), 3] edges whose vertices form them, outward; padded with 0.
        edges: [256, 12] bool, which edges are crossed.
        mixed_faces: [256, 6] bool, which faces of the cube the surface crosses.
    """

    counts: np.ndarray
    triangles: np.ndarray
    edges: np.ndarray
    mixed_faces: np.ndarray


def _loops(pattern: int) -> list[list[int]]:
    """The closed polygons, as crossed edges, that separate inside from outside corners; normals point outside."""
    edge_of = {frozenset(edge): e for e, edge in enumerate(EDGES)}
    following: dict[int, int] = {}
    for corners in FACES:
        inside = [bool(pattern >> c & 1) for c in corners]
        for i in range(4):
            if inside[i - 1] or not inside[i]:
                continue  # a run of inside corners begins where the walk around the face enters the inside
            end = i
            while inside[(end + 1) % 4]:
                end += 1
            enter = edge_of[frozenset((corners[i - 1], corners[i]))]
            following[enter] = edge_of[frozenset((corners[end % 4], corners[(end + 1) % 4]))]
    loops = []
    while following:
        first, edge = following.popitem()
        loop = [first]
        while edge != first:
            loop.append(edge)
            edge = following.pop(edge)
        loops.append(loop)
    return loops


def _triangulate(loop: list[int]) -> list[tuple[int, int, int]] | None:
    """Triangles of a polygon whose diagonals never join two edges of one cube face, or None."""
    faces_of = [{f for f, corners in enumerate(FACES) if set(edge) <= set(corners)} for edge in EDGES]

    def chord_allowed(i: int, j: int) -> bool:
        neighbours = (j - i) % len(loop) in (1, len(loop) - 1)
        return neighbours or not faces_of[loop[i]] & faces_of[loop[j]]

    def cut(lo: int, hi: int) -> list[tuple[int, int, int]] | None:
        if hi - lo < 2:
            return []
        for mid in range(lo + 1, hi):
            if chord_allowed(lo, mid) and chord_allowed(mid, hi):
                left, right = cut(lo, mid), cut(mid, hi)
                if left is not None and right is not None:
                    return [(loop[lo], loop[mid], loop[hi]), *left, *right]
        return None

    return cut(0, len(loop) - 1)


@lru_cache(maxsize=1)
def cube_tables() -> CubeTables:
    """The tables, built once. Raises AssertionError if a polygon had no allowed triangulation (none has not)."""
    triangles: list[list[tuple[int, int, int]]] = []
    for pattern in range(256):
        triangles.append([])
        for loop in _loops(pattern):
            pieces = _triangulate(loop)
            assert pieces is not None, f"pattern {pattern}: no triangulation of {loop}"
            triangles[-1] += pieces
    counts = np.array([len(t) for t in triangles])
    padded = np.zeros((256, counts.max(), 3), dtype=np.int64)
    for pattern, pieces in enumerate(triangles):
        if pieces:
            padded[pattern, : len(pieces)] = pieces
    inside = np.arange(256)[:, None] >> np.arange(8) & 1
    edges = np.stack([inside[:, a] != inside[:, b] for a, b in EDGES], axis=1)
    in_face = np.stack([inside[:, list(corners)].sum(1) for corners in FACES], axis=1)
    return CubeTables(counts, padded, edges, (in_face > 0) & (in_face < 4))


class Domain(Protocol):
    """Where the surface is looked for."""

    def holds(self, axes: Sequence[np.ndarray]) -> np.ndarray:
        """Which points of the lattice with these coordinates along x, y and z lie in it."""
        ...

    def meets(self, axes: Sequence[np.ndarray]) -> np.ndarray:
        """Which cells of that lattice have a part in it."""
        ...


@dataclass(frozen=True)
class Ball:
    """About the origin."""

    radius: float

    def holds(self, axes: Sequence[np.ndarray]) -> np.ndarray:
        x, y, z = (axis**2 for axis in axes)
        total = x[:, None, None] + y[None, :, None] + z[None, None, :]
        inside: np.ndarray = total <= self.radius**2 * (1 + 1e-9)
        return inside

    def meets(self, axes: Sequence[np.ndarray]) -> np.ndarray:
        return self.holds(
            [np.clip(0.0, axis[:-1], axis[1:]) for axis in axes]
        )  # the cell's point nearest to the centre


@dataclass(frozen=True)
class Box:
    """With faces on planes of the lattice: `low` and `high` [3] are its corners' coordinates."""

    low: np.ndarray
    high: np.ndarray

    def holds(self, axes: Sequence[np.ndarray]) -> np.ndarray:
        return self._all([(a >= low) & (a <= high) for a, low, high in zip(axes, self.low, self.high, strict=True)])

    def meets(self, axes: Sequence[np.ndarray]) -> np.ndarray:
        rows = zip(axes, self.low, self.high, strict=True)
        return self._all([(a[1:] > low) & (a[:-1] < high) for a, low, high in rows])

    @staticmethod
    def _all(along: Sequence[np.ndarray]) -> np.ndarray:
        x, y, z = along
        inside: np.ndarray = x[:, None, None] & y[None, :, None] & z[None, None, :]
        return inside


@dataclass(frozen=True)
class Isosurface:
    """A triangle mesh and what it cost.

    Attributes:
        vertices: [V, 3] float32; of a box float64.
        faces: [F, 3] int32, counter-clockwise seen from where the distance is positive.
        evaluated: number of points at which the signed distance was computed.
    """

    vertices: np.ndarray
    faces: np.ndarray
    evaluated: int


def extract_isosurface(
    sdf: SignedDistance,
    resolution: int,
    block: int = 64,
    radius: float = 1.0,
    lipschitz: float = 2.0,
    progress: Callable[[int, int], None] | None = None,
) -> Isosurface:
    """Mesh the zero level set of `sdf` inside a ball, on a grid of `resolution`^3 cells over [-radius, radius]^3.

    A cell is refined only where the surface can be: where the signs at its corners differ, or the smallest |sdf| at
    them is below `lipschitz` times its half-diagonal. At the finest level the surface is then followed across every
    crossed cell face, so the mesh has no cracks even where the field is steeper than that. Each grid point is
    evaluated once on block borders, so blocks agree to the last bit. Memory is O(block^3 + surface).

    Cells with a corner outside the ball emit nothing: a surface that leaves the ball ends in an open border.

    Args:
        sdf: [N, 3] float32 points -> [N] values, negative inside.
        resolution: cells along a side, >= 2.
        block: cells along a side of a block; rounded up to a multiple of the coarse cells.
        radius: of the ball and half the grid's side.
        lipschitz: bound on the gradient used for skipping; larger is safer and slower.
        progress: told (blocks done, blocks known of).

    Returns:
        The mesh; without faces where no cell is crossed.

    Raises:
        ValueError: settings out of bounds, or `sdf` returned another shape or non-finite values.
    """
    if resolution < 2 or block < 1 or not radius > 0 or not lipschitz > 0:
        raise ValueError(
            "expected resolution >= 2, block >= 1, radius > 0, lipschitz > 0, "
            f"got {resolution}, {block}, {radius}, {lipschitz}"
        )
    cell = 2.0 * radius / resolution

    def values(index: np.ndarray) -> np.ndarray:
        return sdf((-radius + cell * index).astype(np.float32))

    grid = _Grid(values, np.full(3, -radius), cell, resolution, block, Ball(radius), lipschitz)
    mesh = _march(grid, {}, progress)
    return replace(mesh, vertices=mesh.vertices.astype(np.float32))


def extract_box(
    values: SignedDistance,
    low: np.ndarray,
    high: np.ndarray,
    cell: float,
    block: int = 64,
    lipschitz: float = 2.0,
    progress: Callable[[int, int], None] | None = None,
) -> Isosurface:
    """The zero level set in a box of a lattice that goes on beyond it, as `extract_isosurface` finds it.

    The surface ends in an open border at the box's faces. On the upright ones all points are looked at, whatever the
    distances suggest: a box beside it, which sees the same values there, has the same border, to the last bit.

    Args:
        values: [N, 3] indices of lattice points -> [N] values, negative inside. The point i is at i * cell.
        low, high: [3] indices of the box's corners.
        cell: side of a cell, of which all multiples are exact (`geometry.tiling.lattice_cell`).

    Returns:
        The mesh; its vertices are float64.

    Raises:
        ValueError: the box is empty, or as `extract_isosurface`.
    """
    sides = high - low
    if (sides < 1).any() or block < 1 or not cell > 0:
        raise ValueError(f"expected a box, block >= 1 and cell > 0, got {low} to {high}, {block} and {cell}")
    resolution = max(int(sides.max()), 2)
    domain = Box(low * cell, high * cell)
    grid = _Grid(lambda index: values(index + low), low * cell, cell, resolution, block, domain, lipschitz)
    return _march(grid, _border_cells(grid, sides), progress)


def _border_cells(grid: _Grid, sides: np.ndarray) -> dict[tuple[int, int, int], np.ndarray]:
    """Cells of each block, as flat indices, through whose face on an upright side of the box the surface goes."""
    found = []
    for axis, other in ((0, 1), (1, 0)):
        for plane in (0, int(sides[axis])):
            shape = sides[other] + 1, sides[2] + 1
            index = np.empty((*shape, 3), dtype=np.int64)
            index[..., axis] = plane
            index[..., other], index[..., 2] = np.indices(shape)
            inside = grid.evaluate(index.reshape(-1, 3)).reshape(shape) < 0
            corners = [inside[i : shape[0] - 1 + i, j : shape[1] - 1 + j] for i in (0, 1) for j in (0, 1)]
            crossed = np.argwhere(np.logical_or.reduce(corners) & ~np.logical_and.reduce(corners))
            cells = np.empty((len(crossed), 3), dtype=np.int64)
            cells[:, axis] = min(plane, int(sides[axis]) - 1)
            cells[:, other], cells[:, 2] = crossed.T
            found.append(cells)
    cells = np.concatenate(found)
    keys = cells // grid.block
    return {
        key: np.unique(np.ravel_multi_index(tuple((cells[here] - np.array(key) * grid.block).T), (grid.block,) * 3))
        for key in sorted({(i, j, k) for i, j, k in keys.tolist()})
        if (here := (keys == key).all(1)).any()
    }


def _march(
    grid: _Grid,
    seeds: dict[tuple[int, int, int], np.ndarray],
    progress: Callable[[int, int], None] | None,
) -> Isosurface:
    """Block by block; `seeds` are cells to look at besides those that the distances suggest."""
    queue = list(dict.fromkeys([*grid.occupied_blocks(), *seeds]))
    done: dict[tuple[int, int, int], _BlockMesh] = {}
    finished = 0
    while queue:
        key = queue.pop(0)
        done[key] = grid.march(key, seeds.get(key))
        finished += 1
        for neighbour, wanted in done[key].wanted.items():
            # The surface leaves this block through cells that the neighbour skipped, or will not look at.
            if neighbour in done:
                wanted = np.setdiff1d(wanted, done[neighbour].border)
            if len(wanted):
                seeds[neighbour] = np.union1d(wanted, seeds.get(neighbour, wanted))
                if neighbour not in queue:
                    queue.append(neighbour)
        if progress is not None:
            progress(finished, finished + len(queue))
    return _weld(list(done.values()), grid.evaluated)


@dataclass(frozen=True)
class _BlockMesh:
    """One block's share of the mesh.

    Attributes:
        edge_ids: [V] int64 global grid edges, sorted, and `positions` [V, 3] of their vertices.
        triangles: [T, 3] int32 rows of these.
        wanted: neighbouring block -> [K] its cells through which the surface goes on, as flat indices.
        border: [L] flat indices of the cells along the block's border that were looked at.
    """

    edge_ids: np.ndarray
    positions: np.ndarray
    triangles: np.ndarray
    wanted: dict[tuple[int, int, int], np.ndarray]
    border: np.ndarray


class _Grid:
    """The grid, the values on its coarse lattice and on the planes between blocks.

    Args:
        values: [N, 3] int64 indices of lattice points -> [N] values.
        start: [3] coordinates of the point 0, 0, 0.
        resolution: cells along a side of the cube that the blocks fill.
    """

    def __init__(
        self,
        values: SignedDistance,
        start: np.ndarray,
        cell: float,
        resolution: int,
        block: int,
        domain: Domain,
        lipschitz: float,
    ) -> None:
        self.values, self.resolution, self.domain, self.cell = values, resolution, domain, cell
        self.slack = lipschitz * cell * np.sqrt(3.0) / 2  # times the step: Lipschitz bound over a half-diagonal
        self.step = 1
        while self.step * 2 * COARSE_CELLS <= resolution:
            self.step *= 2
        self.block = -(-min(block, resolution) // self.step) * self.step
        self.blocks = -(-resolution // self.block)
        self.evaluated = 0
        # Lattice coordinates go on past the cube where the last block sticks out; those points are outside the domain.
        index = np.arange(self.blocks * self.block + 1)
        self.size = len(index)
        self.axes = [s + cell * index for s in start]
        self.planes: dict[tuple[int, int], np.ndarray] = {}
        self.coarse = self._coarse_values()

    def evaluate(self, index: np.ndarray) -> np.ndarray:
        """Values [N] float32 at lattice points [N, 3]."""
        values = np.empty(len(index), dtype=np.float32)
        for start in range(0, len(index), MAX_POINTS):
            points = index[start : start + MAX_POINTS]
            part = np.asarray(self.values(points))
            if part.shape != (len(points),):
                raise ValueError(f"expected {len(points)} distances, got shape {part.shape}")
            values[start : start + MAX_POINTS] = part
        if not np.isfinite(values).all():
            raise ValueError(f"expected finite distances, got {np.count_nonzero(~np.isfinite(values))} others")
        self.evaluated += len(index)
        return values

    def _coarse_values(self) -> np.ndarray:
        axes = [axis[:: self.step] for axis in self.axes]
        values = np.full((len(axes[0]),) * 3, np.nan, dtype=np.float32)
        inside = _where(self.domain.holds(axes))
        values[tuple(inside.T)] = self.evaluate(inside * self.step)
        return values

    def occupied_blocks(self) -> list[tuple[int, int, int]]:
        """Blocks with a coarse cell that the surface may cross."""
        maybe = self._may_cross(self.coarse, self.step, [axis[:: self.step] for axis in self.axes])
        per = self.block // self.step
        blocks = maybe.reshape(self.blocks, per, self.blocks, per, self.blocks, per).any((1, 3, 5))
        return [(int(i), int(j), int(k)) for i, j, k in _where(np.asarray(blocks))]

    def _may_cross(self, values: np.ndarray, step: int, axes: list[np.ndarray]) -> np.ndarray:
        """Cells of a lattice of this step that the surface may cross. NaN stands for corners outside the domain."""
        corners = _corner_views(values)
        known = ~np.isnan(values)
        all_known = np.logical_and.reduce(_corner_views(known))
        none_known = ~np.logical_or.reduce(_corner_views(known))
        distance = np.where(known, np.abs(values), np.inf)
        nearest = np.minimum.reduce(_corner_views(distance))
        negative = np.logical_or.reduce([c < 0 for c in corners])
        positive = np.logical_or.reduce([c >= 0 for c in corners])
        # With corners missing, the nearest known one may be a whole diagonal away.
        bound = self.slack * step * np.where(all_known, 1.0, 2.0)
        crossed: np.ndarray = self.domain.meets(axes) & (none_known | (nearest <= bound) | (negative & positive))
        return crossed

    def march(self, key: tuple[int, int, int], seeds: np.ndarray | None) -> _BlockMesh:
        """Mesh one block. `seeds` [K], flat indices, are cells to look at besides those that the distances suggest."""
        origin = np.array(key) * self.block
        axes = [axis[o : o + self.block + 1] for axis, o in zip(self.axes, origin, strict=True)]
        known = self.domain.holds(axes)
        usable = np.logical_and.reduce(_corner_views(known))
        values = self._load(origin)

        step = self.step
        lattice = values[::step, ::step, ::step]
        active = self._may_cross(lattice, step, [a[::step] for a in axes])
        while step > 1:
            step //= 2
            active = active.repeat(2, 0).repeat(2, 1).repeat(2, 2)
            self._fill(values, active, step, origin, known)
            view = values[::step, ::step, ::step]
            if step > 1:
                active &= self._may_cross(view, step, [a[::step] for a in axes])
        active &= usable
        if seeds is not None:
            active.flat[seeds] = usable.flat[seeds]
        self._fill(values, active, 1, origin, known)

        wanted = self._follow(values, active, usable, origin, known, key)
        self._store(values, origin)
        return self._polygonise(values, active, origin, wanted)

    def _fill(self, values: np.ndarray, active: np.ndarray, step: int, origin: np.ndarray, known: np.ndarray) -> None:
        """Evaluate, in place, the corners of the active cells of this step that are not known yet."""
        view = values[::step, ::step, ::step]
        needed = np.zeros(view.shape, dtype=bool)
        for corner in _corner_views(needed):
            corner |= active
        needed &= np.isnan(view) & known[::step, ::step, ::step]
        index = _where(needed)
        if len(index):
            view[tuple(index.T)] = self.evaluate(index * step + origin)

    def _follow(
        self,
        values: np.ndarray,
        active: np.ndarray,
        usable: np.ndarray,
        origin: np.ndarray,
        known: np.ndarray,
        key: tuple[int, int, int],
    ) -> dict[tuple[int, int, int], np.ndarray]:
        """Activate, in place, cells the surface enters from active ones; return those of other blocks."""
        tables = cube_tables()
        wanted: dict[tuple[int, int, int], list[np.ndarray]] = {}
        cells = _where(active)
        while len(cells):
            pattern = _patterns(values, cells)
            new = []
            for face in range(6):
                shift = np.zeros(3, dtype=np.int64)
                shift[face // 2] = 1 if face % 2 else -1
                to = cells[tables.mixed_faces[pattern, face]] + shift
                outside = (to < 0).any(1) | (to >= self.block).any(1)
                x, y, z = (np.array(key) + shift).tolist()
                neighbour = (x, y, z)
                if outside.any() and min(neighbour) >= 0 and max(neighbour) < self.blocks:
                    wanted.setdefault(neighbour, []).append(to[outside] - shift * self.block)
                to = to[~outside]
                new.append(to[usable[tuple(to.T)] & ~active[tuple(to.T)]])
            cells = np.unique(np.concatenate(new), axis=0)
            if len(cells):
                active[tuple(cells.T)] = True
                self._fill(values, active, 1, origin, known)
        return {neighbour: self._usable_cells(neighbour, np.concatenate(w)) for neighbour, w in wanted.items()}

    def _usable_cells(self, key: tuple[int, int, int], cells: np.ndarray) -> np.ndarray:
        """Those of a block's cells [K, 3] whose corners are all in the domain, as flat indices."""
        origin = np.array(key) * self.block
        axes = [axis[o : o + self.block + 1] for axis, o in zip(self.axes, origin, strict=True)]
        usable = np.logical_and.reduce(_corner_views(self.domain.holds(axes)))
        cells = cells[usable[tuple(cells.T)]]
        return np.ravel_multi_index(tuple(cells.T), (self.block,) * 3)

    def _load(self, origin: np.ndarray) -> np.ndarray:
        """The block's lattice values so far: the coarse ones and what its neighbours computed on shared planes."""
        size = self.block + 1
        values = np.full((size,) * 3, np.nan, dtype=np.float32)
        for axis, side, rows in self._sides(origin):
            plane = self.planes.get((axis, int(origin[axis]) + side * self.block))
            if plane is not None:
                _plane_view(values, axis, side)[...] = plane[rows]
        low = origin // self.step
        per = self.block // self.step + 1
        part = self.coarse[low[0] : low[0] + per, low[1] : low[1] + per, low[2] : low[2] + per]
        values[:: self.step, :: self.step, :: self.step] = part
        return values

    def _store(self, values: np.ndarray, origin: np.ndarray) -> None:
        for axis, side, rows in self._sides(origin):
            key = (axis, int(origin[axis]) + side * self.block)
            if key not in self.planes:
                self.planes[key] = np.full((self.size,) * 2, np.nan, dtype=np.float32)
            self.planes[key][rows] = _plane_view(values, axis, side)

    def _sides(self, origin: np.ndarray) -> list[tuple[int, int, tuple[slice, slice]]]:
        sides = []
        for axis in range(3):
            u, v = (a for a in range(3) if a != axis)
            rows = (
                slice(origin[u], origin[u] + self.block + 1),
                slice(origin[v], origin[v] + self.block + 1),
            )
            sides += [(axis, 0, rows), (axis, 1, rows)]
        return sides

    def _polygonise(
        self,
        values: np.ndarray,
        active: np.ndarray,
        origin: np.ndarray,
        wanted: dict[tuple[int, int, int], np.ndarray],
    ) -> _BlockMesh:
        tables = cube_tables()
        cells = _where(active)
        pattern = _patterns(values, cells)
        crossed = tables.counts[pattern] > 0
        cells, pattern = cells[crossed], pattern[crossed]
        size = self.size

        # A grid edge is named by the lattice point where it begins, and its axis.
        def edge_id(cell: np.ndarray, edge: np.ndarray) -> np.ndarray:
            start = cell + origin + CORNERS[EDGE_STARTS[edge]]
            return ((start[:, 0] * size + start[:, 1]) * size + start[:, 2]) * 3 + edge // 4

        cell_of, edge = np.nonzero(tables.edges[pattern])
        ids, first, vertex = np.unique(edge_id(cells[cell_of], edge), return_index=True, return_inverse=True)
        vertex_of = np.zeros((len(cells), len(EDGES)), dtype=np.int32)
        vertex_of[cell_of, edge] = vertex
        cell_of, edge = cell_of[first], edge[first]
        start = cells[cell_of] + CORNERS[EDGE_STARTS[edge]]
        end = start.copy()
        end[np.arange(len(end)), edge // 4] += 1
        a, b = (values[tuple(p.T)].astype(np.float64) for p in (start, end))
        fraction = np.clip(a / np.where(a == b, 1.0, a - b), MIN_EDGE_FRACTION, 1 - MIN_EDGE_FRACTION)
        positions = np.stack([axis[at] for axis, at in zip(self.axes, (start + origin).T, strict=True)], 1)
        positions[np.arange(len(end)), edge // 4] += fraction * self.cell

        owner = np.repeat(np.arange(len(cells)), tables.counts[pattern])
        turn = np.arange(len(owner)) - np.repeat(np.cumsum(tables.counts[pattern]), tables.counts[pattern])
        turn += tables.counts[pattern][owner]
        corner_edges = tables.triangles[pattern[owner], turn]
        triangles = vertex_of[owner[:, None], corner_edges]
        active[1:-1, 1:-1, 1:-1] = False  # only the border matters to the neighbours
        return _BlockMesh(ids, positions, triangles, wanted, np.flatnonzero(active))


def _corner_views(lattice: np.ndarray) -> list[np.ndarray]:
    """Eight views [n, n, n] of a lattice [n + 1, n + 1, n + 1]: corner c of every cell."""
    cells = np.array(lattice.shape) - 1
    return [lattice[tuple(map(slice, corner, corner + cells))] for corner in CORNERS]


def _where(mask: np.ndarray) -> np.ndarray:
    """`np.argwhere`, which is several times slower on a cube of flags with few of them set."""
    return np.stack(np.unravel_index(np.flatnonzero(mask), mask.shape), axis=1)


def _patterns(values: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Sign patterns [K] of cells [K, 3] of a lattice [n, n, n]."""
    inside, first = values.ravel() < 0, np.ravel_multi_index(tuple(cells.T), values.shape)
    pattern = np.zeros(len(cells), dtype=np.int64)
    for bit, corner in enumerate(np.ravel_multi_index(tuple(CORNERS.T), values.shape)):
        pattern |= inside[first + corner].astype(np.int64) << bit
    return pattern


def _plane_view(values: np.ndarray, axis: int, side: int) -> np.ndarray:
    return np.moveaxis(values, axis, 0)[-side]


def _weld(parts: list[_BlockMesh], evaluated: int) -> Isosurface:
    """One mesh from the blocks' meshes: vertices on the same grid edge become one."""
    if not parts:
        return Isosurface(np.zeros((0, 3)), np.zeros((0, 3), np.int32), evaluated)
    ids = np.concatenate([p.edge_ids for p in parts])
    _, first, vertex = np.unique(ids, return_index=True, return_inverse=True)
    positions = np.concatenate([p.positions for p in parts])[first]
    starts = np.cumsum([0, *(len(p.edge_ids) for p in parts)])
    faces = np.concatenate([vertex[start + p.triangles] for start, p in zip(starts, parts, strict=False)])
    return Isosurface(positions, faces.astype(np.int32), evaluated)
