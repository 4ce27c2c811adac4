"""Photos to texture: visibility, gains, a robust low band, one photo's high band, and what no photo saw.

1. Each photo gets a depth map of the mesh, a trust map that fades near depth edges, and two bands (`views`).
2. Face centres and sample texels seen by several photos give the gains (`gains`) and each face's label
   (`labels`).
3. Each texel collects its best views (`observing`): low band = robust mean of them, high band = that of the
   face's label. Only the low band could show a seam, and it is the one that is averaged.
4. Texels no photo saw take the colour field's answer, shifted to meet the photos (`filling`); then the
   charts are padded (`padding`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from enum import IntEnum
from functools import partial

import numpy as np

from stages.artifacts import AtlasMesh
from stages.geometry.cameras import PinholeCameras
from stages.meshing.filling import harmonic_offsets, vertex_means
from stages.meshing.gains import solve_gains
from stages.meshing.labels import choose_labels, face_neighbors
from stages.meshing.observing import blend_texels, gather_texels, sample_points
from stages.meshing.padding import pad_charts
from stages.meshing.rasterizing import rasterize_atlas, surface_points
from stages.meshing.views import View, prepare_view

# (photo index) -> [H, W, 3] uint8 RGB and [H, W] bool mask or None.
LoadPhoto = Callable[[int], tuple[np.ndarray, np.ndarray | None]]
# (points [P, 3], normals [P, 3], unit view directions [P, 3] from camera to point) -> [P, 3] sRGB in [0, 1].
ColorField = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
Listener = Callable[[float, float, str], None]

# Extra texels that take part in solving the gains.
GAIN_SAMPLES = 20_000
# A photo whose colour lies this far (levels) off the other photos' pays as much as one with 1/e of the best
# weight.
CONSISTENCY_LEVELS = 12.0
# Price of a border between labels, in the same unit.
SMOOTHNESS = 0.7
# See `observing.blend_texels`.
GHOST_LEVELS = 25.0
# Texels handed to a thread at a time.
_CHUNK = 250_000
# Faces whose labels are priced at a time.
_FACES = 10_000
# Photos made ready ahead of use: each takes 23 bytes a pixel.
_MAX_AHEAD = 8


class Provenance(IntEnum):
    """Where a texel's colour came from; the values make a readable grey image."""

    OUTSIDE = 0
    PADDING = 64
    FIELD = 128
    PHOTO = 255


@dataclass(frozen=True)
class Baked:
    """A texture and what is known about it.

    Attributes:
        base_color: [S, S, 3] uint8 sRGB, row 0 at v = 1.
        provenance: [S, S] uint8 of `Provenance`.
        gains: [N, 3] factor applied to each photo's channels.
        numbers: counts and shares for people.
    """

    base_color: np.ndarray
    provenance: np.ndarray
    gains: np.ndarray
    numbers: dict[str, float | int]


def bake_texture(
    atlas: AtlasMesh,
    cameras: PinholeCameras,
    load_photo: LoadPhoto,
    color_field: ColorField,
    texture_size: int,
    views: int = 8,
    detail: bool = True,
    gain: bool = True,
    robust_sigma: float = 2.5,
    workers: int = 1,
    listener: Listener | None = None,
) -> Baked:
    """Bake photos into the texture of an atlas.

    Args:
        atlas: mesh with UVs, scene frame.
        cameras: N posed photos.
        load_photo: gives photo and mask of a camera.
        color_field: answers where no photo saw the surface.
        texture_size: side in texels.
        views: photos in the low band of a texel.
        detail: add the high band.
        gain: compensate gains.
        robust_sigma: colours further than this many robust standard deviations are rejected.
        workers: threads.
        listener: told (done, total, note).

    Raises:
        ValueError: the atlas covers no texel, or a photo is not of its camera's size.
    """
    tell = listener or (lambda done, total, note: None)
    texels, face_ids, corner = rasterize_atlas(atlas.uvs, atlas.faces, texture_size)
    if not len(texels):
        raise ValueError(f"expected charts covering texels of a {texture_size}² texture, got none")
    points, normals = surface_points(atlas, face_ids, corner)
    num_views = len(cameras)

    with ThreadPoolExecutor(max_workers=max(1, workers)) as pool:
        prepare = partial(_prepare, atlas, cameras, load_photo)
        labels = np.full(len(atlas.faces), -1, dtype=np.int32)
        gains = np.ones((num_views, 3))
        if num_views and (detail or gain):
            gains, labels = _gains_and_labels(
                atlas, points, normals, num_views, _prefetch(pool, prepare, num_views, workers), gain, tell
            )
        texel_labels = labels[face_ids] if detail else np.full(len(face_ids), -1, dtype=np.int32)
        colors, seen_by = _blend(
            pool, points, normals, texel_labels, gains, detail,
            _prefetch(pool, prepare, num_views, workers), num_views, views, robust_sigma, tell,
        )  # fmt: skip

    seen = seen_by > 0
    _fill_unseen(colors, seen, atlas, face_ids, corner, points, normals, color_field)
    image = np.zeros((texture_size * texture_size, 3), dtype=np.uint8)
    image[texels] = np.clip(colors + 0.5, 0, 255).astype(np.uint8)
    provenance = np.full(texture_size * texture_size, Provenance.OUTSIDE, dtype=np.uint8)
    provenance[texels] = np.where(seen, Provenance.PHOTO, Provenance.FIELD)
    square = (texture_size, texture_size)
    filled, padded = pad_charts(image.reshape(*square, 3), (provenance != Provenance.OUTSIDE).reshape(square))
    provenance = provenance.reshape(square)
    provenance[padded] = Provenance.PADDING
    tell(2 * num_views, 2 * num_views, "done")
    return Baked(
        base_color=filled,
        provenance=provenance,
        gains=gains,
        numbers={
            "texture_size": texture_size,
            "texels": len(texels),
            "coverage": round(len(texels) / texture_size**2, 4),
            "seen_share": round(float(seen.mean()), 4),
            "filled_share": round(float(1 - seen.mean()), 4),
            "mean_views": round(float(seen_by[seen].mean()), 2) if seen.any() else 0.0,
            "gain_min": round(float(gains.min(initial=1.0)), 4),
            "gain_max": round(float(gains.max(initial=1.0)), 4),
        },
    )


