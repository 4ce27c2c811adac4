"""Every suite's published layout, made of the ball of `sphere_scene`: one world, eight cameras, small photos."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from sphere_scene import RADIUS, render, ring_of_cameras

from stages.geometry.cameras import PinholeCameras

COUNT, WIDTH, HEIGHT = 8, 72, 64
FOCAL = 60.0


def cameras() -> PinholeCameras:
    return ring_of_cameras(COUNT, WIDTH, HEIGHT)


def write_photo(path: Path, index: int, alpha: bool = False) -> None:
    """One photo; with `alpha`, black and transparent off the ball."""
    pixels, mask = render(cameras(), index)
    bgr = np.ascontiguousarray(pixels[..., ::-1])
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.dstack([bgr * (mask > 0)[..., None], mask]) if alpha else bgr)


def write_mask(path: Path, index: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), render(cameras(), index)[1])


def pose(index: int) -> np.ndarray:
    """[4, 4] camera from world."""
    return np.vstack([cameras().extrinsics[index], [0, 0, 0, 1]])


def world_from_gl(index: int) -> np.ndarray:
    return np.linalg.inv(pose(index)) @ np.diag([1.0, -1.0, -1.0, 1.0])


def depth(index: int) -> np.ndarray:
    """[H, W] depth along the axis of the ball, 0 off it."""
    ring = cameras()
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    origins, rays = ring.rays(index, np.stack([x.ravel() + 0.5, y.ravel() + 0.5], 1))
    along = -(origins * rays).sum(1)
    nearest2 = (origins**2).sum(1) - along**2
    hit = nearest2 < RADIUS**2
    distance = along - np.sqrt(np.where(hit, RADIUS**2 - nearest2, 0))
    return np.where(hit, distance * (rays @ ring.forward[index]), 0).reshape(HEIGHT, WIDTH).astype(np.float32)


# ---------------------------------------------------------------- one writer a layout
def write_neus(folder: Path) -> None:
    """DTU and BlendedMVS as NeuS gives them."""
    # the layout counts pixel centres at whole numbers
    intrinsics = np.array([[FOCAL, 0, WIDTH / 2 - 0.5], [0, FOCAL, HEIGHT / 2 - 0.5], [0, 0, 1]])
    matrices = {}
    for i in range(COUNT):
        write_photo(folder / "image" / f"{i:06d}.png", i)
        write_mask(folder / "mask" / f"{i:03d}.png", i)
        matrices[f"world_mat_{i}"] = np.vstack([intrinsics @ pose(i)[:3], [0, 0, 0, 1]])
        matrices[f"scale_mat_{i}"] = np.eye(4)
    np.savez(folder / "cameras_sphere.npz", **matrices)


def write_nerf_synthetic(folder: Path) -> None:
    """Six photos to train on, two as tests, and pictures that are no photos."""
    for part, indices in (("train", range(6)), ("test", range(6, COUNT))):
        frames = []
        for k, i in enumerate(indices):
            write_photo(folder / part / f"r_{k}.png", i, alpha=True)
            frames.append({"file_path": f"./{part}/r_{k}", "transform_matrix": world_from_gl(i).tolist()})
        angle = 2 * np.arctan(0.5 * WIDTH / FOCAL)
        (folder / f"transforms_{part}.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames}))
    write_photo(folder / "test" / "r_0_depth_0001.png", 0)
    write_photo(folder / "test" / "r_0_normal_0001.png", 1)


def write_colmap(folder: Path, names: list[str]) -> None:
    """A model of all cameras, for photos of twice the size."""
    import pycolmap

    folder.mkdir(parents=True)
    model = pycolmap.Reconstruction()
    params = [2 * FOCAL, 2 * FOCAL, WIDTH, HEIGHT]
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(model="PINHOLE", width=2 * WIDTH, height=2 * HEIGHT, params=params, camera_id=1)
    )
    for i, name in enumerate(names):
        rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(pose(i)[:3, :3]), pose(i)[:3, 3])
        model.add_image_with_trivial_frame(pycolmap.Image(name, pycolmap.Point2DList(), 1, i + 1), rigid)
    model.write_binary(str(folder))


def write_mipnerf360(folder: Path) -> None:
    names = [f"DSC{i:05d}.JPG" for i in range(COUNT)]
    for i, name in enumerate(names):
        write_photo(folder / "images_4" / name, i)
    (folder / "images").mkdir()
    write_colmap(folder / "sparse" / "0", names)


def write_glossy(folder: Path) -> None:
    intrinsics = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], np.float32)
    for i in range(COUNT):
        write_photo(folder / f"{i}.png", i)
        far = np.where(depth(i) > 0, depth(i), 15.0)
        cv2.imwrite(str(folder / f"{i}-depth.png"), np.rint(far / 15 * 65535).astype(np.uint16))
        (folder / f"{i}-camera.pkl").write_bytes(pickle.dumps([pose(i)[:3].astype(np.float32), intrinsics]))


def write_blendedmvs(folder: Path) -> None:
    for i in range(COUNT):
        write_photo(folder / "blended_images" / f"{i:08d}.jpg", i)
        write_photo(folder / "blended_images" / f"{i:08d}_masked.jpg", i)
        (folder / "rendered_depth_maps").mkdir(exist_ok=True)
        cv2.imwrite(str(folder / "rendered_depth_maps" / f"{i:08d}.pfm"), depth(i))
        (folder / "cams").mkdir(exist_ok=True)
        rows = ["extrinsic", *(" ".join(map(str, row)) for row in pose(i)), "", "intrinsic"]
        rows += [f"{FOCAL} 0 {WIDTH / 2}", f"0 {FOCAL} {HEIGHT / 2}", "0 0 1", "", "1 0.1"]
        (folder / "cams" / f"{i:08d}_cam.txt").write_text("\n".join(rows))


def write_meganerf(folder: Path) -> None:
    """Six photos to train on, two as tests."""
    import torch

    for part, indices in (("train", range(6)), ("val", range(6, COUNT))):
        for i in indices:
            write_photo(folder / part / "rgbs" / f"{i:06d}.jpg", i)
            (folder / part / "metadata").mkdir(exist_ok=True)
            torch.save(
                {
                    "W": WIDTH,
                    "H": HEIGHT,
                    "intrinsics": torch.tensor([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]),
                    "c2w": torch.from_numpy(world_from_gl(i)[:3]),
                },
                folder / part / "metadata" / f"{i:06d}.pt",
            )


def write_urban_photos(folder: Path) -> None:
    for i in range(COUNT):
        write_photo(folder / "photos" / f"DJI_{i:04d}.JPG", i)


def write_known(folder: Path) -> None:
    import trimesh

    frames = []
    for i in range(COUNT):
        write_photo(folder / "images" / f"{i:03d}.jpg", i)
        write_mask(folder / "masks" / f"{i:03d}.png", i)
        matrix = world_from_gl(i).tolist()
        frames.append({"file_path": f"{i:03d}.jpg", "transform_matrix": matrix, "w2c_opencv": pose(i).tolist()})
    size = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": WIDTH / 2, "cy": HEIGHT / 2}
    (folder / "transforms.json").write_text(json.dumps({**size, "frames": frames}))
    trimesh.creation.icosphere(3, RADIUS).export(folder / "gt_mesh.ply")


LAYOUTS: dict[str, tuple[str, Callable[[Path], None]]] = {
    "dtu": ("dtu_scan24", write_neus),
    "nerf-synthetic": ("lego", write_nerf_synthetic),
    "mipnerf360": ("garden", write_mipnerf360),
    "glossy-synthetic": ("bell", write_glossy),
    "blendedmvs": ("5bfe5ae0fe0ea555e6a969ca", write_blendedmvs),
    "urbanscene3d": ("residence-pixsfm", write_meganerf),
    "known": ("ball", write_known),
}


def write_suite(suite: str, data: Path) -> Path:
    """One scene of a suite in `data`; returns the scene's folder."""
    name, write = LAYOUTS[suite]
    (data / name).mkdir(parents=True)
    write(data / name)
    return data / name
