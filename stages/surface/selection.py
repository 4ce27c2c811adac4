"""Which faces of a raw mesh are kept: by place, by piece, by what cameras see, and by masks.

Selections are boolean arrays over faces [F] or vertices [V].
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from stages.blocks import in_blocks
from stages.geometry.cameras import PinholeCameras
from stages.surface.triangle_mesh import (
    MAX_RAYS,
    RAYS,
    face_adjacency,
    face_areas,
    label_pieces,
    median_edge,
    raycaster,
    vertex_normals,
)

# A face seen flatter than this (cosine) counts as unseen: no photo says anything of it.
MIN_COSINE = 0.05


def inside_ball(vertices: np.ndarray, faces: np.ndarray, radius: float) -> np.ndarray:
    """Faces [F] bool with all corners within `radius` of the origin."""
    return (np.linalg.norm(vertices, axis=1) <= radius)[faces].all(1)


def large_pieces(faces: np.ndarray, min_part: float, spared: np.ndarray | None = None) -> tuple[np.ndarray, int]:
    """Faces [F] bool of pieces with at least `min_part` of the largest piece's faces, and how many pieces go.

    Pieces with a face that is `spared` [F] stay, however small.
    """
    labels = label_pieces(len(faces), face_adjacency(faces))
    sizes = np.bincount(labels)
    keep = sizes >= min_part * sizes.max(initial=0)
    if spared is not None:
        keep |= np.bincount(labels, spared) > 0
    return keep[labels], int(np.count_nonzero(~keep))


def whole_pieces(faces: np.ndarray, chosen: np.ndarray) -> np.ndarray:
    """Faces [F] bool of the pieces of which any face is chosen [F]: a closed mesh stays closed."""
    pieces = label_pieces(len(faces), face_adjacency(faces))
    return np.bincount(pieces, chosen)[pieces] > 0


def count_views(
    vertices: np.ndarray,
    faces: np.ndarray,
    cameras: PinholeCameras,
    enough: int,
    progress: Callable[[int, int], None] | None = None,
    others: Sequence[tuple[np.ndarray, np.ndarray]] = (),
) -> np.ndarray:
    """In how many cameras' images each vertex [V] shows, counted up to `enough`.

    A vertex shows if it projects into the image, faces the camera and the way there is free. One ray per vertex and
    camera, so no face is too small to be found; each vertex tries the cameras it faces best first, and stops early.

    Args:
        others: vertices and faces of other meshes, which may be in the way.
    """
    scene = raycaster(vertices, faces, *others)
    normals = vertex_normals(vertices, faces)
    starts = _off_the_surface(vertices, faces, normals)

    cosines = np.full((len(vertices), len(cameras)), -1.0, dtype=np.float32)
    for i, center in enumerate(cameras.centers):
        cosines[:, i] = np.where(cameras.in_frame(i, vertices), _cosines(vertices, normals, center), -1)

    views = np.zeros(len(vertices), dtype=np.int64)
    open_vertices = np.arange(len(vertices))
    for rank in range(len(cameras)):
        # The best camera left: most vertices need one or two, so that sorting all of them would be a waste.
        camera = cosines[open_vertices].argmax(1)
        facing = cosines[open_vertices, camera] > MIN_COSINE
        open_vertices, camera = open_vertices[facing], camera[facing]
        cosines[open_vertices, camera] = -1

        def hidden(part: slice, index: np.ndarray = open_vertices, camera: np.ndarray = camera) -> np.ndarray:
            return _hidden(scene, starts[index[part]], cameras.centers[camera[part]])

        parts = in_blocks(hidden, len(open_vertices), MAX_RAYS, RAYS)
        views[open_vertices[~np.concatenate([np.zeros(0, bool), *parts])]] += 1
        open_vertices = open_vertices[views[open_vertices] < enough]
        if progress is not None:
            progress(rank + 1, len(cameras))
        if not len(open_vertices):
            break
    return views


def _cosines(points: np.ndarray, normals: np.ndarray, center: np.ndarray) -> np.ndarray:
    """Of the angles [P] between normals and the ways to a camera centre."""
    to_camera = center - points
    cosines: np.ndarray = np.einsum("pi,pi->p", to_camera, normals) / np.linalg.norm(to_camera, axis=1)
    return cosines


def _off_the_surface(vertices: np.ndarray, faces: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Where rays from the vertices start [V, 3] float32, so that the faces around a vertex do not hide it."""
    return (vertices + 0.5 * median_edge(vertices, faces) * normals).astype(np.float32)


