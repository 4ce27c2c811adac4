"""Triangle meshes as arrays: normals, edges, pieces, how sound one is and its repair, cuts, rays.

Every function takes and returns vertices [V, 3] and faces [F, 3], counter-clockwise seen from outside.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

# Rays cast in one call, to bound memory, and what they are called where it runs out.
MAX_RAYS, RAYS = 1 << 20, "rays at a mesh"


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Cross products [F, 3] float64 of each face's edges: twice the area long, counter-clockwise side."""
    a, b, c = (vertices[faces[:, i]].astype(np.float64) for i in range(3))
    return np.cross(b - a, c - a)


def face_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area [F] float64 of each face."""
    return np.linalg.norm(face_normals(vertices, faces), axis=1) / 2


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted unit normals [V, 3] float64; +z where a vertex has no area around it."""
    total = sum_around(faces, face_normals(vertices, faces), len(vertices))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(length > 0, total / np.where(length > 0, length, 1), (0.0, 0.0, 1.0))


def sum_around(faces: np.ndarray, values: np.ndarray, num_vertices: int) -> np.ndarray:
    """Sum [V, C] over the faces around each vertex of values [F, C] of the faces."""
    corners = faces.ravel()
    return np.stack([np.bincount(corners, np.repeat(each, 3), minlength=num_vertices) for each in values.T], axis=1)


