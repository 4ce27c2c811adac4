"""What Gaussians should look like from where a photo was taken, as far as the photo tells.

Inside the object's outline that is the photo. Beyond the mesh by more than a margin, nothing should be drawn: the
background is no part of the model. Between the two, photos do not say which of both a pixel shows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stages.artifacts import AtlasMesh
from stages.artifacts.mesh import Mesh
from stages.drawing.rasterizing import NO_FACE, depth_map
from stages.drawing.view_scores import silhouette
from stages.gaussians.drawing import Camera, camera_of, render
from stages.gaussians.gaussians import Gaussians
from stages.geometry.cameras import PinholeCameras

# Pixels by which the object may reach beyond the mesh's outline.
MARGIN = 3
# Photos with more pixels between neighbouring Gaussians are shrunk: they show more than Gaussians can.
FINER = 1.3


@dataclass(frozen=True)
class Target:
    """One photo, cut to where the object is, and shrunk where it is finer than the Gaussians.

    Attributes:
        camera: of what is left of the photo.
        shown: [H, W, 3] uint8 sRGB.
        gains: [3] factors that make its exposure that of the others.
        inside: [H, W] bool, where the photo shows the object.
        outside: [H, W] bool, where nothing should be drawn.
    """

    camera: Camera
    shown: np.ndarray
    gains: np.ndarray
    inside: np.ndarray
    outside: np.ndarray

    @property
    def photo(self) -> np.ndarray:
        """[H, W, 3] float32 sRGB, 1 for full scale, at the others' exposure."""
        return self.shown * (self.gains / 255).astype(np.float32)

    def over(self, background: np.ndarray, drawn: np.ndarray) -> np.ndarray:
        """What should be seen before a background [3]; what is drawn [H, W, 3] where the photo does not tell."""
        seen = np.where(self.inside[..., None], self.photo, drawn)
        seen[self.outside] = background
        return seen


def target(
    atlas: AtlasMesh,
    cameras: PinholeCameras,
    index: int,
    photo: np.ndarray,
    mask: np.ndarray | None,
    gains: np.ndarray,
    spacing: float = 0.0,
    background: bool = False,
    others: Mesh | None = None,
) -> Target | None:
    """Of photo `index`, [H, W, 3] uint8 with its mask [H, W] bool, or None; None where it does not show the mesh.

    Args:
        gains: [3] factors that bring the photo to the others' exposure.
        spacing: of neighbouring Gaussians, scene units.
        background: all of the photo should be seen, whatever the mask says.
        others: what else may be in the way, vertices and faces. What it hides the photo does not tell.
    """
    import cv2

    covered = silhouette(atlas.vertices, atlas.faces, cameras, index)
    side = 2 * MARGIN + 1
    around = cv2.dilate(covered.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))) > 0
    inside = covered if mask is None else mask & around
    outside = ~around if mask is None else ~(covered | mask)
    if others is not None:
        inside = inside & ~(covered & (depth_map(cameras, index, atlas.vertices, atlas.faces, others)[0] == NO_FACE))
    if not inside.any():
        return None
    if background:
        inside, outside, around = np.ones_like(covered), np.zeros_like(covered), np.ones_like(covered)
    camera = camera_of(cameras, index)
    depth = float(np.median(camera.pose[2, :3] @ atlas.vertices.T + camera.pose[2, 3]))
    between = spacing * float(camera.focal[0]) / max(depth, 1e-6)
    factor = min(max(1, int(between / FINER)), *photo.shape[:2])
    rows, columns = (
        _whole(np.flatnonzero(around.any(axis)), length, factor)
        for axis, length in zip((1, 0), photo.shape[:2], strict=True)
    )
    window = rows, columns
    return Target(
        camera=shrunk(cut(camera, window), factor),
        shown=np.round(_means(photo[window], factor)).astype(np.uint8),
        gains=gains,
        inside=_means(inside[window], factor) == 1,
        outside=_means(outside[window], factor) == 1,
    )


def where_drawn(found: Target, gaussians: Gaussians) -> Target:
    """The same, told only where Gaussians cover the image: elsewhere nothing is there to show what the photo does."""
    covered = render(gaussians, found.camera).transmittance < 0.5
    return replace(found, inside=found.inside & covered)


def cut(camera: Camera, window: tuple[slice, slice]) -> Camera:
    """The camera of a part of its image: rows and columns."""
    rows, columns = window
    middle = camera.middle - np.array([columns.start, rows.start], np.float32)
    return replace(camera, middle=middle, width=columns.stop - columns.start, height=rows.stop - rows.start)


def shrunk(camera: Camera, factor: int) -> Camera:
    """The camera of an image whose pixels are `factor` times as wide; its sides are multiples of that."""
    focal, middle = camera.focal / np.float32(factor), camera.middle / np.float32(factor)
    return replace(camera, focal=focal, middle=middle, width=camera.width // factor, height=camera.height // factor)


def _whole(found: np.ndarray, length: int, factor: int) -> slice:
    """Rows (or columns) from the first to the last one found, as a multiple of `factor` of `length` at most."""
    count = min(-(-(found[-1] + 1 - found[0]) // factor), length // factor) * factor
    start = min(int(found[0]), length - count)
    return slice(start, start + count)


def _means(image: np.ndarray, factor: int) -> np.ndarray:
    """Means over squares of `factor` pixels, [H / factor, W / factor, ...]."""
    height, width = (side // factor for side in image.shape[:2])
    squares = image.reshape(height, factor, width, factor, *image.shape[2:])
    means: np.ndarray = squares.mean((1, 3), dtype=np.float32)
    return means
