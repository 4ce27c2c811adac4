"""A textured mesh seen from straight above, every point from over itself: true orthophoto and surface model."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from stages.artifacts import AtlasMesh
from stages.drawing.rasterizing import NO_FACE, corner_weights, rasterize
from stages.drawing.rendering import sample_texture

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Float32, Shaped, UInt8

# Samples along a side of a pixel, one of them at its centre: the colour is their mean, the height is the centre's.
SAMPLES = 3
MOST_SAMPLES = 1 << 24  # at once
MOST_PIXELS = 1 << 27  # of a picture: twice what the largest texture has


@dataclass(frozen=True)
class GroundGrid:
    """Square pixels on the ground; rows go south.

    Attributes:
        west, north: of the first pixel's outer corner.
        resolution: side of a pixel.
    """

    west: float
    north: float
    resolution: float
    width: int
    height: int


def ground_grid(places: Float[np.ndarray, "n 2"], resolution: float) -> GroundGrid:
    """The pixels that hold all places (x east, y north).

    Their lines lie at whole multiples of the resolution: those of neighbours at the same resolution fit together.
    """
    lowest = np.floor(places.min(0) / resolution)
    width, height = (np.floor(places.max(0) / resolution) - lowest + 1).astype(int).tolist()
    return GroundGrid(
        float(lowest[0] * resolution), float((lowest[1] + height) * resolution), resolution, width, height
    )


def finest_resolution(places: Float[np.ndarray, "n 2"]) -> float:
    """The side of a pixel at which a picture of these places has `MOST_PIXELS`."""
    return float(np.sqrt(np.prod(np.ptp(places, axis=0)) / MOST_PIXELS))


def two_digits(length: float) -> float:
    """The next longer length that has two digits."""
    unit = 10.0 ** (np.floor(np.log10(length)) - 1)
    return float(f"{np.ceil(round(length / unit, 6)) * unit:.2g}")


def seen_from_above(
    mesh: AtlasMesh,
    texture: UInt8[np.ndarray, "s s 3"],
    known: Bool[np.ndarray, "t t"],
    grid: GroundGrid,
) -> tuple[UInt8[np.ndarray, "4 h w"], Float32[np.ndarray, "h w"]]:
    """Colours with alpha (0 or 255), and heights (NaN: none) of the highest surface at each pixel.

    Args:
        mesh: its vertices float64: east, north, up.
        texture: row 0 at v = 1.
        known: which texels are to be shown, over the same square; what is not known has neither colour nor height.
    """
    picture = np.zeros((4, grid.height, grid.width), np.uint8)
    heights = np.full((grid.height, grid.width), np.nan, np.float32)
    samples = mesh.vertices - [grid.west, grid.north, 0.0]
    samples[:, :2] *= np.array([1, -1]) * SAMPLES / grid.resolution
    for rows, faces in _bands(samples[:, 1], mesh.faces, grid):
        hit, colors, levels = _sampled(samples, faces, mesh.uvs, texture, known, rows, grid.width)
        count = hit.sum((1, 3))
        mean = np.where(hit[..., None], colors, 0).sum((1, 3)) / np.maximum(count, 1)[..., None]
        middle = SAMPLES // 2
        shown = hit[:, middle, :, middle]
        picture[:3, rows][:, shown] = np.clip(mean[shown] + 0.5, 0, 255).astype(np.uint8).T
        picture[3, rows][shown] = 255
        heights[rows][shown] = levels[:, middle, :, middle][shown]
    return picture, heights


def _bands(
    down: Float[np.ndarray, " v"], faces: Shaped[np.ndarray, "f 3"], grid: GroundGrid
) -> Iterator[tuple[slice, Shaped[np.ndarray, "g 3"]]]:
    """Rows of pixels, and the faces that reach into them; `down` is in samples."""
    step = max(MOST_SAMPLES // (grid.width * SAMPLES**2), 1)
    first, last = down[faces].min(1), down[faces].max(1)
    for start in range(0, grid.height, step):
        rows = slice(start, min(start + step, grid.height))
        yield rows, faces[(last >= rows.start * SAMPLES) & (first <= rows.stop * SAMPLES)]


def _sampled(
    samples: Float[np.ndarray, "v 3"],
    faces: Shaped[np.ndarray, "f 3"],
    uvs: Float[np.ndarray, "v 2"],
    texture: UInt8[np.ndarray, "s s 3"],
    known: Bool[np.ndarray, "t t"],
    rows: slice,
    columns: int,
) -> tuple[Bool[np.ndarray, "r k c k"], Float32[np.ndarray, "r k c k 3"], Float32[np.ndarray, "r k c k"]]:
    """Whether something known is there, its colour and its height, at the samples of some rows of pixels."""
    count, width = rows.stop - rows.start, columns * SAMPLES
    height = count * SAMPLES
    xy = samples[:, :2] - [0, rows.start * SAMPLES]
    # nearest is what has the greatest value: the height, from a level below all
    above = samples[:, 2] - samples[:, 2].min() + 1.0
    face_map = rasterize(xy, above, faces, width, height)[0].ravel()
    index = np.flatnonzero(face_map != NO_FACE)
    centers = np.stack([index % width, index // width], 1) + 0.5
    weights = corner_weights(xy, np.ones(len(xy)), faces, face_map[index], centers)
    corners = faces[face_map[index]]
    places = np.einsum("pc,pcd->pd", weights, uvs[corners])
    side = len(known)
    column, row = (np.clip(np.array([places[:, 0], 1 - places[:, 1]]) * side, 0, side - 1)).astype(np.int64)
    hit, levels = np.zeros(height * width, bool), np.zeros(height * width, np.float32)
    colors = np.zeros((height * width, 3), np.float32)
    hit[index] = known[row, column]
    colors[index] = sample_texture(texture, places)
    levels[index] = (weights * samples[corners, 2]).sum(1)
    shape = (count, SAMPLES, columns, SAMPLES)
    return hit.reshape(shape), colors.reshape(*shape, 3), levels.reshape(shape)
