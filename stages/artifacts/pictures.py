"""Folders of pictures, as ingest (upright photos) and undistort (pinhole images) publish them: images/ and masks/.

The mask of `images/NAME` is `masks/NAME.png`, 255 on the object, of the same size. Pictures without a mask have none.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages.artifacts.artifact import Artifact, in_folder
from stages.artifacts.own_files import inside
from stages.errors import WorkspaceError
from stages.inputs.formats import check_png

IMAGES, MASKS = "images", "masks"


@dataclass(frozen=True)
class Pictures:
    """The pictures in a stage's folder and their masks, each read when asked for.

    Attributes:
        kind: the folder of the masks.
    """

    folder: Path
    kind: str = MASKS

    @property
    def images(self) -> Path:
        """The folder of images, for programs that read it themselves."""
        return self.folder / IMAGES

    @property
    def masks(self) -> Path:
        """The folder of masks; may not exist."""
        return self.folder / self.kind

    def path(self, name: str) -> Path:
        return inside(self.images, name)

    def mask_path(self, name: str) -> Path:
        """Where the mask of image `name` lies; may not exist."""
        return inside(self.masks, f"{name}.png")

    def image(self, name: str) -> np.ndarray:
        """Image `name`: [H, W, 3] uint8 RGB.

        Raises:
            WorkspaceError: it cannot be read.
        """
        import cv2

        # the pixels are upright already, whatever their EXIF says
        pixels = self._read("image", self.path(name), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        return cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)

    def mask(self, name: str) -> np.ndarray | None:
        """The mask of image `name`: [H, W] uint8, 255 on the object; None where it has none.

        Raises:
            WorkspaceError: it is there but cannot be read.
        """
        import cv2

        path = self.mask_path(name)
        return self._read("mask", path, cv2.IMREAD_GRAYSCALE) if path.exists() else None

    def masked(self, name: str) -> tuple[np.ndarray, np.ndarray | None]:
        """Image [H, W, 3] uint8 RGB and its mask [H, W] bool, or None where there is no mask."""
        mask = self.mask(name)
        return self.image(name), None if mask is None else mask > 127

    def _read(self, what: str, path: Path, flags: int) -> np.ndarray:
        import cv2

        pixels = None
        with suppress(ValueError):
            if path.suffix.lower() == ".png":
                check_png(path)
            pixels = cv2.imread(str(path), flags)
        if pixels is None:
            raise _unreadable(what, path, self.folder.name)
        return pixels


def _unreadable(what: str, path: Path, stage: str) -> WorkspaceError:
    return WorkspaceError(f"The {what} {path} cannot be read.", f"Make it again: `hineus run PHOTOS --force {stage}`.")


def pictures_of(stage: str) -> Artifact[Pictures]:
    """The pictures and masks that `stage` publishes."""
    return in_folder(stage, (f"{IMAGES}/*", f"{MASKS}/*"), Pictures)


def texture_bytes(path: Path) -> bytes:
    """A PNG that lies in a stage's folder.

    Raises:
        WorkspaceError: it is damaged.
    """
    try:
        check_png(path)
    except ValueError as error:
        raise _unreadable("texture", path, path.parent.name) from error
    return path.read_bytes()


def read_texture(path: Path) -> np.ndarray:
    """The same as [H, W, 3] uint8 RGB."""
    import cv2

    image = cv2.imdecode(np.frombuffer(texture_bytes(path), np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise _unreadable("texture", path, path.parent.name)
    pixels: np.ndarray = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)
    return pixels


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
