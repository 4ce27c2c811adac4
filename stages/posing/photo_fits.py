"""How well each photo's pose fits the sparse points it sees."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class PhotoFit:
    """One photo of a model.

    Attributes:
        error_px: mean distance in pixels between its features and the points they belong to, projected into it; None
            where it has no point.
        points: how many points those are.
    """

    error_px: float | None
    points: int


def photo_fits(folder: Path) -> dict[str, PhotoFit]:
    """The fit of each registered photo of the COLMAP model in `folder`, by name.

    Raises:
        ValueError: the model cannot be read.
    """
    import pycolmap

    try:
        model = pycolmap.Reconstruction(str(folder))
    except Exception as error:  # pycolmap raises its own and Python's for damaged files
        raise ValueError(f"expected a COLMAP model in {folder}: {error}") from error
    fits = {}
    for image_id in model.reg_image_ids():
        image = model.images[image_id]
        used = [point for point in image.points2D if point.has_point3D()]
        if not used:
            fits[image.name] = PhotoFit(None, 0)
            continue
        points = np.array([model.points3D[point.point3D_id].xyz for point in used])
        features = np.array([point.xy for point in used])
        projected = model.cameras[image.camera_id].img_from_cam(image.cam_from_world() * points)
        errors = np.linalg.norm(projected - features, axis=1)
        fits[image.name] = PhotoFit(float(np.nanmean(errors)), len(used))
    return fits
