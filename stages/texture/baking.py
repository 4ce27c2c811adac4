"""Photos to texture: visibility, gains, a robust mean in two bands, and what no photo saw.

1. Each photo gets a depth map of the mesh, a trust map that fades near depth edges, and two bands (`photo_views`).
2. A sample of texels, seen by several photos, gives the gains (`gains`) and tells blurred photos (`sharpness`).
3. Each texel collects its best views (`observing`): low band = robust mean of many, high band = robust mean of those
   that resolve the most. Weights change smoothly over the surface and fade out before a view leaves the set, so
   there are no borders between photos, and no seams to level.
4. Texels no photo saw take the colour field's answer, shifted to meet the photos (`filling`); then the
   charts are padded (`padding`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import IntEnum
from functools import partial

import numpy as np

from stages.artifacts import AtlasMesh
from stages.artifacts.mesh import Mesh
from stages.blocks import in_blocks
from stages.drawing.rasterizing import Texels, surface_points
from stages.geometry.cameras import PinholeCameras
from stages.texture.filling import face_neighbors, harmonic_offsets, vertex_means
from stages.texture.gains import in_gauge_of, solve_gains
from stages.texture.observing import STEPS_UNSIGNED, blend_texels, gather_texels, sample_points
from stages.texture.padding import pad_charts
from stages.texture.photo_views import View
from stages.texture.prepared_views import LoadPhoto, PreparedViews
from stages.texture.sharpness import BLURRED, sharpness_of_photos

# (points [P, 3], normals [P, 3], unit view directions [P, 3] from camera to point) -> [P, 3] sRGB in [0, 1].
ColorField = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]
Listener = Callable[[float, float, str], None]
# (photo index, the photo made ready, its gains [3]).
Visitor = Callable[[int, View, np.ndarray], None]

# Texels that take part in comparing photos.
SAMPLES = 20_000
# Texels blended at a time: the buffers take 16 bytes a texel and kept view. Each band goes over the photos again, so
# bands are small only where all photos stay in memory.
BAND_BYTES = 1 << 30
SMALL_BAND_BYTES = 1 << 28
# Texels handed to a thread at a time.
_CHUNK = 250_000


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
    texels: Texels,
    cameras: PinholeCameras,
    load_photo: LoadPhoto,
    color_field: ColorField,
    views: int = 24,
    detail: bool = True,
    gain: bool = True,
    diffuse: bool = False,
    robust_sigma: float = 6.0,
    workers: int = 1,
    listener: Listener | None = None,
    visit: Visitor | None = None,
    rough_gains: np.ndarray | None = None,
    others: Mesh | None = None,
) -> Baked:
    """Bake photos into the texture of an atlas.

    Args:
        atlas: mesh with UVs, scene frame.
        texels: the atlas rasterised, see `rasterizing.rasterize_atlas`.
        cameras: N posed photos.
        load_photo: gives photo and mask of a camera.
        color_field: answers where no photo saw the surface.
        views: photos that make a texel, the best ones.
        detail: add the high band.
        gain: compensate gains.
        diffuse: count views that are brighter than the others less: see `observing.blend_texels`.
        robust_sigma: colours further than this many robust standard deviations are rejected.
        workers: threads.
        listener: told (done, total, note).
        visit: shown each photo once, in order, so that what else is asked of photos need not make them ready again.
        rough_gains: [N, 3] in a larger scene that this is a part of, NaN where not known: they set the gauge, see
            `gains.in_gauge_of`.
        others: in the scene frame, what else may be in the way of photos. It gets no texture.

    Raises:
        ValueError: the atlas covers no texel, or a photo is not of its camera's size.
    """
    size, num_texels, num_views = texels.size, len(texels), len(cameras)
    if not num_texels:
        raise ValueError(f"expected charts covering texels of a {size}² texture, got none")
    colors = np.zeros((num_texels, 3), dtype=np.uint8)
    seen_by = np.zeros(num_texels, dtype=np.uint16)
    views = min(views, num_views)
    done = 0.0

    def tell(note: str, photos: float = 1.0) -> None:
        nonlocal done
        done += photos
        if listener is not None:
            listener(done, 2 * num_views + 1, note)

    with ThreadPoolExecutor(max_workers=max(1, workers)) as pool:
        views_of = PreparedViews(atlas, num_texels, cameras, load_photo, others)
        gains, sharpness = compare_photos(atlas, texels, views_of.in_order(pool, workers), num_views, tell)
        if not gain:
            gains = np.ones((num_views, 3))
        elif rough_gains is not None:
            gains = in_gauge_of(gains, rough_gains)
        room = SMALL_BAND_BYTES if len(views_of.kept) == num_views else BAND_BYTES
        blend = partial(blend_texels, detail=detail, robust_sigma=robust_sigma, diffuse=diffuse)
        unvisited = set(range(num_views)) if visit is not None else set()

        def prepared() -> Iterator[View]:
            for index, view in enumerate(views_of.in_order(pool, workers)):
                if visit is not None and index in unvisited:
                    visit(index, view, gains[index])
                    unvisited.remove(index)
                yield view

        def blend_band(band: slice) -> None:
            share = (band.stop - band.start) / num_texels
            colors[band], seen_by[band] = _blend(
                pool, *surface_points(atlas, texels.face_ids[band], texels.corner[band]), gains, sharpness,
                prepared(), views, blend, partial(tell, "blending photos", share),
            )  # fmt: skip

        in_blocks(blend_band, num_texels, max(room // (16 * (views + 1)), _CHUNK), "texels blended")
        views_of.kept.clear()

    seen = seen_by > 0
    _fill_unseen(colors, seen, atlas, texels, color_field)
    image, inside = texels.paint(colors)
    filled, padded = pad_charts(image, inside)
    origin = np.where(seen, Provenance.PHOTO, Provenance.FIELD).astype(np.uint8)
    provenance = texels.paint(origin[:, None])[0][..., 0]
    provenance[padded] = Provenance.PADDING
    tell("done")
    return Baked(
        base_color=filled,
        provenance=provenance,
        gains=gains,
        numbers={
            "texture_size": size,
            "texels": num_texels,
            "coverage": round(num_texels / size**2, 4),
            "seen_share": round(float(seen.mean()), 4),
            "filled_share": round(float(1 - seen.mean()), 4),
            "mean_views": round(float(seen_by[seen].mean()), 2) if seen.any() else 0.0,
            "gain_min": round(float(gains.min(initial=1.0)), 4),
            "gain_max": round(float(gains.max(initial=1.0)), 4),
            "blurred_photos": int((sharpness < BLURRED).sum()),
        },
    )


def compare_photos(
    atlas: AtlasMesh,
    texels: Texels,
    prepared: Iterator[View],
    num_views: int,
    tell: Callable[[str], None] = lambda note: None,
) -> tuple[np.ndarray, np.ndarray]:
    """Gains [N, 3] and sharpness [N] of the photos, from a sample of the texels."""
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(texels), size=min(SAMPLES, len(texels)), replace=False)
    points, normals = surface_points(atlas, texels.face_ids[chosen], texels.corner[chosen])
    weights = np.zeros((num_views, len(chosen)), dtype=np.float32)
    colors = np.zeros((num_views, len(chosen), 3), dtype=np.float32)
    lows = np.zeros_like(colors)
    for index, view in enumerate(prepared):
        for image, answer in ((view.low, lows), (view.photo, colors)):
            sample_points(
                points, normals, view.matrix, view.center, view.focal, view.inverse_depth, view.confidence, image,
                weights[index], answer[index],
            )  # fmt: skip
        tell("comparing photos")
    # From the photos themselves: their low bands mix neighbouring colours, more so in slanted views.
    gains = solve_gains(colors.transpose(1, 0, 2), weights.T)
    return gains, sharpness_of_photos((colors - lows / STEPS_UNSIGNED).mean(2).T, weights.T)


def _blend(
    pool: ThreadPoolExecutor,
    points: np.ndarray,
    normals: np.ndarray,
    gains: np.ndarray,
    sharpness: np.ndarray,
    prepared: Iterator[View],
    keep: int,
    blend: Callable[..., None],
    tell: Callable[[], None],
) -> tuple[np.ndarray, np.ndarray]:
    """Colors [T, 3] uint8 and the number of photos that see each texel [T] uint16."""
    count = len(points)
    colors, seen_by = np.zeros((count, 3), dtype=np.uint8), np.zeros(count, dtype=np.uint16)
    # One view more than is blended: the others' weights are measured against it.
    best_weights = np.zeros((count, keep + 1), dtype=np.float32)
    best_lows = np.zeros((count, keep + 1, 3), dtype=np.uint16)
    best_highs = np.zeros((count, keep + 1, 3), dtype=np.int16)
    chunks = [slice(start, min(start + _CHUNK, count)) for start in range(0, count, _CHUNK)]

    def offer(view: View, index: int, part: slice) -> None:
        gather_texels(
            points[part], normals[part], view.matrix, view.center, view.focal, view.inverse_depth, view.confidence,
            view.low, view.photo, gains[index], sharpness[index],
            best_weights[part], best_lows[part], best_highs[part], seen_by[part],
        )  # fmt: skip

    for index, view in enumerate(prepared):
        list(pool.map(partial(offer, view, index), chunks))
        tell()

    def finish(part: slice) -> None:
        blend(best_weights[part], best_lows[part], best_highs[part], colors=colors[part])

    list(pool.map(finish, chunks))
    return colors, seen_by


def _fill_unseen(
    colors: np.ndarray, seen: np.ndarray, atlas: AtlasMesh, texels: Texels, color_field: ColorField
) -> None:
    """Give unseen texels the field's colour plus the offset that photos have from the field nearby. In
    place."""
    unseen = np.flatnonzero(~seen)
    if not len(unseen):
        return
    num_faces = len(atlas.faces)
    # A face's known offset: photo minus field at one of its seen texels would be noisy, so compare face
    # means.
    count = np.bincount(texels.face_ids, minlength=num_faces)
    faces_seen = texels.face_ids[seen]
    count_seen = np.bincount(faces_seen, minlength=num_faces)
    known = (count_seen > 0) & (2 * count_seen >= count)
    offsets = np.zeros((num_faces, 3))
    if known.any():
        sums = [np.bincount(faces_seen, colors[seen, c], minlength=num_faces) for c in range(3)]
        photo_means = np.stack(sums, 1)[known] / count_seen[known, None]
        ids = np.flatnonzero(known)
        centers, center_normals = surface_points(atlas, ids, np.full((len(ids), 3), 1 / 3, dtype=np.float32))
        offsets[ids] = photo_means - 255.0 * color_field(centers, center_normals, -center_normals)
    spread = harmonic_offsets(known, offsets, face_neighbors(atlas.vertices, atlas.faces))
    at_vertices = vertex_means(spread, atlas.vertices, atlas.faces)

    def fill(rows: slice) -> None:
        part = unseen[rows]
        faces, corner = texels.face_ids[part], texels.corner[part]
        points, normals = surface_points(atlas, faces, corner)
        answer = 255.0 * color_field(points, normals, -normals)
        for k in range(3):
            answer = answer + corner[:, k, None] * at_vertices[atlas.faces[faces, k]]
        colors[part] = np.clip(answer + 0.5, 0, 255).astype(np.uint8)

    in_blocks(fill, len(unseen), _CHUNK, "texels that no photo saw")
