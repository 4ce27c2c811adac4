"""Whether what lies off the masks stood still against the object: then it is evidence, too."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Shaped

# Features this near to a mask, as a part of the photo's longer side, may be of the object: masks are not exact.
NEAR = 0.01
# Off the masks a photo has so many features that are points of the model, in the mean; and they are as large a part of
# the features there: of backgrounds that stood still 41 to 49 % are (three made-up sets), of a black cloth 5 %
# (dtu_scan24, 2 a photo), of a room that did not turn with the object next to none.
MIN_POINTS, MIN_SHARE = 20.0, 0.25


def stands_still(
    model: Any, photos: Sequence[Any], load_mask: Callable[[str], Shaped[np.ndarray, "_ _"] | None]
) -> bool:
    """Whether features off the masks became points of the model: a background that moves, or is plain, gives none.

    Nor does it where poses come from features on the masks alone.

    Args:
        model: pycolmap reconstruction. photos: its registered images.
        load_mask: name -> mask of the photo as it was taken, not zero on the object; None where it has none.
    """
    masked = [(photo, mask) for photo in photos if (mask := load_mask(photo.name)) is not None]
    if not masked:
        return False
    features = points = 0
    for photo, mask in masked:
        places, known = _features(photo)
        off = ~_near(mask, model.cameras[photo.camera_id], places)
        features += int(off.sum())
        points += int((off & known).sum())
    return points >= max(MIN_POINTS * len(masked), MIN_SHARE * features)


def _features(photo: Any) -> tuple[Float[np.ndarray, "f 2"], Bool[np.ndarray, " f"]]:
    """Where a photo's features lie, and which of them are points of the model."""
    places = np.array([feature.xy for feature in photo.points2D]).reshape(-1, 2)
    return places, np.array([feature.has_point3D() for feature in photo.points2D], bool)


def _near(mask: Shaped[np.ndarray, "h w"], camera: Any, places: Float[np.ndarray, "f 2"]) -> Bool[np.ndarray, " f"]:
    """Which places in a photo lie on its mask or near it."""
    import cv2

    height, width = mask.shape
    reach = max(1, round(NEAR * max(height, width)))
    wide = cv2.dilate((mask != 0).astype(np.uint8), np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
    x, y = np.floor(places * [width / camera.width, height / camera.height]).astype(int).T
    return wide[y.clip(0, height - 1), x.clip(0, width - 1)] != 0