def _hidden(scene: Any, starts: np.ndarray, centers: np.ndarray) -> np.ndarray:
    """Which ways from `starts` [N, 3] to camera centres, [N, 3] or [3], are not free."""
    import open3d as o3d

    # Not normalised: the camera is at distance 1, whatever lies before it hides the vertex.
    rays = np.concatenate([starts, centers - starts], axis=1).astype(np.float32)
    hidden: np.ndarray = scene.test_occlusions(o3d.core.Tensor(rays), tnear=0.0, tfar=0.999).numpy()
    return hidden


def spread(faces: np.ndarray, num_vertices: int, chosen: np.ndarray, rings: int) -> np.ndarray:
    """The chosen faces [F] bool and those within `rings` steps over shared vertices."""
    for _ in range(rings):
        near = np.zeros(num_vertices, dtype=bool)
        near[faces[chosen]] = True
        chosen = near[faces].any(1)
    return chosen


def smooth_selection(faces: np.ndarray, num_vertices: int, chosen: np.ndarray, rings: int) -> np.ndarray:
    """A selection of faces [F] bool without notches narrower than `rings` faces: spread, then shrunk back."""
    grown = spread(faces, num_vertices, chosen, rings)
    return chosen | ~spread(faces, num_vertices, ~grown, rings)


def fill_small_gaps(vertices: np.ndarray, faces: np.ndarray, chosen: np.ndarray, max_area: float) -> np.ndarray:
    """The chosen faces [F] bool, and the regions of others that touch them and are no larger than `max_area`."""
    adjacency = face_adjacency(faces)
    labels = label_pieces(len(faces), adjacency[~chosen[adjacency].any(1)])
    region_area = np.bincount(labels, face_areas(vertices, faces))
    touches = np.zeros(len(region_area), dtype=bool)
    border = chosen[adjacency[:, 0]] != chosen[adjacency[:, 1]]
    touches[labels[adjacency[border]].ravel()] = True
    return chosen | (touches & (region_area <= max_area))[labels]


def widened(mask: np.ndarray, pixels: int) -> np.ndarray:
    """A mask [H, W] bool with a round border of so many pixels more."""
    import cv2

    brush = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1, 2 * pixels + 1))
    return cv2.dilate(mask.astype(np.uint8), brush) > 0


def outside_hull(
    vertices: np.ndarray,
    cameras: PinholeCameras,
    masks: Iterable[tuple[int, np.ndarray]],
    max_part: float,
    min_views: int = 2,
) -> np.ndarray:
    """Vertices [V] bool outside the visual hull of silhouettes.

    Args:
        vertices: [V, 3].
        masks: camera index and [H, W] bool mask, true on the object (widened by the caller's tolerance).
        max_part: a vertex is outside if it lies off the mask in more than this part of the images it falls into,
        min_views: and in at least this many of them: one bad mask must not cut the object.
    """
    seen = np.zeros(len(vertices), dtype=np.int64)
    off = np.zeros(len(vertices), dtype=np.int64)
    for index, mask in masks:
        framed, on_mask = cameras.on_mask(index, vertices, mask)
        seen += framed
        off += framed & ~on_mask
    return (off > max_part * seen) & (off >= np.minimum(min_views, np.maximum(seen, 1)))


def shown_on_masks(
    vertices: np.ndarray,
    faces: np.ndarray,
    cameras: PinholeCameras,
    masks: Iterable[tuple[int, np.ndarray]],
    chosen: np.ndarray,
    min_part: float,
    min_views: int = 2,
) -> np.ndarray:
    """Vertices [V] bool, among those chosen [V], that photos show on their masks, with nothing before them.

    Where the surface bulges it is off the masks of the photos that look along it, and still all that the others have
    of the object there: without it they would look through a hole.

    Args:
        masks: as of `outside_hull`.
        min_part: a vertex counts if it is on the mask in at least this part of the photos that see it,
        min_views: and in at least this many of them.
    """
    scene, normals, index = raycaster(vertices, faces), vertex_normals(vertices, faces), np.flatnonzero(chosen)
    starts, points, normals = _off_the_surface(vertices, faces, normals)[index], vertices[index], normals[index]
    seen, on = np.zeros((2, len(index)), dtype=np.int64)
    for camera, mask in masks:
        center = cameras.centers[camera]
        framed, on_mask = cameras.on_mask(camera, points, mask)
        facing = np.flatnonzero(framed & (_cosines(points, normals, center) > MIN_COSINE))
        free = facing[~_hidden(scene, starts[facing], center)]
        seen[free] += 1
        on[free] += on_mask[free]
    shown = np.zeros(len(vertices), dtype=bool)
    shown[index] = (on >= min_views) & (on >= min_part * seen)
    return shown
