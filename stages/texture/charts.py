"""UV charts for a mesh: UVAtlas or xatlas, each in a process with a time limit, or projected charts of our own.

Texel coordinates here have their origin at the bottom-left corner of the texture; a texel's centre lies at .5.
"""

from __future__ import annotations

import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stages import children
from stages.geometry.vectors import unit
from stages.surface.triangle_mesh import (
    cut_into_manifold,
    face_adjacency,
    face_areas,
    face_normals,
    label_pieces,
    vertex_normals,
)

# xatlas charts may cover at most the mesh's area over this: its time grows steeply with the size of a chart.
CHARTS_AT_LEAST = 200
# A face may be tilted this far (cosine) against its chart's direction in the fallback: it stays unfolded.
MIN_TILT = 0.2
# Triangles whose interiors share less than this part of the smaller one's size only touch.
TOUCHING = 1e-4
# Rounds of smoothing of the normals, and of the labels, before charts are cut: fewer, rounder charts.
SMOOTHING_ROUNDS = 8


class ChartsError(Exception):
    """UVAtlas or xatlas failed, or was stopped at its time limit; the message says which and how."""


@dataclass(frozen=True)
class UvLayout:
    """A mesh's vertices split along chart seams, laid out on a square texture. Charts of xatlas may be mirrored.

    Attributes:
        source: [W] input vertex of each split vertex.
        faces: [F, 3] int32 split vertices, faces in the input's order.
        texels: [W, 2] float64 positions in [0, texture_size].
        charts: [F] chart of each face.
    """

    source: np.ndarray
    faces: np.ndarray
    texels: np.ndarray
    charts: np.ndarray


def unwrap_uvatlas(
    vertices: np.ndarray, faces: np.ndarray, texture_size: int, padding: int, time_limit: float
) -> UvLayout:
    """Charts by UVAtlas, in a process that is killed after `time_limit` CPU seconds: few, large, none mirrored.

    UVAtlas refuses or crashes on what is no manifold, so it is given a copy whose faces are cut apart there, without
    those that name a vertex twice.

    Raises:
        ChartsError: the limit was reached, UVAtlas crashed, or its charts do not fit.
    """
    whole = (faces != np.roll(faces, 1, axis=1)).all(1)
    source, sound = cut_into_manifold(faces[whole])
    found = _in_child(
        "UVAtlas",
        "stages.texture.uvatlas_worker",
        time_limit,
        vertices=vertices[source],
        faces=sound,
        resolution=texture_size - padding,
        padding=padding,
    )["texels"].astype(np.float64)
    if found.shape != (len(sound), 3, 2) or not np.isfinite(found).all():
        raise ChartsError(f"UVAtlas placed {np.isfinite(found).all((1, 2)).sum()} of {len(sound)} faces")
    corners = np.full((len(faces), 3, 2), np.nan)
    corners[whole] = found
    return _checked("UVAtlas", *_joined(faces, corners), texture_size, padding)


def unwrap_xatlas(
    vertices: np.ndarray, faces: np.ndarray, texture_size: int, padding: int, time_limit: float
) -> UvLayout:
    """Charts by xatlas, in a process that is killed after `time_limit` CPU seconds: many, small, some mirrored.

    Raises:
        ChartsError: the limit was reached, xatlas crashed, or its charts do not fit.
    """
    found = _in_child(
        "xatlas",
        "stages.texture.xatlas_worker",
        time_limit,
        vertices=vertices,
        faces=faces,
        max_chart_area=float(face_areas(vertices, faces).sum() / CHARTS_AT_LEAST),
        resolution=texture_size - padding,
        padding=padding,
    )
    source, new_faces = found["source"].astype(np.int64), found["faces"].astype(np.int32)
    if new_faces.shape != faces.shape or (source[new_faces] != faces).any():
        raise ChartsError(f"xatlas kept {len(new_faces)} of {len(faces)} faces, or not in order")
    return _checked("xatlas", source, new_faces, found["texels"].astype(np.float64), texture_size, padding)


