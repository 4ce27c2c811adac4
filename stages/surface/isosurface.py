"""The zero level set of a signed distance function as a triangle mesh, block by block.

Marching cubes with one vertex per crossed grid edge and tables generated here so that the result is always an
orientable 2-manifold:
- on a face whose four corners alternate in sign, the two inside corners are always separated, by either cube that
  shares the face, so neighbours agree (Lorensen and Cline's 15 cases do not);
- no triangle edge inside a cube joins two vertices of one cube face, where the neighbour might draw the same edge.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

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


@dataclass(frozen=True)
class Isosurface:
    """A triangle mesh and what it cost.

    Attributes:
        vertices: [V, 3] float32.
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
    grid = _Grid(sdf, resolution, block, radius, lipschitz)
    queue = grid.occupied_blocks()
    seeds: dict[tuple[int, int, int], np.ndarray] = {}
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
    """The grid, the values on its coarse lattice and on the planes between blocks."""

    def __init__(self, sdf: SignedDistance, resolution: int, block: int, radius: float, lipschitz: float) -> None:
        self.sdf, self.resolution, self.radius = sdf, resolution, radius
        self.cell = 2.0 * radius / resolution
        self.slack = lipschitz * self.cell * np.sqrt(3.0) / 2  # times the step: Lipschitz bound over a half-diagonal
        self.step = 1
        while self.step * 2 * COARSE_CELLS <= resolution:
            self.step *= 2
        self.block = -(-min(block, resolution) // self.step) * self.step
        self.blocks = -(-resolution // self.block)
        self.evaluated = 0
        # Lattice coordinates go on past the cube where the last block sticks out; those points are outside the ball.
        self.axis = -radius + self.cell * np.arange(self.blocks * self.block + 1)
        self.planes: dict[tuple[int, int], np.ndarray] = {}
        self.coarse = self._coarse_values()

    def evaluate(self, index: np.ndarray) -> np.ndarray:
        """Values [N] float32 at lattice points [N, 3]."""
        values = np.empty(len(index), dtype=np.float32)
        for start in range(0, len(index), MAX_POINTS):
            points = self.axis[index[start : start + MAX_POINTS]].astype(np.float32)
            part = np.asarray(self.sdf(points))
            if part.shape != (len(points),):
                raise ValueError(f"expected {len(points)} distances, got shape {part.shape}")
            values[start : start + MAX_POINTS] = part
        if not np.isfinite(values).all():
            raise ValueError(f"expected finite distances, got {np.count_nonzero(~np.isfinite(values))} others")
        self.evaluated += len(index)
        return values

    def _in_ball(self, squares: list[np.ndarray]) -> np.ndarray:
        total = squares[0][:, None, None] + squares[1][None, :, None] + squares[2][None, None, :]
        return total <= self.radius**2 * (1 + 1e-9)

    def _coarse_values(self) -> np.ndarray:
        axis = self.axis[:: self.step]
        values = np.full((len(axis),) * 3, np.nan, dtype=np.float32)
        inside = _where(self._in_ball([axis**2] * 3))
        values[tuple(inside.T)] = self.evaluate(inside * self.step)
        return values

    def occupied_blocks(self) -> list[tuple[int, int, int]]:
        """Blocks with a coarse cell that the surface may cross."""
        axis = self.axis[:: self.step]
        maybe = self._may_cross(self.coarse, self.step, [axis] * 3)
        per = self.block // self.step
        blocks = maybe.reshape(self.blocks, per, self.blocks, per, self.blocks, per).any((1, 3, 5))
        return [(int(i), int(j), int(k)) for i, j, k in _where(np.asarray(blocks))]

    def _may_cross(self, values: np.ndarray, step: int, axes: list[np.ndarray]) -> np.ndarray:
        """Cells of a lattice of this step that the surface may cross. NaN stands for corners outside the ball."""
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
        # The cell's point nearest to the centre tells whether any of it lies in the ball.
        low = [np.clip(0.0, a[:-1], a[1:]) ** 2 for a in axes]
        return self._in_ball(low) & (none_known | (nearest <= bound) | (negative & positive))

    def march(self, key: tuple[int, int, int], seeds: np.ndarray | None) -> _BlockMesh:
        """Mesh one block. `seeds` [K], flat indices, are cells to look at besides those that the distances suggest."""
        origin = np.array(key) * self.block
        axes = [self.axis[o : o + self.block + 1] for o in origin]
        ball = self._in_ball([a**2 for a in axes])
        usable = np.logical_and.reduce(_corner_views(ball))
        values = self._load(origin)

        step = self.step
        lattice = values[::step, ::step, ::step]
        active = self._may_cross(lattice, step, [a[::step] for a in axes])
        while step > 1:
            step //= 2
            active = active.repeat(2, 0).repeat(2, 1).repeat(2, 2)
            self._fill(values, active, step, origin, ball)
            view = values[::step, ::step, ::step]
            if step > 1:
                active &= self._may_cross(view, step, [a[::step] for a in axes])
        active &= usable
        if seeds is not None:
            active.flat[seeds] = usable.flat[seeds]
        self._fill(values, active, 1, origin, ball)

        wanted = self._follow(values, active, usable, origin, ball, key)
        self._store(values, origin)
        return self._polygonise(values, active, origin, wanted)

    def _fill(self, values: np.ndarray, active: np.ndarray, step: int, origin: np.ndarray, ball: np.ndarray) -> None:
        """Evaluate, in place, the corners of the active cells of this step that are not known yet."""
        view = values[::step, ::step, ::step]
        needed = np.zeros(view.shape, dtype=bool)
        for corner in _corner_views(needed):
            corner |= active
        needed &= np.isnan(view) & ball[::step, ::step, ::step]
        index = _where(needed)
        if len(index):
            view[tuple(index.T)] = self.evaluate(index * step + origin)

    def _follow(
        self,
        values: np.ndarray,
        active: np.ndarray,
        usable: np.ndarray,
        origin: np.ndarray,
        ball: np.ndarray,
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
                self._fill(values, active, 1, origin, ball)
        return {neighbour: self._in_ball_cells(neighbour, np.concatenate(w)) for neighbour, w in wanted.items()}

    def _in_ball_cells(self, key: tuple[int, int, int], cells: np.ndarray) -> np.ndarray:
        """Those of a block's cells [K, 3] whose corners are all in the ball, as flat indices."""
        index = cells + np.array(key) * self.block
        far = np.maximum(np.abs(self.axis[index]), np.abs(self.axis[index + 1]))
        cells = cells[(far**2).sum(1) <= self.radius**2 * (1 + 1e-9)]
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
                self.planes[key] = np.full((len(self.axis),) * 2, np.nan, dtype=np.float32)
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
        size = len(self.axis)

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
        positions = self.axis[start + origin]
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
        return Isosurface(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), evaluated)
    ids = np.concatenate([p.edge_ids for p in parts])
    _, first, vertex = np.unique(ids, return_index=True, return_inverse=True)
    positions = np.concatenate([p.positions for p in parts])[first]
    starts = np.cumsum([0, *(len(p.edge_ids) for p in parts)])
    faces = np.concatenate([vertex[start + p.triangles] for start, p in zip(starts, parts, strict=False)])
    return Isosurface(positions.astype(np.float32), faces.astype(np.int32), evaluated)