def _prepare(atlas: AtlasMesh, cameras: PinholeCameras, load_photo: LoadPhoto, index: int) -> View:
    photo, mask = load_photo(index)
    return prepare_view(cameras, index, photo, mask, atlas.vertices, atlas.faces)


def _prefetch(pool: ThreadPoolExecutor, prepare: Callable[[int], View], count: int, ahead: int) -> Iterator[View]:
    """Views 0..count-1 in order, `ahead` of them (at most `_MAX_AHEAD`) being made in the background."""
    waiting: list[Future[View]] = []
    ahead = min(ahead, _MAX_AHEAD)
    submitted = 0
    for _ in range(count):
        while submitted < count and len(waiting) <= ahead:
            waiting.append(pool.submit(prepare, submitted))
            submitted += 1
        yield waiting.pop(0).result()


def _gains_and_labels(
    atlas: AtlasMesh,
    points: np.ndarray,
    normals: np.ndarray,
    num_views: int,
    prepared: Iterator[View],
    gain: bool,
    tell: Listener,
) -> tuple[np.ndarray, np.ndarray]:
    """Gains [N, 3] and the label of each face [F], from face centres and a sample of the texels."""
    num_faces = len(atlas.faces)
    thirds = np.full((num_faces, 3), 1 / 3, dtype=np.float32)
    centers, center_normals = surface_points(atlas, np.arange(num_faces), thirds)
    rng = np.random.default_rng(0)
    extra = rng.choice(len(points), size=min(GAIN_SAMPLES, len(points)), replace=False)
    samples = np.concatenate([centers, points[extra]])
    sample_normals = np.concatenate([center_normals, normals[extra]])
    weights = np.zeros((num_views, len(samples)), dtype=np.float32)
    colors = np.zeros((num_views, len(samples), 3), dtype=np.float32)
    for index, view in enumerate(prepared):
        for part, image in ((slice(None, num_faces), view.low), (slice(num_faces, None), view.photo)):
            sample_points(
                samples[part], sample_normals[part], view.matrix, view.center, view.focal,
                view.inverse_depth, view.confidence, image, weights[index, part], colors[index, part],
            )  # fmt: skip
        tell(index + 1, 2 * num_views, "comparing photos")
    gains = np.ones((num_views, 3))
    if gain:
        # From the photos themselves: their low bands mix neighbouring colours, more so in slanted views.
        gains = solve_gains(colors[:, num_faces:].transpose(1, 0, 2), weights[:, num_faces:].T)
    costs = np.empty((num_faces, num_views), dtype=np.float32)
    # A part of the faces at a time: the steps on the way need several times the memory of the colours.
    for start in range(0, num_faces, _FACES):
        part = slice(start, min(start + _FACES, num_faces))
        part_colors = colors[:, part].transpose(1, 0, 2) * gains.astype(np.float32)
        costs[part] = label_costs(np.ascontiguousarray(weights[:, part].T), part_colors)
    del colors, weights
    labels = choose_labels(costs, face_neighbors(atlas.vertices, atlas.faces), SMOOTHNESS)
    return gains, labels


