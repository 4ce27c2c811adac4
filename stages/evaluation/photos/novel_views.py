"""Test photos, which no stage has seen, as pinhole images in the frame of a finished workspace."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from stages.capture.masks import load_mask, pair_masks
from stages.evaluation.photos.regions import WHITE
from stages.geometry.cameras import PinholeCameras, PosedScene
from stages.geometry.normalisation import into_frame
from stages.inputs.formats import open_image
from stages.posing.known import image_size, match_photos
from stages.posing.reading import read_poses
from stages.posing.triangulation import fitted_camera
from stages.posing.undistortion import pinhole_camera, pinhole_photo

OPAQUE = 127  # alpha above this is the object, as ingest has it


@dataclass(frozen=True)
class NovelViews:
    """Photos to judge by, which no stage sees.

    Attributes:
        folder: of the photos. names: relative to it, posix.
        poses: what `stages.posing.reading.read_poses` takes.
        background: how the suite's PSNR counts what is not the object: "white", or as "photo" shows it.
    """

    folder: Path
    names: tuple[str, ...]
    poses: Path
    background: Literal["white", "photo"] = "photo"


class NovelPhotos:
    """Test photos and their cameras.

    Attributes:
        cameras: in the scene frame, in the order of the views' names; photos without a pose are left out.
    """

    def __init__(self, views: NovelViews, scene: PosedScene, masks: Path | None = None) -> None:
        """As the trained scene has them, and with the folder of its masks, if it is run with any.

        Raises:
            InputError: no photo has a pose, or one has another shape than its pose is for.
        """
        poses = read_poses(views.poses)
        matched = match_photos(poses, views.names)
        self._views = views
        self._masks = pair_masks(list(matched), masks, poses.masks_of(matched)) if masks is not None else {}
        # as large as training saw photos of this scene
        self._max_side = int(scene.cameras.sizes.max())
        self._lenses = {
            name: fitted_camera(known, name, image_size(views.folder / name, views.poses))
            for name, known in matched.items()
        }
        intrinsics, sizes = zip(*(pinhole_camera(lens, self._max_side) for lens in self._lenses.values()), strict=True)
        in_poses = PinholeCameras(
            names=tuple(matched),
            sizes=np.array(sizes, dtype=np.int64),
            intrinsics=np.stack(intrinsics),
            extrinsics=np.stack([known.cam_from_world for known in matched.values()]),
        )
        self.cameras = into_frame(in_poses, scene.poses_from_scene)

    def load(self, index: int) -> tuple[np.ndarray, np.ndarray | None]:
        """Photo [H, W, 3] uint8 (on white, where that is the suite's background) and mask [H, W] bool or None."""
        name = self.cameras.names[index]
        pixels, mask = _read(self._views.folder / name, self._views.background == "white")
        if name in self._masks:
            size = pixels.shape[1], pixels.shape[0]
            mask = np.where(load_mask(self._masks[name], name, size, size, 1).kept, WHITE, 0).astype(np.uint8)
        pixels, mask = pinhole_photo(self._lenses[name], pixels, mask, self._max_side)
        return pixels, None if mask is None else mask > OPAQUE


def _read(file: Path, on_white: bool) -> tuple[np.ndarray, np.ndarray | None]:
    """Pixels [H, W, 3] and, of a photo with an alpha channel, its mask [H, W], both uint8."""
    with open_image(file) as stored:
        image: Any = stored.convert("RGBA" if "A" in stored.getbands() else "RGB")
    values = np.asarray(image)
    if values.shape[2] == 3:
        return values, None
    alpha = values[..., 3:] / WHITE
    pixels = values[..., :3] * alpha + WHITE * (1 - alpha) if on_white else values[..., :3]
    return np.rint(pixels).astype(np.uint8), np.where(values[..., 3] > OPAQUE, 255, 0).astype(np.uint8)