@dataclass(frozen=True)
class Way:
    """A way to charts that may fail.

    Attributes:
        unwrap: vertices, faces, texture size, padding, time limit -> layout; raises `ChartsError`.
        fill: part of the texture that its charts fill on curved objects, by which the texture's size is chosen.
    """

    unwrap: Callable[[np.ndarray, np.ndarray, int, int, float], UvLayout]
    fill: float


# Of a texture, by projected charts.
PROJECTED_FILL = 0.41
# In the order in which one takes over from the other; docs/benchmarks/charts.md has the fills.
WAYS = {"uvatlas": Way(unwrap_uvatlas, 0.6), "xatlas": Way(unwrap_xatlas, 0.41)}


def _in_child(who: str, module: str, time_limit: float, **job: np.ndarray | float) -> dict[str, np.ndarray]:
    """What one of our modules, run on its own, makes of arrays.

    Raises:
        ChartsError: it needed more than `time_limit` seconds of CPU time, or ended without a result.
    """
    with tempfile.TemporaryDirectory(prefix="atlas-") as folder:
        source, target = Path(folder) / "in.npz", Path(folder) / "out.npz"
        arrays: dict[str, Any] = dict(job)
        np.savez(source, **arrays)
        try:
            done = children.run_module(module, str(source), str(target), cpu_limit=time_limit)
        except subprocess.TimeoutExpired as error:
            raise ChartsError(
                f"{who} needed more than {time_limit:g} s for {len(np.asarray(job['faces']))} faces"
            ) from error
        if done.returncode != 0 or not target.is_file():
            last = ([line for line in done.stderr.splitlines() if line.strip()] or ["no message"])[-1]
            raise ChartsError(f"{who} ended with code {done.returncode}: {last.strip()}")
        with np.load(target) as data:
            return {name: data[name] for name in data.files}