def median_edge(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Median length of the faces' edges."""
    edges = vertices[faces] - vertices[np.roll(faces, 1, axis=1)]
    return float(np.median(np.linalg.norm(edges, axis=2)))


def unique_positions(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions [U, 3], each once, and which of them each vertex [V] has: vertices are split along UV seams."""
    positions, index = np.unique(np.ascontiguousarray(vertices), axis=0, return_inverse=True)
    return positions, index.reshape(-1)


def compact(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same mesh without vertices that no face uses; order kept."""
    used = np.zeros(len(vertices), dtype=bool)
    used[faces] = True
    new_index = np.cumsum(used) - 1
    return vertices[used], new_index[faces].astype(np.int32)


@dataclass(frozen=True)
class EdgeUse:
    """The edges of a mesh and the faces at them.

    Attributes:
        face: [3F] face of each half-edge, grouped by edge.
        slot: [3F] 0..2, the half-edge runs from corner `slot` to corner `slot + 1` of its face.
        forward: [3F] bool, it runs from the lower to the higher vertex.
        edge: [3F] edge of each half-edge, non-decreasing.
        counts: [E] half-edges of each edge.
    """

    face: np.ndarray
    slot: np.ndarray
    forward: np.ndarray
    edge: np.ndarray
    counts: np.ndarray

    def manifold_pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions [P] and [P] of the half-edges that make up edges of exactly two faces, consistently turned."""
        first = np.flatnonzero(self.counts[self.edge[:-1]] == 2) if len(self.edge) else np.zeros(0, dtype=np.int64)
        first = first[self.edge[first] == self.edge[first + 1]]
        first = first[self.forward[first] != self.forward[first + 1]]
        return first, first + 1


def edge_use(faces: np.ndarray) -> EdgeUse:
    """Which faces share which edges."""
    start, end = faces.astype(np.int64), np.roll(faces, -1, axis=1).astype(np.int64)
    low, high = np.minimum(start, end).ravel(), np.maximum(start, end).ravel()
    key = low * (int(faces.max(initial=0)) + 1) + high
    order = np.argsort(key, kind="stable")
    sorted_key = key[order]
    new = np.ones(len(key), dtype=bool)
    new[1:] = sorted_key[1:] != sorted_key[:-1]
    edge = np.cumsum(new) - 1
    return EdgeUse(order // 3, order % 3, (start < end).ravel()[order], edge, np.bincount(edge))


def face_adjacency(faces: np.ndarray) -> np.ndarray:
    """Pairs [P, 2] of faces that share a manifold edge."""
    use = edge_use(faces)
    first, second = use.manifold_pairs()
    return np.stack([use.face[first], use.face[second]], axis=1)


def label_pieces(count: int, pairs: np.ndarray) -> np.ndarray:
    """Connected component of each of `count` faces (or vertices, or corners) of which pairs [P, 2] are joined."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    graph = coo_matrix((np.ones(len(pairs), dtype=bool), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    return connected_components(graph, directed=False)[1]


@dataclass(frozen=True)
class MeshState:
    """How sound a mesh is.

    Attributes:
        open_edges: edges of one face.
        bad_edges: edges of more than two faces, or of two that are turned against each other.
        bad_vertices: vertices where more than one fan of faces meets.
    """

    open_edges: int
    bad_edges: int
    bad_vertices: int

    @property
    def manifold(self) -> bool:
        return self.bad_edges == 0 and self.bad_vertices == 0

    @property
    def watertight(self) -> bool:
        return self.open_edges == 0 and self.bad_edges == 0


def mesh_state(faces: np.ndarray) -> MeshState:
    """Count what keeps a mesh from being a closed, oriented 2-manifold."""
    use = edge_use(faces)
    matched = len(use.manifold_pairs()[0])
    open_edges = int(np.count_nonzero(use.counts == 1))
    fans = _fans(faces, use)
    corners = np.stack([faces.ravel(), fans], axis=1)
    per_vertex = np.bincount(np.unique(corners, axis=0)[:, 0]) if len(faces) else np.zeros(0)
    return MeshState(open_edges, len(use.counts) - open_edges - matched, int(np.count_nonzero(per_vertex > 1)))


def _fans(faces: np.ndarray, use: EdgeUse) -> np.ndarray:
    """Fan [3F] of each face corner: corners at one vertex are in one fan if manifold edges lead from one to another."""
    first, second = use.manifold_pairs()
    # The half-edge and its twin run in opposite directions: the start of one is the end of the other.
    start = use.face * 3 + use.slot
    end = use.face * 3 + (use.slot + 1) % 3
    rows = np.concatenate([start[first], end[first]])
    columns = np.concatenate([end[second], start[second]])
    return label_pieces(faces.size, np.stack([rows, columns], axis=1))


def repair_manifold(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A 2-manifold from a mesh that nearly is one.

    Drops degenerate and duplicate faces, and both of two that lie back to back; at edges of more than two faces, those
    with the most open edges, then the smallest, until two are left; where two faces at an edge are turned against each
    other, or several fans meet in one vertex, gives each fan its own copy of the vertex. Unused vertices go.
    """
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    # +1 or -1, which way around the corners go. Faces back to back close nothing: one of two alone would leave a hole.
    turn = np.where((np.diff(faces, axis=1, append=faces[:, :1]) > 0).sum(1) == 2, 1, -1)
    _, same = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True)
    same = same.reshape(-1)
    faces, same = (rows[turn * np.bincount(same, turn)[same] > 0] for rows in (faces, same))
    faces = faces[np.sort(np.unique(same, return_index=True)[1])]
    while True:
        use = edge_use(faces)
        crowded = use.counts[use.edge] > 2
        if not crowded.any():
            break
        area = np.linalg.norm(face_normals(vertices, faces), axis=1)
        crowd_edge, crowd_face = use.edge[crowded], use.face[crowded]
        loose = np.bincount(use.face[use.counts[use.edge] == 1], minlength=len(faces))
        order = np.lexsort((area[crowd_face], -loose[crowd_face], crowd_edge))
        worst = np.ones(len(order), dtype=bool)
        worst[1:] = crowd_edge[order][1:] != crowd_edge[order][:-1]
        keep = np.ones(len(faces), dtype=bool)
        keep[crowd_face[order][worst]] = False
        faces = faces[keep]
    fans = _fans(faces, use)
    _, first, corner = np.unique(fans, return_index=True, return_inverse=True)
    # Fans in the order of their vertices, so that a sound mesh comes back with its vertices where they were.
    order = np.argsort(faces.ravel()[first], kind="stable")
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    new_faces = rank[corner.reshape(-1)].reshape(-1, 3)
    return vertices[faces.ravel()[first[order]]], new_faces.astype(np.int32)


def cut_into_manifold(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same faces, cut apart where they are no oriented manifold: the vertex [W] each new one copies, faces [F, 3].

    Each fan of faces gets its own copy of its vertex. What is still wrong then, faces at edges that fans around other
    vertices hold together and faces on the same three vertices, is cut out whole.

    Args:
        faces: [F, 3], none with a vertex twice.
    """
    alone = np.zeros(len(faces), dtype=bool)
    own = int(faces.max(initial=-1)) + 1 + np.arange(faces.size).reshape(-1, 3)
    while True:
        glued = np.where(alone[:, None], own, faces)
        _, first, corner = np.unique(_fans(glued, edge_use(glued)), return_index=True, return_inverse=True)
        cut = corner.reshape(-1, 3).astype(np.int32)
        use = edge_use(cut)
        wrong = use.counts[use.edge] > 1
        wrong[np.concatenate(use.manifold_pairs())] = False
        _, same, count = np.unique(np.sort(cut, axis=1), axis=0, return_inverse=True, return_counts=True)
        bad = count[same.reshape(-1)] > 1
        bad[use.face[wrong]] = True
        if not bad.any():
            return faces.ravel()[first].astype(np.int64), cut
        alone |= bad


def clip(vertices: np.ndarray, faces: np.ndarray, normal: np.ndarray, offset: float) -> tuple[np.ndarray, np.ndarray]:
    """The part of the mesh with normal . x >= offset; faces across the plane are cut at it. Unused vertices go."""
    heights = vertices.astype(np.float64) @ normal - offset
    inside = heights >= 0
    corners_inside = inside[faces].sum(1)
    whole, across = faces[corners_inside == 3], faces[(corners_inside > 0) & (corners_inside < 3)]
    if not len(across):
        return compact(vertices, whole)
    # turned so that the corner alone on its side comes first
    alone = inside[across] == (inside[across].sum(1) == 1)[:, None]
    start = alone.argmax(1)[:, None]
    a, b, c = np.take_along_axis(across, (start + np.arange(3)) % 3, axis=1).T
    edges = np.sort(np.stack([np.stack([a, b], 1), np.stack([a, c], 1)]), axis=2)
    unique, index = np.unique(edges.reshape(-1, 2), axis=0, return_inverse=True)
    low, high = heights[unique[:, 0]], heights[unique[:, 1]]
    part = (low / (low - high))[:, None]
    cut = vertices[unique[:, 0]] * (1 - part) + vertices[unique[:, 1]] * part
    ab, ac = len(vertices) + index.reshape(2, -1)
    tips = inside[a]
    new = [np.stack([a, ab, ac], 1)[tips], np.stack([ab, b, c], 1)[~tips], np.stack([ab, c, ac], 1)[~tips]]
    return compact(np.concatenate([vertices, cut.astype(vertices.dtype)]), np.concatenate([whole, *new]))


def raycaster(vertices: np.ndarray, faces: np.ndarray, *others: tuple[np.ndarray, np.ndarray]) -> Any:
    """Open3D's RaycastingScene of one mesh, or of that and others."""
    import open3d as o3d

    scene = o3d.t.geometry.RaycastingScene()
    for places, corners in ((vertices, faces), *others):
        scene.add_triangles(
            o3d.core.Tensor(np.ascontiguousarray(places, dtype=np.float32)),
            o3d.core.Tensor(np.ascontiguousarray(corners, dtype=np.uint32)),
        )
    return scene
