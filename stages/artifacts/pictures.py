"""Folders of pictures, as ingest (upright photos) and undistort (pinhole images) publish them: images/ and masks/.

The mask of `images/NAME` is `masks/NAME.png`, 255 on the object, of the same size. Pictures without a mask have none.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages.artifacts.artifact import Artifact, in_folder
from stages.errors import WorkspaceError

IMAGES, MASKS = "images", "masks"


@dataclass(frozen=True)
class Pictures:
    """Pictures of a stage and their masks, each read when asked for.

    Attributes:
        folder: of the stage.
    """

    folder: Path

    @property
    def images(self) -> Path:
        """The folder of images, for programs that read it themselves."""
        return self.folder / IMAGES

    @property
    def masks(self) -> Path:
        """The folder of masks; may not exist."""
        return self.folder / MASKS

    def path(self, name: str) -> Path:
        return image_path(self.folder, name)

    def mask_path(self, name: str) -> Path:
        return mask_path(self.folder, name)

    def image(self, name: str) -> np.ndarray:
        """See `load_image`."""
        return load_image(self.folder, name)

    def mask(self, name: str) -> np.ndarray | None:
        """See `load_mask`."""
        return load_mask(self.folder, name)

    def masked(self, name: str) -> tuple[np.ndarray, np.ndarray | None]:
        """Image [H, W, 3] uint8 RGB and its mask [H, W] bool, or None where there is no mask."""
        mask = self.mask(name)
        return self.image(name), None if mask is None else mask > 127


def pictures_of(stage: str) -> Artifact[Pictures]:
    """The pictures and masks that `stage` publishes."""
    return in_folder(stage, (f"{IMAGES}/*", f"{MASKS}/*"), Pictures)


def image_path(folder: Path, name: str) -> Path:
    """A stage's image `name` (ingest: upright photo, undistort: pinhole image)."""
    return folder / IMAGES / name


def mask_path(folder: Path, name: str) -> Path:
    """The mask of image `name`: 8-bit PNG, 255 on the object, same size as the image. May not exist."""
    return folder / MASKS / f"{name}.png"


def load_image(folder: Path, name: str) -> np.ndarray:
    """A stage's image `name`: [H, W, 3] uint8 RGB.

    Raises:
        WorkspaceError: it cannot be read.
    """
    import cv2

    # the pixels are upright already, whatever their EXIF says
    pixels = cv2.imread(str(image_path(folder, name)), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if pixels is None:
        raise _unreadable("image", image_path(folder, name), folder)
    return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)


def load_mask(folder: Path, name: str) -> np.ndarray | None:
    """The mask of image `name`: [H, W] uint8, 255 on the object; None where it has none.

    Raises:
        WorkspaceError: it is there but cannot be read.
    """
    import cv2

    path = mask_path(folder, name)
    if not path.exists():
        return None
    mask = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if mask is None:
        raise _unreadable("mask", path, folder)
    return mask


def write_png(path: Path, pixels: np.ndarray, compression: int | None = None) -> None:
    """Write [H, W] or [H, W, 3] RGB uint8; `compression` 0..9, None: OpenCV's choice.

    A full disk raises OSError, which OpenCV's own writer of files would hide.
    """
    import cv2

    options = [] if compression is None else [cv2.IMWRITE_PNG_COMPRESSION, compression]
    data = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR) if pixels.ndim == 3 else pixels
    _, encoded = cv2.imencode(".png", data, options)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encoded.tobytes())


def _unreadable(what: str, path: Path, folder: Path) -> WorkspaceError:
    return WorkspaceError(
        f"The {what} {path} cannot be read.", f"Make it again: `hineus run PHOTOS --force {folder.name}`."
    )
