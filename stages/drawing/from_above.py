"""A textured mesh seen from straight above, every point from over itself: true orthophoto and surface model."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from stages.artifacts import AtlasMesh
from stages.compiling import njit
from stages.drawing.rasterizing import rasterize

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
    # nearest is what has the greatest value: the height, from a level below all
    above = samples[:, 2] - samples[:, 2].min() + 1.0
    for rows, faces in _bands(samples[:, 1], mesh.faces, grid):
        count = rows.stop - rows.start
        xy = samples[:, :2] - [0, rows.start * SAMPLES]
        face_map, _ = rasterize(xy, above, faces, grid.width * SAMPLES, count * SAMPLES)
        _paint(face_map, xy, samples[:, 2], mesh.uvs, faces, texture, known, picture[:, rows], heights[rows])
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


@njit(nogil=True, cache=True)
def _paint(face_map, xy, levels, uvs, faces, texture, known, picture, heights):  # pragma: no cover - compiled
    """Fill picture [4, H, W] and heights [H, W] from the faces at the samples [H SAMPLES, W SAMPLES]."""
    total = np.zeros(3)
    weight = np.zeros(3)
    side, known_side = texture.shape[0], known.shape[0]
    for row in range(heights.shape[0]):
        for column in range(heights.shape[1]):
            total[:] = 0.0
            count = 0
            for k in range(SAMPLES * SAMPLES):
                y, x = row * SAMPLES + k // SAMPLES, column * SAMPLES + k % SAMPLES
                face = face_map[y, x]
                if face < 0:
                    continue
                a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
                px, py = x + 0.5, y + 0.5
                area = (xy[b, 0] - xy[a, 0]) * (xy[c, 1] - xy[a, 1]) - (xy[b, 1] - xy[a, 1]) * (xy[c, 0] - xy[a, 0])
                weight[0] = ((xy[b, 0] - px) * (xy[c, 1] - py) - (xy[b, 1] - py) * (xy[c, 0] - px)) / area
                weight[1] = ((xy[c, 0] - px) * (xy[a, 1] - py) - (xy[c, 1] - py) * (xy[a, 0] - px)) / area
                weight[2] = 1.0 - weight[0] - weight[1]
                u = weight[0] * uvs[a, 0] + weight[1] * uvs[b, 0] + weight[2] * uvs[c, 0]
                v = 1.0 - (weight[0] * uvs[a, 1] + weight[1] * uvs[b, 1] + weight[2] * uvs[c, 1])
                i = min(max(int(v * known_side), 0), known_side - 1)
                j = min(max(int(u * known_side), 0), known_side - 1)
                if not known[i, j]:
                    continue
                tx = min(max(u * side - 0.5, 0.0), side - 1.0)
                ty = min(max(v * side - 0.5, 0.0), side - 1.0)
                x0, y0 = int(tx), int(ty)
                x1, y1 = min(x0 + 1, side - 1), min(y0 + 1, side - 1)
                fx, fy = tx - x0, ty - y0
                for channel in range(3):
                    upper = texture[y0, x0, channel] * (1 - fx) + texture[y0, x1, channel] * fx
                    lower = texture[y1, x0, channel] * (1 - fx) + texture[y1, x1, channel] * fx
                    total[channel] += upper * (1 - fy) + lower * fy
                count += 1
                if k == SAMPLES * SAMPLES // 2:
                    heights[row, column] = weight[0] * levels[a] + weight[1] * levels[b] + weight[2] * levels[c]
                    picture[3, row, column] = 255
            if picture[3, row, column] > 0:
                for channel in range(3):
                    picture[channel, row, column] = np.uint8(total[channel] / count + 0.5)