def _joined(faces: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split vertices of texels [F, 3, 2] given to each corner: source [W], faces [F, 3], texels [W, 2].

    A face without texels (nan) lies in a point: where one of its vertices does, or at the origin.
    """
    placed = np.isfinite(corners).all((1, 2))
    of_vertex = np.full((int(faces.max(initial=-1)) + 1, 2), np.nan)
    of_vertex[faces[placed].ravel()] = corners[placed].reshape(-1, 2)
    corners = corners.copy()
    for face in np.flatnonzero(~placed):
        known = of_vertex[faces[face]]
        known = known[np.isfinite(known).all(1)]
        corners[face] = known[0] if len(known) else 0.0
    rows = np.concatenate([faces.reshape(-1, 1).astype(np.float64), corners.reshape(-1, 2)], axis=1)
    unique, index = np.unique(rows, axis=0, return_inverse=True)
    return unique[:, 0].astype(np.int64), index.reshape(-1, 3).astype(np.int32), unique[:, 1:]


def _checked(
    who: str, source: np.ndarray, faces: np.ndarray, texels: np.ndarray, texture_size: int, padding: int
) -> UvLayout:
    """A layout of texels in [0, texture_size - padding], with half the padding around all and no overlaps.

    Raises:
        ChartsError: the texels reach further, or no room is left for faces that overlap.
    """
    if texels.max(initial=0) > texture_size - padding or texels.min(initial=0) < 0:
        reach = f"{texels.min():.0f} to {texels.max():.0f}"
        raise ChartsError(f"the charts of {who} lie at {reach} texels, expected 0 to {texture_size - padding}")
    texels = texels + padding / 2
    layout = UvLayout(source, faces, texels, label_pieces(len(faces), face_adjacency(faces)))
    pairs = overlapping_pairs(texels[faces])
    return _move_overlaps(layout, pairs, texture_size, padding) if len(pairs) else layout


def unwrap_projected(vertices: np.ndarray, faces: np.ndarray, texture_size: int, padding: int) -> UvLayout:
    """Charts by projection along the axes: robust and quick, with more seams than xatlas leaves.

    Faces are grouped by the axis direction their smoothed normal is closest to; connected groups become charts,
    projected along the axis. A chart that overlaps itself (a ramp that winds around) is cut into layers until no two
    faces overlap. Charts are packed in rows.

    Raises:
        ValueError: the charts do not fit the texture.
    """
    points = vertices.astype(np.float64)
    normals = face_normals(points, faces)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    units = normals / np.where(length > 0, length, 1)
    adjacency = face_adjacency(faces)
    axis = _axis_of_faces(units, adjacency)
    flat = _project(points[faces], axis)
    charts = _cut_overlaps(flat, axis, adjacency, points[faces])
    source, new_faces = _split_along_seams(faces, charts)
    # Charts are disjoint in split vertices, so each vertex has one chart and one axis.
    texels = np.empty((len(source), 2))
    texels[new_faces] = flat
    chart_of_vertex = np.empty(len(source), dtype=np.int64)
    chart_of_vertex[new_faces] = charts[:, None]
    texels = _pack(texels, chart_of_vertex, texture_size, padding)
    return UvLayout(source, new_faces, texels, charts)


def _axis_of_faces(units: np.ndarray, adjacency: np.ndarray) -> np.ndarray:
    """Axis direction [F] in 0..5 (+x, -x, +y, ...) of each face: near its smoothed normal, never flipping it."""
    from scipy.sparse import coo_matrix

    count = len(units)
    both = np.concatenate([adjacency, adjacency[:, ::-1]])
    neighbours = coo_matrix((np.ones(len(both)), (both[:, 0], both[:, 1])), shape=(count, count)).tocsr()
    directions = np.repeat(np.eye(3), 2, axis=0) * np.tile([1.0, -1.0], 3)[:, None]
    smooth = units.copy()
    for _ in range(SMOOTHING_ROUNDS):
        smooth = unit(smooth + neighbours @ smooth)
    tilt = units @ directions.T
    allowed = tilt > MIN_TILT
    axis = np.where(allowed, smooth @ directions.T, -2 + tilt).argmax(1)
    for _ in range(SMOOTHING_ROUNDS):
        votes = neighbours @ np.eye(6)[axis] + 0.5 * np.eye(6)[axis]
        axis = np.where(allowed, votes, -2 + tilt).argmax(1)
    return axis


def _project(corners: np.ndarray, axis: np.ndarray) -> np.ndarray:
    """Corners [F, 3, 2] seen along each face's axis direction, counter-clockwise."""
    u = np.array([1, 2, 2, 0, 0, 1])[axis]
    v = np.array([2, 1, 0, 2, 1, 0])[axis]
    rows = np.arange(len(corners))
    return np.stack([corners[rows, :, u], corners[rows, :, v]], axis=2)


def _cut_overlaps(flat: np.ndarray, axis: np.ndarray, adjacency: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Chart [F] of each face: connected, of one axis, and without two faces that overlap."""
    adjacency = adjacency[axis[adjacency[:, 0]] == axis[adjacency[:, 1]]]
    charts = label_pieces(len(flat), adjacency)
    pairs = overlapping_pairs(flat, charts)
    if len(pairs):
        # Lowest faces first, so that a winding ramp is cut once a turn.
        depth = corners.mean(1)[np.arange(len(axis)), axis // 2]
        layer = _layers(pairs, depth)
        charts = label_pieces(len(flat), adjacency[layer[adjacency[:, 0]] == layer[adjacency[:, 1]]])
    return charts


def _layers(pairs: np.ndarray, rank: np.ndarray) -> np.ndarray:
    """Layer [F] of each face so that no pair [P, 2] shares one: greedy colouring in the order of `rank` [F]."""
    conflicts: dict[int, list[int]] = {}
    for a, b in pairs.tolist():
        conflicts.setdefault(a, []).append(b)
        conflicts.setdefault(b, []).append(a)
    layer = np.zeros(len(rank), dtype=np.int64)
    coloured: dict[int, int] = {}
    for face in sorted(conflicts, key=lambda f: (rank[f], f)):
        taken = {coloured[other] for other in conflicts[face] if other in coloured}
        coloured[face] = next(colour for colour in range(len(taken) + 1) if colour not in taken)
        layer[face] = coloured[face]
    return layer


def _move_overlaps(layout: UvLayout, pairs: np.ndarray, texture_size: int, padding: int) -> UvLayout:
    """The same layout with one face of each overlapping pair moved to where the texture is free.

    xatlas lets a few small faces of a chart fold over, and UVAtlas may; they become charts of their own, at the same
    scale.

    Raises:
        ChartsError: no room is left for them.
    """
    import cv2

    corners = layout.texels[layout.faces]
    edges = corners[:, 1:] - corners[:, :1]
    area = np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
    layer = _layers(pairs, -area)  # large faces stay
    adjacency = face_adjacency(layout.faces)
    charts = label_pieces(len(layout.faces), adjacency[layer[adjacency[:, 0]] == layer[adjacency[:, 1]]])
    source, new_faces = _split_along_seams(layout.faces, charts)
    texels = layout.texels[source]

    taken: np.ndarray = np.zeros((texture_size, texture_size), dtype=np.uint8)
    for triangle in np.floor(corners[layer == 0]).astype(np.int32):
        cv2.fillConvexPoly(taken, triangle, 1)
    grow = 2 * (padding + 1) + 1
    cv2.dilate(taken, np.ones((grow, grow), dtype=np.uint8), dst=taken)
    border = padding // 2
    taken[:border] = taken[:, :border] = 1
    taken[texture_size - border :] = taken[:, texture_size - border :] = 1
    for chart in np.unique(charts[layer > 0]):
        members = np.unique(new_faces[charts == chart])
        low = np.floor(texels[members].min(0)).astype(np.int64)
        width, height = np.ceil(texels[members].max(0)).astype(np.int64) - low + 1
        corner = _free_box(taken, int(width), int(height))
        if corner is None:
            raise ChartsError(f"{len(pairs)} pairs of faces overlap in the texture and no room is left to move them")
        x, y = corner
        texels[members] += np.array([x, y]) - low
        around = padding + 1
        taken[max(y - around, 0) : y + height + around, max(x - around, 0) : x + width + around] = 1
    return UvLayout(layout.source[source], new_faces, texels, charts)


def _free_box(taken: np.ndarray, width: int, height: int) -> tuple[int, int] | None:
    """Lower corner (x, y) of the first box of texels of this size without a taken one, or None."""
    import cv2

    sums = cv2.integral(taken)
    if height >= sums.shape[0] or width >= sums.shape[1]:
        return None
    inside = sums[height:, width:] - sums[:-height, width:] - sums[height:, :-width] + sums[:-height, :-width]
    free = np.flatnonzero(inside == 0)
    if not len(free):
        return None
    y, x = divmod(int(free[0]), inside.shape[1])
    return x, y


def overlapping_pairs(triangles: np.ndarray, groups: np.ndarray | None = None) -> np.ndarray:
    """Pairs [P, 2] of triangles [F, 3, 2] in a plane whose interiors meet; those that only touch do not count.

    Candidates come from a grid of about the triangles' size; each is decided by separating axes. With `groups` [F],
    only triangles of one group are compared.
    """
    groups = np.zeros(len(triangles), dtype=np.int64) if groups is None else groups
    low, high = triangles.min(1), triangles.max(1)
    size = high - low
    cell = 2 * float(np.mean(size)) or 1.0
    first = np.floor(low / cell).astype(np.int64)
    span = np.floor(high / cell).astype(np.int64) - first + 1
    count = span[:, 0] * span[:, 1]
    owner = np.repeat(np.arange(len(triangles)), count)
    turn = np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)
    cells = first[owner] + np.stack([turn % span[owner, 0], turn // span[owner, 0]], axis=1)
    cells -= cells.min(0, initial=0)
    key = (groups[owner] * (cells[:, 0].max(initial=0) + 1) + cells[:, 0]) * (cells[:, 1].max(initial=0) + 1)
    key += cells[:, 1]
    order = np.argsort(key, kind="stable")
    key, owner = key[order], owner[order]
    found = []
    for step in range(1, len(key)):
        near = np.flatnonzero(key[step:] == key[:-step])
        if not len(near):
            break
        a, b = owner[near], owner[near + step]
        meet = ((low[a] < high[b]) & (low[b] < high[a])).all(1)
        a, b = a[meet], b[meet]
        hit = _interiors_meet(triangles[a], triangles[b])
        found.append(np.stack([np.minimum(a, b), np.maximum(a, b)], axis=1)[hit])
    return np.unique(np.concatenate(found), axis=0) if found else np.zeros((0, 2), dtype=np.int64)


def _interiors_meet(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Whether triangles a and b [N, 3, 2] overlap by more than a touch: no edge direction separates them."""
    meet = np.ones(len(a), dtype=bool)
    smaller = np.minimum(np.ptp(a, axis=1).max(1), np.ptp(b, axis=1).max(1))
    for triangle in (a, b):
        for i in range(3):
            edge = triangle[:, (i + 1) % 3] - triangle[:, i]
            length = np.maximum(np.linalg.norm(edge, axis=1), 1e-30)
            normal = np.stack([-edge[:, 1], edge[:, 0]], axis=1) / length[:, None]
            on_a = np.einsum("nki,ni->nk", a - triangle[:, i : i + 1], normal)
            on_b = np.einsum("nki,ni->nk", b - triangle[:, i : i + 1], normal)
            overlap = np.minimum(on_a.max(1), on_b.max(1)) - np.maximum(on_a.min(1), on_b.min(1))
            meet &= overlap > TOUCHING * smaller
    return meet


def _split_along_seams(faces: np.ndarray, charts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """One vertex for each (vertex, chart) that occurs: the vertex [W] it copies, and faces [F, 3] of the new ones."""
    pairs = np.stack([np.repeat(charts, 3), faces.ravel()], axis=1)
    unique, index = np.unique(pairs, axis=0, return_inverse=True)
    return unique[:, 1].astype(np.int64), index.reshape(-1, 3).astype(np.int32)


def _pack(points: np.ndarray, chart: np.ndarray, texture_size: int, padding: int) -> np.ndarray:
    """Texel positions [W, 2] of points [W, 2] (scene units), charts in rows by falling height, as large as fits."""
    count = int(chart.max(initial=-1)) + 1
    low = np.full((count, 2), np.inf)
    high = np.full((count, 2), -np.inf)
    np.minimum.at(low, chart, points)
    np.maximum.at(high, chart, points)
    extent = high - low
    turned = extent[:, 1] > extent[:, 0]  # lying charts make low rows
    size = np.where(turned[:, None], extent[:, ::-1], extent)
    order = np.argsort(-size[:, 1], kind="stable")

    def place(scale: float) -> np.ndarray | None:
        boxes = np.ceil(size[order] * scale).astype(np.int64) + padding
        corner = np.empty((count, 2), dtype=np.int64)
        x = y = padding
        row = 0
        for i, (width, height) in enumerate(boxes.tolist()):
            if x + width > texture_size:
                x, y, row = padding, y + row, 0
            if x + width > texture_size or y + height > texture_size:
                return None
            corner[i] = x, y
            x, row = x + width, max(row, height)
        placed = np.empty_like(corner)
        placed[order] = corner
        return placed

    if place(0.0) is None:
        raise ValueError(
            f"expected room for {count} charts with {padding} texels of padding, got {texture_size}^2 texels"
        )
    best, bad = 0.0, texture_size / max(float(extent.max(initial=0)), 1e-12)
    for _ in range(20):
        middle = (best + bad) / 2
        if place(middle) is None:
            bad = middle
        else:
            best = middle
    corners = place(best)
    assert corners is not None
    local = (points - low[chart]) * best
    # Turning by a quarter keeps charts unmirrored: (x, y) -> (y, width - x).
    quarter = np.stack([local[:, 1], extent[chart, 0] * best - local[:, 0]], axis=1)
    return np.where(turned[chart][:, None], quarter, local) + corners[chart]


def smooth_normals(vertices: np.ndarray, faces: np.ndarray, source: np.ndarray) -> np.ndarray:
    """Unit normals [W, 3] float32 of split vertices, area-weighted on the mesh before the split: no seams show."""
    return vertex_normals(vertices, faces)[source].astype(np.float32)
