"""Whether what lies off the masks is in the model, too: then it stood still against the object, and is evidence."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Shaped

# Features this near to a mask, as a part of the photo's longer side, may be of the object: masks are not exact.
NEAR = 0.01
# Off the masks a photo has at least so many features that are points of the model, and the part of the features there
# that are is at least so large in terms of that part on the masks. Of backgrounds that stood still 41 to 49 % are
# (three made-up sets), of a black cloth 5 % (dtu_scan24, 2 a photo), of a room that did not turn with the object next
# to none.
MIN_POINTS, MIN_RATIO = 20, 0.5
# With fewer features on its mask a photo says nothing of the part there.
MIN_FEATURES = 5


@dataclass(frozen=True)
class Background:
    """How much of what photos show off their masks is in the model: medians over the photos.

    Attributes:
        points: features off the mask that are points of the model.
        off, on: part of the features off and on the mask that are.
    """

    points: float
    off: float
    on: float

    @property
    def is_seen(self) -> bool:
        """Whether it is as well known as what the masks show: one that moves, or is plain, is not."""
        return self.points >= MIN_POINTS and self.off >= MIN_RATIO * self.on


def seen_background(
    model: Any, photos: Sequence[Any], load_mask: Callable[[str], Shaped[np.ndarray, "_ _"] | None]
) -> Background:
    """What is known of the background of photos that have a mask; nothing is where poses come from masked features.

    Args:
        model: pycolmap reconstruction. photos: its registered images.
        load_mask: name -> mask of the photo as it was taken, not zero on the object; None where it has none.
    """
    points, off, on = list[int](), list[float](), list[float]()
    for photo in photos:
        mask = load_mask(photo.name)
        if mask is None:
            continue
        places, known = _features(photo)
        near = _near(mask, model.cameras[photo.camera_id], places)
        points.append(int(known[~near].sum()))
        off.append(float(known[~near].mean()) if not near.all() else 0.0)
        if near.sum() >= MIN_FEATURES:
            on.append(float(known[near].mean()))
    return Background(*(float(np.median(each)) if each else 0.0 for each in (points, off, on)))


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
