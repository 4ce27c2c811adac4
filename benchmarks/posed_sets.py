"""Sets of photos with known cameras, in the layout of NeuS, as the folder that the undistort stage would publish.

The layout: `image/*` and `mask/*` in the same order, `cameras_sphere.npz` with `world_mat_i` (projection [4, 4] of
world points to pixels) and `scale_mat_i` (world from the frame where the object lies in the unit sphere).
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from stages import artifacts
from stages.geometry.cameras import PinholeCameras, PosedScene
from stages.geometry.similarity import Similarity
from stages.posing.neus import PIXEL_SHIFT, decompose

CAMERAS = "cameras_sphere.npz"


def has_cameras(folder: Path) -> bool:
    """Whether a set comes with its cameras."""
    return (folder / CAMERAS).is_file()


def write_posed_set(source: Path, folder: Path) -> None:
    """Write photos, masks (where there are any) and cameras of the set `source`; there are no sparse points."""
    import cv2

    photos = sorted((source / "image").iterdir())
    masks = sorted((source / "mask").iterdir()) if (source / "mask").is_dir() else []
    for name in (artifacts.IMAGES, artifacts.MASKS):
        (folder / name).mkdir(parents=True)
    for photo in photos:
        shutil.copyfile(photo, artifacts.image_path(folder, photo.name))
    for photo, mask in zip(photos, masks, strict=False):
        grey = cv2.imread(str(mask), cv2.IMREAD_GRAYSCALE)
        artifacts.write_png(artifacts.mask_path(folder, photo.name), np.where(grey > 127, 255, 0).astype(np.uint8))
    images = [artifacts.load_image(folder, photo.name) for photo in photos]
    with np.load(source / CAMERAS) as data:
        projections = [(data[f"world_mat_{i}"] @ data[f"scale_mat_{i}"])[:3] for i in range(len(photos))]
        world_from_scene = data["scale_mat_0"]
    intrinsics, poses = zip(*(decompose(projection) for projection in projections), strict=True)
    cameras = PinholeCameras(
        names=tuple(photo.name for photo in photos),
        sizes=np.array([[image.shape[1], image.shape[0]] for image in images]),
        intrinsics=np.stack(intrinsics) + PIXEL_SHIFT * np.array([[0, 0, 1], [0, 0, 1], [0, 0, 0]]),
        cam_from_scene=np.stack(poses),
    )
    up = -cameras.cam_from_scene[:, 1, :3].mean(0)
    scale = float(world_from_scene[0, 0])
    scene = PosedScene(
        cameras=cameras,
        world_from_scene=Similarity(scale, world_from_scene[:3, :3] / scale, world_from_scene[:3, 3]),
        points=np.zeros((0, 3), np.float32),
        point_errors=np.zeros(0, np.float32),
        observations=np.zeros((0, 2), np.int32),
        up=up / np.linalg.norm(up),
    )
    artifacts.save_scene(folder, scene)
