"""What Gaussians should look like from where a photo was taken, as far as the photo tells.

Inside the object's outline that is the photo. Beyond the mesh by more than a margin, nothing should be drawn: the
background is no part of the model. Between the two, photos do not say which of both a pixel shows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stages.artifacts import AtlasMesh
from stages.drawing.view_scores import silhouette
from stages.gaussians.drawing import Camera, camera_of
from stages.geometry.cameras import PinholeCameras

# Pixels by which the object may reach beyond the mesh's outline.
MARGIN = 3


@dataclass(frozen=True)
class Target:
    """One photo, cut to where the object is.

    Attributes:
        camera: of the part of the photo.
        photo: [H, W, 3] float32 sRGB, with the photo's exposure made that of the others.
        inside: [H, W] bool, where the photo shows the object.
        outside: [H, W] bool, where nothing should be drawn.
    """

    camera: Camera
    photo: np.ndarray
    inside: np.ndarray
    outside: np.ndarray

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
) -> Target | None:
    """Of photo `index`, [H, W, 3] uint8 with its mask [H, W] bool, or None; None where it does not show the mesh.

    Args:
        gains: [3] factors that bring the photo to the others' exposure.
    """
    import cv2

    covered = silhouette(atlas.vertices, atlas.faces, cameras, index)
    side = 2 * MARGIN + 1
    around = cv2.dilate(covered.astype(np.uint8), cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))) > 0
    inside = covered if mask is None else mask & around
    outside = ~around if mask is None else ~(covered | mask)
    rows, columns = (np.flatnonzero(around.any(axis)) for axis in (1, 0))
    if not inside.any():
        return None
    window = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    return Target(
        camera=cut(camera_of(cameras, index), window),
        photo=(photo[window] * (gains / 255)).astype(np.float32),
        inside=inside[window],
        outside=outside[window],
    )


def cut(camera: Camera, window: tuple[slice, slice]) -> Camera:
    """The camera of a part of its image: rows and columns."""
    rows, columns = window
    middle = camera.middle - np.array([columns.start, rows.start], np.float32)
    return replace(camera, middle=middle, width=columns.stop - columns.start, height=rows.stop - rows.start)
