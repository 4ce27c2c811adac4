"""What one photo knows about the surface: which pixels see it, how far they can be trusted, their colour
bands.

Notation: w = 1 / depth, which is linear in the image over a plane; h = depth / focal length, a pixel's size
on the surface (scene units).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.artifacts.mesh import Mesh
from stages.compiling import njit
from stages.drawing.rasterizing import depth_map, projected
from stages.geometry.cameras import PinholeCameras
from stages.texture.observing import STEPS_UNSIGNED

# Two pixels lie on different surfaces where depth departs from a plane by more than this many pixel sizes.
EDGE_PIXELS = 3.0
# Closer to an edge than this (pixels) a photo may show the neighbouring surface: its weight is only `FAINT`,
# so that it is used where no other photo sees the texel better.
UNSAFE_PIXELS = 1.5
FADE_PIXELS = 8.0
FAINT = 0.01
# Width in pixels (of a Gaussian of the same variance) of the low-pass that splits a photo in two bands.
BAND_SIGMA = 8.0
_BAND_PASSES = 3
# Photos with more pixels on a texel's side than this are smoothed first, or their finest detail would alias.
FINER = 1.25


@dataclass(frozen=True)
class View:
    """One photo prepared for sampling, cut to the part that shows the mesh: [H, W] below.

    Attributes:
        matrix: [3, 4] its pixels (homogeneous) from scene points.
        center: [3] projection centre in the scene frame.
        focal: mean focal length in pixels.
        inverse_depth: [H, W] float32 of the mesh, 0 where the photo sees past it or something else before it.
        confidence: [H, W] uint8, 255 for full trust; 0 outside the mask.
        low: [H, W, 3] uint16, the photo low-passed along surfaces only, in `STEPS_UNSIGNED` a level.
        photo: [H, W, 3] uint8.
        original: the photo before it was smoothed for texels that cannot hold its detail.
    """

    matrix: np.ndarray
    center: np.ndarray
    focal: float
    inverse_depth: np.ndarray
    confidence: np.ndarray
    low: np.ndarray
    photo: np.ndarray
    original: np.ndarray

    @property
    def nbytes(self) -> int:
        """Memory that it takes."""
        images = (self.inverse_depth, self.confidence, self.low, self.photo)
        return sum(image.nbytes for image in images) + (self.original is not self.photo) * self.original.nbytes


def prepare_view(
    cameras: PinholeCameras,
    index: int,
    photo: np.ndarray,
    mask: np.ndarray | None,
    vertices: np.ndarray,
    faces: np.ndarray,
    texel_side: float = 0.0,
    others: Mesh | None = None,
) -> View:
    """Depth, trust and bands of photo `index`.

    Args:
        photo: [H, W, 3] uint8 RGB of the camera's size.
        mask: [H, W] bool, true on the object; None: all of it.
        vertices, faces: the mesh in the scene frame.
        texel_side: of the texture, in scene units; photos that are finer lose what it cannot hold.
        others: what else may be in the way.

    Raises:
        ValueError: the photo or mask is not of the camera's size.
    """
    import cv2

    width, height = (int(side) for side in cameras.sizes[index])
    if photo.shape != (height, width, 3):
        raise ValueError(f"photo {cameras.names[index]}: expected shape {(height, width, 3)}, got {photo.shape}")
    if mask is not None and mask.shape != (height, width):
        raise ValueError(f"mask of {cameras.names[index]}: expected shape {(height, width)}, got {mask.shape}")
    K = cameras.intrinsics[index]
    focal = float(np.sqrt(K[0, 0] * K[1, 1]))
    xy, inverse_depths = projected(cameras, index, vertices)
    left, top, right, bottom = window = _box(xy[inverse_depths > 0], width, height)
    _, inverse_depth = depth_map(cameras, index, vertices, faces, others, window)
    photo = photo[top:bottom, left:right].copy()  # a view would keep all of the photo in memory
    on_object = inverse_depth > 0
    if mask is not None:
        on_object &= mask[top:bottom, left:right]
    linked_left, linked_up = surface_links(np.where(on_object, inverse_depth, 0).astype(np.float32), focal)
    interior = np.zeros(on_object.shape, dtype=np.uint8)
    interior[1:-1, 1:-1] = linked_left[1:-1, 1:-1] & linked_left[1:-1, 2:] & linked_up[1:-1, 1:-1] & linked_up[2:, 1:-1]
    from_edge = cv2.distanceTransform(interior, cv2.DIST_L2, 3)
    confidence = np.clip((from_edge - UNSAFE_PIXELS) / FADE_PIXELS, FAINT, 1.0)
    confidence[~on_object] = 0
    original = photo
    pixels_on_texel = texel_side * focal * float(np.median(inverse_depth[on_object])) if on_object.any() else 0.0
    if pixels_on_texel > FINER:
        # A texel's square has the variance r^2 / 12 pixels^2, of which sampling brings 1 / 12.
        smooth = low_pass(photo, linked_left, linked_up, float(np.sqrt((pixels_on_texel**2 - 1) / 12)))
        photo = np.clip(smooth + 0.5, 0, 255).astype(np.uint8)
    low = low_pass(photo, linked_left, linked_up, BAND_SIGMA)
    low *= STEPS_UNSIGNED
    corner_from_photo = np.array([[1.0, 0, -left], [0, 1, -top], [0, 0, 1]])
    return View(
        matrix=corner_from_photo @ K @ cameras.extrinsics[index],
        center=cameras.centers[index],
        focal=focal,
        inverse_depth=inverse_depth,
        confidence=(255 * confidence + 0.5).astype(np.uint8),
        low=np.rint(low, out=low).astype(np.uint16),
        photo=photo,
        original=original,
    )


def _box(xy: np.ndarray, width: int, height: int) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of the pixels that points [P, 2] fall on, at least two each way."""
    low, high = (xy.min(0), xy.max(0)) if len(xy) else (np.zeros(2), np.zeros(2))
    left, top = (int(np.clip(np.floor(at), 0, side - 2)) for at, side in zip(low, (width, height), strict=True))
    right, bottom = (int(np.clip(np.ceil(at), 2, side)) for at, side in zip(high, (width, height), strict=True))
    return left, top, max(right, left + 2), max(bottom, top + 2)