def label_costs(weights: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """What it costs to take a face's detail from a photo.

    -log(weight / best weight) + (distance in colour from the face's median over photos /
    CONSISTENCY_LEVELS)², the latter at most 9.

    Args:
        weights: [F, N], 0 where not seen.
        colors: [F, N, 3] 0..255, gains applied.

    Returns:
        [F, N] float32, inf where not seen.
    """
    seen = weights > 0
    best = weights.max(1, keepdims=True, initial=0)
    cost = np.full(weights.shape, np.inf, dtype=np.float32)
    hidden = np.where(seen[..., None], colors, np.nan).astype(np.float32)
    # nanmedian by sorting (numpy's own is far slower): nan sorts last, the middle of the seen ones is the
    # median.
    ordered = np.sort(hidden, axis=1)
    middle = np.maximum(seen.sum(1) - 1, 0) // 2
    median = np.take_along_axis(ordered, middle[:, None, None], axis=1)
    off = np.abs(hidden - median).max(2)[seen] / CONSISTENCY_LEVELS
    ratio = (weights / np.maximum(best, 1e-20))[seen]
    cost[seen] = np.minimum(off * off, 9.0) - np.log(np.maximum(ratio, 1e-20))
    return cost


def _blend(
    pool: ThreadPoolExecutor,
    points: np.ndarray,
    normals: np.ndarray,
    labels: np.ndarray,
    gains: np.ndarray,
    detail: bool,
    prepared: Iterator[View],
    num_views: int,
    keep: int,
    robust_sigma: float,
    tell: Listener,
) -> tuple[np.ndarray, np.ndarray]:
    """Colours [T, 3] float32 (0..255) and the number of photos that see each texel [T]."""
    count = len(points)
    # One view more than is blended: the others' weights are measured against it.
    best_weights = np.zeros((count, keep + 1), dtype=np.float32)
    best_lows = np.zeros((count, keep + 1, 3), dtype=np.uint16)
    seen_by = np.zeros(count, dtype=np.uint16)
    detail_rank = np.zeros(count, dtype=np.float32)
    details = np.zeros((count, 3), dtype=np.int16)
    detail_lows = np.zeros((count, 3), dtype=np.uint16)
    chunks = [slice(start, min(start + _CHUNK, count)) for start in range(0, count, _CHUNK)]

    def offer(view: View, index: int, part: slice) -> None:
        gather_texels(
            points[part], normals[part], labels[part] == index, view.matrix, view.center, view.focal,
            view.inverse_depth, view.confidence, view.low, view.photo, gains[index],
            best_weights[part], best_lows[part], seen_by[part],
            detail_rank[part], details[part], detail_lows[part],
        )  # fmt: skip

    for index, view in enumerate(prepared):
        list(pool.map(partial(offer, view, index), chunks))
        tell(num_views + index + 1, 2 * num_views, "blending photos")
    if not detail:
        details[:] = 0
    colors = np.zeros((count, 3), dtype=np.float32)

    def finish(part: slice) -> None:
        blend_texels(
            best_weights[part], best_lows[part], details[part], detail_lows[part],
            robust_sigma, GHOST_LEVELS, colors[part],
        )  # fmt: skip

    list(pool.map(finish, chunks))
    return colors, seen_by


def _fill_unseen(
    colors: np.ndarray,
    seen: np.ndarray,
    atlas: AtlasMesh,
    face_ids: np.ndarray,
    corner: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    color_field: ColorField,
) -> None:
    """Give unseen texels the field's colour plus the offset that photos have from the field nearby. In
    place."""
    unseen = np.flatnonzero(~seen)
    if not len(unseen):
        return
    num_faces = len(atlas.faces)
    # A face's known offset: photo minus field at one of its seen texels would be noisy, so compare face
    # means.
    count = np.bincount(face_ids, minlength=num_faces)
    count_seen = np.bincount(face_ids[seen], minlength=num_faces)
    known = (count_seen > 0) & (2 * count_seen >= count)
    offsets = np.zeros((num_faces, 3))
    if known.any():
        sums = [np.bincount(face_ids[seen], colors[seen, c], minlength=num_faces) for c in range(3)]
        photo_means = np.stack(sums, 1)[known] / count_seen[known, None]
        ids = np.flatnonzero(known)
        centers, center_normals = surface_points(atlas, ids, np.full((len(ids), 3), 1 / 3, dtype=np.float32))
        offsets[ids] = photo_means - 255.0 * color_field(centers, center_normals, -center_normals)
    spread = harmonic_offsets(known, offsets, face_neighbors(atlas.vertices, atlas.faces))
    at_vertices = vertex_means(spread, atlas.vertices, atlas.faces)
    answer = 255.0 * color_field(points[unseen], normals[unseen], -normals[unseen])
    for k in range(3):
        answer = answer + corner[unseen, k, None] * at_vertices[atlas.faces[face_ids[unseen], k]]
    colors[unseen] = np.clip(answer, 0, 255)