@njit(nogil=True, cache=True)
def _links(w, focal, out):  # pragma: no cover - compiled
    """out[y, x]: pixels x - 1 and x of a row are on one surface."""
    height, width = w.shape
    for y in range(height):
        for x in range(1, width):
            here, before = w[y, x], w[y, x - 1]
            if here <= 0 or before <= 0:
                continue
            jump = here - before
            # The step against the slope on either side: large on both sides of an edge only.
            bend = abs(jump)
            if x >= 2 and w[y, x - 2] > 0:
                bend = min(bend, abs(jump - (before - w[y, x - 2])))
            if x + 1 < width and w[y, x + 1] > 0:
                bend = min(bend, abs(jump - (w[y, x + 1] - here)))
            # dz = dw / w², against h = 1 / (w focal)
            out[y, x] = bend * focal <= EDGE_PIXELS * min(here, before)


def surface_links(inverse_depth: np.ndarray, focal: float) -> tuple[np.ndarray, np.ndarray]:
    """Which neighbouring pixels lie on one surface.

    Args:
        inverse_depth: [H, W] float32, 0 where there is no surface.
        focal: pixels.

    Returns:
        [H, W] bool: linked to the pixel on the left; [H, W] bool: linked to the pixel above. Slanted planes
        are linked, steps of more than `EDGE_PIXELS` pixel sizes are not.
    """
    left = np.zeros(inverse_depth.shape, dtype=np.bool_)
    _links(np.ascontiguousarray(inverse_depth), focal, left)
    up = np.zeros(inverse_depth.shape[::-1], dtype=np.bool_)
    _links(np.ascontiguousarray(inverse_depth.T), focal, up)
    return left, np.ascontiguousarray(up.T)


@njit(nogil=True, cache=True)
def _smooth_rows(image, linked, feedback):  # pragma: no cover - compiled
    height, width, channels = image.shape
    for y in range(height):
        for x in range(1, width):
            if linked[y, x]:
                for c in range(channels):
                    image[y, x, c] += feedback * (image[y, x - 1, c] - image[y, x, c])
        for x in range(width - 2, -1, -1):
            if linked[y, x + 1]:
                for c in range(channels):
                    image[y, x, c] += feedback * (image[y, x + 1, c] - image[y, x, c])


@njit(nogil=True, cache=True)
def _smooth_columns(image, linked, feedback):  # pragma: no cover - compiled
    height, width, channels = image.shape
    for y in range(1, height):
        for x in range(width):
            if linked[y, x]:
                for c in range(channels):
                    image[y, x, c] += feedback * (image[y - 1, x, c] - image[y, x, c])
    for y in range(height - 2, -1, -1):
        for x in range(width):
            if linked[y + 1, x]:
                for c in range(channels):
                    image[y, x, c] += feedback * (image[y + 1, x, c] - image[y, x, c])


def low_pass(photo: np.ndarray, linked_left: np.ndarray, linked_up: np.ndarray, sigma: float) -> np.ndarray:
    """Smooth a photo along surfaces, never across depth edges, so that no background bleeds into the low
    band.

    The recursive filter of Gastal & Oliveira, "Domain Transform for Edge-Aware Image and Video Processing"
    (2011), eq. 14 and 21, with depth edges as the only stops.

    Args:
        photo: [H, W, 3] uint8.
        linked_left, linked_up: [H, W] bool, see `surface_links`.
        sigma: pixels.

    Returns:
        [H, W, 3] float32, 0..255.
    """
    image = photo.astype(np.float32)
    for i in range(_BAND_PASSES):
        sigma_i = sigma * np.sqrt(3) * 2.0 ** (_BAND_PASSES - i - 1) / np.sqrt(4.0**_BAND_PASSES - 1)
        feedback = np.float32(np.exp(-np.sqrt(2) / sigma_i))
        _smooth_rows(image, linked_left, feedback)
        _smooth_columns(image, linked_up, feedback)
    return image
