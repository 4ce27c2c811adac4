"""Known poses: every format written from one scene, read back, and held against the pixels that scene projects to."""

from __future__ import annotations

import codecs
import json
import math
import os
import pickle
import re
import struct
import unicodedata
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from configs.params import IngestParams
from stages import artifacts
from stages.engine.stage import StageContext
from stages.errors import InputError
from stages.ingest import INGEST
from stages.inputs.folders import readable, short_name
from stages.posing.known import KnownCamera, KnownPoses, match_photos
from stages.posing.reading import locate_poses, masks_beside, read_poses

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
NUM = 4
CENTER = np.array([1.0, -2.0, 0.5])
POINTS = CENTER + np.random.default_rng(0).uniform(-0.5, 0.5, (30, 3))
NAMES = [f"{i:03d}" for i in range(NUM)]
OPENCV = (FOCAL, 1.02 * FOCAL, 163.0, 117.0, -0.1, 0.02, 0.002, -0.001)
FISHEYE = (FOCAL, FOCAL, 160.0, 120.0, 0.05, -0.01, 0.002, -0.001)


def cam_from_world(index: int) -> np.ndarray:
    """[3, 4] of a camera on a circle about the scene, rolled a little so that no axis is special."""
    angle, roll = 2 * np.pi * index / NUM + 0.3, 0.2 * index
    offset = np.array([2.5 * np.cos(angle), 2.5 * np.sin(angle), 1.2])
    z = -offset / np.linalg.norm(offset)
    x = np.cross(z, [0, 0, 1])
    x /= np.linalg.norm(x)
    level = np.stack([x, np.cross(z, x), z])
    turn = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    rotation = turn @ level
    return np.concatenate([rotation, -(rotation @ (CENTER + offset))[:, None]], 1)


def world_from_gl(index: int) -> np.ndarray:
    """[4, 4] camera to world with OpenGL axes."""
    pose = np.eye(4)
    pose[:3] = cam_from_world(index)
    return np.linalg.inv(pose) @ np.diag([1.0, -1.0, -1.0, 1.0])


# ---------------------------------------------------------------- what the pixels are, in numpy
def pinhole(uv: np.ndarray) -> np.ndarray:
    return uv * FOCAL + [WIDTH / 2, HEIGHT / 2]


def opencv(uv: np.ndarray) -> np.ndarray:
    fx, fy, cx, cy, k1, k2, p1, p2 = OPENCV
    x, y = uv.T
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2
    return np.stack(
        [
            fx * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)) + cx,
            fy * (y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y) + cy,
        ],
        1,
    )


def fisheye(uv: np.ndarray) -> np.ndarray:
    fx, fy, cx, cy, *k = FISHEYE
    r = np.linalg.norm(uv, axis=1, keepdims=True)
    theta = np.arctan(r)
    bent = theta * (1 + sum(c * theta ** (2 * i + 2) for i, c in enumerate(k)))
    return uv * bent / r * [fx, fy] + [cx, cy]


def seen(index: int, lens: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """[P, 2] pixels of the points, the image's corner at (0, 0)."""
    pose = cam_from_world(index)
    in_cam = POINTS @ pose[:, :3].T + pose[:, 3]
    return lens(in_cam[:, :2] / in_cam[:, 2:])


def reprojected(camera: KnownCamera) -> np.ndarray:
    import pycolmap

    lens = pycolmap.Camera(model=camera.model, width=WIDTH, height=HEIGHT, params=list(camera.params))
    in_cam = POINTS @ camera.cam_from_world[:, :3].T + camera.cam_from_world[:, 3]
    return np.asarray(lens.img_from_cam(in_cam))


def assert_reprojects(poses: KnownPoses, lens: Callable[[np.ndarray], np.ndarray], names: list[str]) -> None:
    assert [camera.name for camera in poses.cameras] == names
    for i, camera in enumerate(poses.cameras):
        assert camera.size == (WIDTH, HEIGHT)
        assert np.abs(reprojected(camera) - seen(i, lens)).max() < 1e-3


def write_images(folder: Path, names: list[str], alpha: bool = False) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for i, name in enumerate(names):
        pixels = np.random.default_rng(i).integers(0, 255, (HEIGHT, WIDTH, 4 if alpha else 3), dtype=np.uint8)
        if alpha:
            pixels[..., 3] = np.where(np.arange(WIDTH) > 100, 255, 0)
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / name), pixels)


# ---------------------------------------------------------------- COLMAP
@pytest.mark.parametrize("text", [False, True])
def test_colmap_model(tmp_path: Path, text: bool):
    import pycolmap

    folder = tmp_path / "sparse" / "0"
    folder.mkdir(parents=True)
    model = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="OPENCV", width=WIDTH, height=HEIGHT, params=list(OPENCV), camera_id=1)
    model.add_camera_with_trivial_rig(camera)
    for i, name in enumerate(NAMES):
        pose = cam_from_world(i)
        image = pycolmap.Image(f"{name}.jpg", pycolmap.Point2DList(), 1, i + 1)
        model.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3]), pose[:, 3]))
    (model.write_text if text else model.write_binary)(str(folder))
    for place in (folder, tmp_path, folder / ("cameras.txt" if text else "cameras.bin")):
        assert locate_poses(place) == folder
    assert_reprojects(read_poses(tmp_path), opencv, [f"{name}.jpg" for name in NAMES])


def text_model(folder: Path, names: Sequence[str], encoding: str = "utf-8", newline: str = "\n") -> Path:
    """As COLMAP writes it: the second line of an image has its points, or nothing."""
    folder.mkdir(parents=True, exist_ok=True)
    camera = f"# cameras\n1 OPENCV {WIDTH} {HEIGHT} {' '.join(map(str, OPENCV))}\n"
    lines = ["# images, two lines each"]
    for i, name in enumerate(names):
        pose = cam_from_world(i)
        x, y, z, w = Rotation.from_matrix(pose[:, :3]).as_quat()
        lines += [" ".join(map(str, (i + 1, w, x, y, z, *pose[:, 3], 1, name))), "" if i % 2 else "5.5 6.5 -1 1 2 3"]
    for file, text in (("cameras", camera), ("images", "\n".join(lines) + "\n"), ("points3D", "# none\n")):
        data = text.replace("\n", newline).encode(encoding, "surrogateescape")
        (folder / f"{file}.txt").write_bytes(data)
    return folder


@pytest.mark.parametrize(("encoding", "newline"), [
    ("utf-8", "\n"), ("utf-8-sig", "\n"), ("utf-8-sig", "\r\n"), ("utf-16", "\r\n"),
])  # fmt: skip
def test_names_in_colmap_s_text_reach_to_the_end_of_the_line(tmp_path: Path, encoding: str, newline: str):
    names = ["DSC 00 (2).jpg", "DSC 01 (2).jpg", "a/b  c.jpg", "back\\slash, 'x'.jpg"][: len(NAMES)]
    assert_reprojects(read_poses(text_model(tmp_path, names, encoding, newline)), opencv, names)


@pytest.mark.parametrize("photo", [
    "Käse 1.jpg", unicodedata.normalize("NFD", "Käse 1.jpg"), " x.jpg", "back\\slash.jpg", "ü" * 120 + ".jpg",
    os.fsdecode(b"f\xfcr.jpg"), "new\nline.jpg",
])  # fmt: skip
def test_photos_of_any_name_find_their_poses_in_any_spelling(tmp_path: Path, photo: str):
    spellings = {readable(photo), short_name(readable(photo)), unicodedata.normalize("NFD", readable(photo))}
    for spelling in spellings | ({photo} if "\n" not in photo else set()):
        poses = read_poses(text_model(tmp_path, [spelling]))
        assert set(match_photos(poses, [readable(photo)])) == {readable(photo)}


def test_case_08(cases_dir: Path):
    poses = read_poses(cases_dir / "08-colmap-names-with-spaces" / "sparse")
    photos = sorted(path.name for path in (cases_dir / "08-colmap-names-with-spaces" / "photos").iterdir())
    assert set(match_photos(poses, photos)) == set(photos)
    assert len(photos) == 24


def test_a_text_model_that_lacks_something_is_named(tmp_path: Path):
    text_model(tmp_path, NAMES)
    lines = (tmp_path / "images.txt").read_text().split("\n")
    for damaged in (lines[1].rsplit(" ", 2)[0], lines[1].replace(" 1 ", " 7 ")):
        (tmp_path / "images.txt").write_text("\n".join([damaged, *lines[2:]]))
        with pytest.raises(InputError, match=r"The COLMAP model .* cannot be read"):
            read_poses(tmp_path)
    (tmp_path / "cameras.txt").write_text(f"1 OPENCV {WIDTH} {HEIGHT} 1 2\n")
    with pytest.raises(InputError, match=r"The COLMAP model .* cannot be read"):
        read_poses(tmp_path)


def test_a_damaged_model_is_named(tmp_path: Path):
    (tmp_path / "cameras.bin").write_bytes(b"\x01")
    with pytest.raises(InputError, match="cannot be read"):
        read_poses(tmp_path)


# ---------------------------------------------------------------- transforms.json
def write_transforms(folder: Path, shared: dict, names: list[str], file: str = "transforms.json", **each) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    frames = [
        {"file_path": name, "transform_matrix": world_from_gl(i).tolist(), **{k: v[i] for k, v in each.items()}}
        for i, name in enumerate(names)
    ]
    (folder / file).write_text(json.dumps({**shared, "frames": frames}))
    return folder / file


OPENCV_KEYS = dict(zip(("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"), OPENCV, strict=True))
IMAGES = [f"images/{name}.png" for name in NAMES]
SIZE = {"w": WIDTH, "h": HEIGHT}


def test_nerfstudio_with_shared_intrinsics(tmp_path: Path):
    file = write_transforms(tmp_path, {"camera_model": "OPENCV", **SIZE, **OPENCV_KEYS}, IMAGES)
    assert locate_poses(tmp_path) == file
    poses = read_poses(tmp_path)
    assert_reprojects(poses, opencv, IMAGES)
    assert poses.region is None


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_transforms_of_any_editor(tmp_path: Path, encoding: str):
    file = write_transforms(tmp_path, OPENCV_KEYS | SIZE, IMAGES)
    file.write_bytes(file.read_text().replace("\n", "\r\n").encode(encoding))
    assert_reprojects(read_poses(file), opencv, IMAGES)


def test_intrinsics_of_frames_and_frames_in_any_order(tmp_path: Path):
    each = {key: [value] * NUM for key, value in {**OPENCV_KEYS, **SIZE}.items()}
    file = write_transforms(tmp_path, {"fl_x": 1.0}, IMAGES, **each)
    data = json.loads(file.read_text())
    data["frames"].reverse()
    file.write_text(json.dumps(data))
    assert_reprojects(read_poses(file), opencv, IMAGES)


def test_fisheye(tmp_path: Path):
    keys = dict(zip(("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4"), FISHEYE, strict=True))
    file = write_transforms(tmp_path, {"camera_model": "OPENCV_FISHEYE", **SIZE, **keys}, IMAGES)
    assert_reprojects(read_poses(file), fisheye, IMAGES)


def test_third_radial_coefficient(tmp_path: Path):
    file = write_transforms(tmp_path, {"fl_x": FOCAL, **SIZE, "k1": -0.1, "k3": 0.05}, IMAGES)
    expected = lambda uv: pinhole(uv * (1 - 0.1 * (uv**2).sum(1) + 0.05 * (uv**2).sum(1) ** 3)[:, None])  # noqa: E731
    assert_reprojects(read_poses(file), expected, IMAGES)


@pytest.mark.parametrize("applied_scale", [None, 0.25])
def test_applied_transform_is_undone(tmp_path: Path, applied_scale: float | None):
    """nerfstudio turns the world (z for y); poses come back in the original one."""
    applied = np.array([[1.0, 0, 0, 0.3], [0, 0, 1, -0.2], [0, -1, 0, 5]])
    file = write_transforms(tmp_path, {"fl_x": FOCAL, **SIZE, "applied_transform": applied.tolist()}, IMAGES)
    data = json.loads(file.read_text())
    for i, frame in enumerate(data["frames"]):
        moved = applied @ world_from_gl(i)
        moved[:, 3] *= applied_scale or 1.0
        frame["transform_matrix"] = [*moved.tolist(), [0, 0, 0, 1]]
    if applied_scale:
        data["applied_scale"] = applied_scale
    file.write_text(json.dumps(data))
    assert_reprojects(read_poses(file), pinhole, IMAGES)


def test_nerf_synthetic(tmp_path: Path):
    """Only an angle, paths without suffix, images with alpha; the size comes from the images."""
    names = [f"./train/r_{i}" for i in range(NUM)]
    write_images(tmp_path, [f"{name}.png" for name in names], alpha=True)
    write_images(tmp_path, ["test/r_0.png", "test/r_0_depth_0001.png"])
    angle = 2 * np.arctan(0.5 * WIDTH / FOCAL)
    write_transforms(tmp_path, {"camera_angle_x": angle}, names, "transforms_train.json")
    poses = read_poses(tmp_path)
    assert_reprojects(poses, pinhole, [f"train/r_{i}" for i in range(NUM)])
    assert poses.region is not None
    assert poses.region.radius == 1.5
    image_set = ingested(tmp_path, tmp_path / "out", poses=tmp_path / "transforms_train.json")
    assert [record.name for record in image_set.images] == [f"train/r_{i}.png" for i in range(NUM)]
    assert all(record.has_mask for record in image_set.images)
    assert {item.source: item.reason for item in image_set.skipped}["test/r_0.png"] == (
        "has no pose in transforms_train.json"
    )


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"fl_x": None}, "gives images/000.png no focal length"),
        ({"fl_x": "wide"}, "`fl_x` of images/000.png in .* is 'wide', expected a number"),
        ({"camera_model": "EQUIRECTANGULAR"}, "camera model EQUIRECTANGULAR of images/000.png"),
        ({"k4": 0.1}, "camera model OPENCV of images/000.png .* with k4"),
        ({"frames": []}, "has no `frames`"),
        ({"frames": [{"transform_matrix": []}]}, "Frame 0 of .* has no `file_path`"),
        ({"frames": [{"file_path": "a.png", "transform_matrix": [[1, 2]]}]}, r"is \(1, 2\), expected \(4, 4\)"),
        ({"frames": [{"file_path": "a.png"}]}, "`transform_matrix of a.png` in .* is no matrix"),
        ({"frames": [{"file_path": "a.png", "transform_matrix": (2 * np.eye(4)).tolist()}]}, "has no rotation"),
        ({"applied_transform": np.diag([1.0, 1, -1, 1])[:3].tolist()}, "no rotation with a scale"),
    ],
)
def test_what_a_transforms_file_may_lack(tmp_path: Path, changes: dict, sentence: str):
    file = write_transforms(tmp_path, {"fl_x": FOCAL, **SIZE}, IMAGES)
    data = {**json.loads(file.read_text()), **changes}
    file.write_text(json.dumps({key: value for key, value in data.items() if value is not None}))
    with pytest.raises(InputError, match=sentence):
        read_poses(file)


# ---------------------------------------------------------------- NeuS
def write_neus(folder: Path, images: list[str]) -> Path:
    write_images(folder / "image", images)
    for name in images:
        mask = np.zeros((HEIGHT, WIDTH), np.uint8)
        mask[:, 100:200] = 255
        (folder / "mask").mkdir(exist_ok=True)
        cv2.imwrite(str(folder / "mask" / f"{int(name.split('.')[0]):04d}.png"), mask)
    # the layout counts pixel centres at whole numbers
    intrinsics = np.array([[FOCAL, 0, WIDTH / 2 - 0.5], [0, FOCAL, HEIGHT / 2 - 0.5], [0, 0, 1]])
    world_from_unit = np.diag([0.8, 0.8, 0.8, 1.0])
    world_from_unit[:3, 3] = CENTER
    matrices = {}
    for i in range(len(images)):
        matrices[f"world_mat_{i}"] = np.vstack([-2.5 * intrinsics @ cam_from_world(i), [0, 0, 0, 1]])
        matrices[f"scale_mat_{i}"] = world_from_unit
        matrices[f"world_mat_inv_{i}"] = np.linalg.inv(matrices[f"world_mat_{i}"])
    np.savez(folder / "cameras_sphere.npz", **matrices)
    return folder / "cameras_sphere.npz"


def test_neus(tmp_path: Path):
    file = write_neus(tmp_path, [f"{name}.png" for name in NAMES])
    assert locate_poses(tmp_path) == file
    assert masks_beside(file) == tmp_path / "mask"
    poses = read_poses(file)
    assert_reprojects(poses, pinhole, [f"image/{name}.png" for name in NAMES])
    assert poses.region is not None
    np.testing.assert_allclose(poses.region.center, CENTER)
    assert poses.region.radius == pytest.approx(0.8)


@pytest.mark.parametrize("photos", [".", "image"])
def test_photos_of_neus_are_its_images_whichever_folder_is_named(tmp_path: Path, photos: str):
    data = tmp_path / "scan"
    file = write_neus(data, [f"{name}.png" for name in NAMES])
    image_set = ingested(data / photos, tmp_path / "out", masks=data / "mask", poses=file)
    prefix = "image/" if photos == "." else ""
    assert [record.name for record in image_set.images] == [f"{prefix}{name}.png" for name in NAMES]
    # masks are paired by their order, not by their names
    assert all(record.has_mask for record in image_set.images)
    assert {item.source for item in image_set.skipped} <= {"cameras_sphere.npz"}


def test_neus_with_another_number_of_images(tmp_path: Path):
    file = write_neus(tmp_path, [f"{name}.png" for name in NAMES])
    (tmp_path / "image" / "003.png").unlink()
    with pytest.raises(InputError, match=r"has 4 cameras, but .*image has 3 images"):
        read_poses(file)


# ---------------------------------------------------------------- NeRO
def write_nero(folder: Path) -> None:
    write_images(folder, [f"{i}.png" for i in range(NUM)])
    for i in range(NUM):
        depth = np.full((HEIGHT, WIDTH), 65535, np.uint16)
        depth[50:150, 60:160] = int(2.5 / 15 * 65535)
        cv2.imwrite(str(folder / f"{i}-depth.png"), depth)
        intrinsics = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]], np.float32)
        (folder / f"{i}-camera.pkl").write_bytes(pickle.dumps([cam_from_world(i), intrinsics]))


def test_nero(tmp_path: Path):
    data = tmp_path / "bell"
    write_nero(data)
    assert locate_poses(data) == data
    assert masks_beside(data) == data
    poses = read_poses(data)
    assert_reprojects(poses, pinhole, [f"{i}.png" for i in range(NUM)])
    image_set = ingested(data, tmp_path / "out", masks=data, poses=data)
    assert [record.name for record in image_set.images] == [f"{i}.png" for i in range(NUM)]
    mask = artifacts.Pictures(tmp_path / "out").mask("2.png")
    assert mask is not None
    expected = np.zeros((HEIGHT, WIDTH), np.uint8)
    expected[50:150, 60:160] = 255
    np.testing.assert_array_equal(mask, expected)


@pytest.mark.parametrize("protocol", range(pickle.HIGHEST_PROTOCOL + 1))
def test_arrays_are_read_whatever_the_pickle_s_protocol(tmp_path: Path, protocol: int):
    write_nero(tmp_path)
    pose, intrinsics = cam_from_world(0), np.diag([FOCAL, FOCAL, 1.0])
    (tmp_path / "0-camera.pkl").write_bytes(pickle.dumps((pose, intrinsics), protocol))
    np.testing.assert_allclose(read_poses(tmp_path).cameras[0].cam_from_world, pose, atol=1e-12)


def test_a_pickle_that_would_run_something_is_refused(tmp_path: Path):
    write_nero(tmp_path)

    class Evil:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "hacked"),)

    (tmp_path / "1-camera.pkl").write_bytes(pickle.dumps([cam_from_world(1), Evil()]))
    with pytest.raises(
        InputError, match=r"1-camera.pkl cannot be read \(it holds posix.mkdir; only arrays are taken\)"
    ):
        read_poses(tmp_path)
    assert not (tmp_path / "hacked").exists()


# ---------------------------------------------------------------- MVSNet
def write_mvsnet(folder: Path) -> Path:
    write_images(folder / "blended_images", [f"{i:08d}{what}.jpg" for i in range(NUM) for what in ("", "_masked")])
    (folder / "cams").mkdir()
    (folder / "cams" / "pair.txt").write_text("4\n")
    intrinsics = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    for i in range(NUM):
        rows = ["extrinsic", *map(_row, np.vstack([cam_from_world(i), [0, 0, 0, 1]])), ""]
        rows += ["intrinsic", *map(_row, intrinsics), "", "0.5 0.01 128 1.8"]
        (folder / "cams" / f"{i:08d}_cam.txt").write_text("\n".join(rows))
    return folder / "cams"


def _row(numbers: np.ndarray) -> str:
    return " ".join(f"{number:.12g}" for number in numbers)


def test_mvsnet(tmp_path: Path):
    cameras = write_mvsnet(tmp_path)
    for place in (tmp_path, cameras, cameras / "00000001_cam.txt"):
        assert locate_poses(place) == cameras
    assert_reprojects(read_poses(tmp_path), pinhole, [f"{i:08d}.jpg" for i in range(NUM)])
    image_set = ingested(tmp_path / "blended_images", tmp_path / "out", poses=cameras)
    assert [record.name for record in image_set.images] == [f"{i:08d}.jpg" for i in range(NUM)]


def test_a_camera_of_mvsnet_that_is_cut_off(tmp_path: Path):
    cameras = write_mvsnet(tmp_path)
    (cameras / "00000002_cam.txt").write_text("extrinsic\n1 0 0")
    with pytest.raises(InputError, match=r"00000002_cam.txt cannot be read"):
        read_poses(tmp_path)


# ---------------------------------------------------------------- Mega-NeRF
def write_meganerf(folder: Path) -> None:
    import torch

    write_images(folder / "rgbs", [f"{i:06d}.jpg" for i in range(NUM)])
    (folder / "metadata").mkdir()
    for i in range(NUM):
        camera = {
            "W": WIDTH,
            "H": HEIGHT,
            "intrinsics": torch.tensor([FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2]),
            "c2w": torch.from_numpy(world_from_gl(i)[:3]),
            "distortion": torch.zeros(4),
        }
        torch.save(camera, folder / "metadata" / f"{i:06d}.pt")


def test_meganerf(tmp_path: Path):
    write_meganerf(tmp_path / "train")
    assert locate_poses(tmp_path / "train") == tmp_path / "train"
    assert_reprojects(read_poses(tmp_path / "train"), pinhole, [f"rgbs/{i:06d}" for i in range(NUM)])
    image_set = ingested(tmp_path / "train" / "rgbs", tmp_path / "out", poses=tmp_path / "train")
    assert [record.name for record in image_set.images] == [f"{i:06d}.jpg" for i in range(NUM)]


def test_metadata_of_another_shape_is_refused(tmp_path: Path):
    import torch

    write_meganerf(tmp_path)
    torch.save({"W": 1, "H": 1, "intrinsics": torch.ones(3), "c2w": torch.eye(4)}, tmp_path / "metadata" / "000001.pt")
    with pytest.raises(InputError, match=r"holds c2w \(4, 4\) and intrinsics \(3,\), expected \(3, 4\) and \(4,\)"):
        read_poses(tmp_path)


# ---------------------------------------------------------------- what cannot be
@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"w": 1e300}, "pixels, each must be from 1 to"),
        ({"w": -3, "h": 7}, "is -3 x 7 pixels"),
        ({"w": True}, "`w` of .* is True, expected a number"),
        ({"fl_x": 0}, "no focal length"),
        ({"fl_x": 1e300}, "cannot be"),
        ({"fl_x": 1e-300}, "cannot be"),
        ({"fl_y": -5.0}, "cannot be"),
        ({"cx": 1e200}, "cannot be"),
        ({"k1": 1e100}, "cannot be"),
        ({"fl_x": None, "camera_angle_x": 0}, "angle of view"),
        ({"fl_x": None, "camera_angle_x": 5}, "angle of view"),
        ({"applied_scale": 0}, "`applied_scale` in .* is no number above 0"),
        ({"applied_scale": "2"}, "`applied_scale` in"),
        ({"applied_scale": [1, 2]}, "`applied_scale` in"),
        ({"applied_transform": 5}, "`applied_transform` in .* is no rotation"),
        ({"applied_transform": [[[1]]]}, "`applied_transform` in .* is no rotation"),
        ({"applied_transform": [[1], [1, 2]]}, "no matrix of numbers"),
        ({"frames": [{"file_path": ""}]}, "has no `file_path`"),
        ({"frames": [{"file_path": "."}]}, "is called '.'"),
        ({"frames": [{"file_path": "/"}]}, "is called '/'"),
        ({"frames": [{"file_path": "a\0.png"}]}, "is called"),
        ({"frames": [{"file_path": "a" * 10_000}]}, "is called"),
        ({"frames": {"a": 1}}, "has no `frames`"),
        ({"frames": [{"file_path": "a.png", "transform_matrix": [[10**400] * 4] * 4}]}, "computed with"),
        ({"frames": [{"file_path": "a.png", "transform_matrix": [[math.nan] * 4] * 4}]}, "NaN is no number"),
        ({"frames": [{"file_path": "a.png", "transform_matrix": [[0.0] * 4] * 4}]}, "has no rotation"),
        ({"frames": [{"file_path": "a.png", "transform_matrix": "eye"}]}, "no matrix of numbers"),
        ({"frames": [{"file_path": "a.png", "transform_matrix": [[1, 0, 0, 1e300], [0, 1, 0, 0], [0, 0, 1, 0]]}]},
         "away from the origin"),
    ],
)  # fmt: skip
def test_numbers_and_names_in_transforms_that_cannot_be(tmp_path: Path, changes: dict, sentence: str):
    frame = {"file_path": "a.png", "transform_matrix": world_from_gl(0).tolist()}
    data = {"fl_x": FOCAL, **SIZE, "frames": [frame], **changes}
    if isinstance(data["frames"], list):
        data["frames"] = [{**frame, **each} for each in data["frames"]]
    file = tmp_path / "transforms.json"
    file.write_text(json.dumps({key: value for key, value in data.items() if value is not None}))
    with pytest.raises(InputError, match=sentence) as caught:
        read_poses(file)
    assert len(caught.value.message) < 600


@pytest.mark.parametrize("text", ["", "[" * 100_000, '{"a":' * 50_000, "9" * 5000, "null", "\0", "{", '"a"', "[1, 2]"])
def test_what_is_no_json_of_poses(tmp_path: Path, text: str):
    (tmp_path / "transforms.json").write_text(text)
    with pytest.raises(InputError, match=r"cannot be read|has no `frames`"):
        read_poses(tmp_path)


def test_images_that_poses_name_are_pictures_in_files(tmp_path: Path):
    """A size that is not said is looked up; a pipe would be waited for."""
    for name, target in (("pipe.png", None), ("zero.png", "/dev/zero"), ("eps.png", "%!PS-Adobe-3.0 EPSF-3.0\n")):
        write_transforms(tmp_path, {"camera_angle_x": 1.0}, [name])
        if target is None:
            os.mkfifo(tmp_path / name)
        elif target.startswith("/"):
            (tmp_path / name).symlink_to(target)
        else:
            (tmp_path / name).write_text(target)
        with pytest.raises(InputError, match="does not say how large its images are"):
            read_poses(tmp_path)


def binary_model(folder: Path) -> Path:
    """As COLMAP writes it; two images with features."""
    from stages.geometry.cameras import PinholeCameras
    from stages.posing.colmap_model import pinhole_model

    sizes = np.tile([WIDTH, HEIGHT], (2, 1))
    intrinsics = np.tile(np.array([[FOCAL, 0, 160.0], [0, FOCAL, 120], [0, 0, 1]]), (2, 1, 1))
    cameras = PinholeCameras(("a b.jpg", "c.jpg"), sizes, intrinsics, np.stack([cam_from_world(i) for i in range(2)]))
    folder.mkdir(exist_ok=True)
    pinhole_model(cameras, [np.ones((3, 2)), np.zeros((0, 2))]).write_binary(str(folder))
    return folder


def test_a_binary_model_of_two_images(tmp_path: Path):
    assert_reprojects(read_poses(binary_model(tmp_path)), pinhole, ["a b.jpg", "c.jpg"])


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin"])
def test_binary_models_are_read_no_further_than_they_reach(tmp_path: Path, name: str):
    """Cut off anywhere, and with counts of 2^60 anywhere: COLMAP's own reader takes memory for them, or crashes."""
    file = binary_model(tmp_path) / name
    whole = file.read_bytes()
    for end in range(len(whole)):
        file.write_bytes(whole[:end])
        with pytest.raises(InputError, match="cannot be read"):
            read_poses(tmp_path)
    refused = 0
    for at in range(len(whole) - 8):
        file.write_bytes(whole[:at] + b"\0\0\0\0\0\0\0\x10" + whole[at + 8 :])
        try:
            read_poses(tmp_path)
        except InputError:
            refused += 1
    assert refused > len(whole) / 10


@pytest.mark.parametrize(
    ("changed", "sentence"),
    [
        (lambda text: text.replace("OPENCV", "LENS"), "is of model LENS with 8"),
        (lambda text: text.replace("OPENCV", "PINHOLE"), "is of model PINHOLE with 8"),
        (lambda text: text.replace(" 240 ", " 1000000000 "), "each must be from 1"),
        (lambda text: text.replace(" 240 ", f" {'9' * 5000} "), "cannot be read"),
        (lambda text: text.replace(" 163.0 ", " nan "), "cannot be"),
        (lambda text: re.sub(r"(?m)^1 \S+ \S+ \S+ \S+ ", "1 0 0 0 0 ", text), "cannot be read"),
        (lambda text: re.sub(r"(?m)^1 \S+ (\S+ \S+ \S+) ", r"1 nan \1 ", text), r"cannot be read|not finite"),
        (lambda text: re.sub(r"(?m)^(1(?: \S+){6}) \S+ 1 ", r"\1 1e300 1 ", text), "away from the origin"),
        (lambda text: text.replace(" 000.jpg", " /"), "is called '/'"),
        (lambda text: text.replace(" 000.jpg", ""), "cannot be read"),
    ],
)
def test_numbers_in_a_text_model_that_cannot_be(tmp_path: Path, changed: Callable[[str], str], sentence: str):
    folder = text_model(tmp_path, [f"{name}.jpg" for name in NAMES])
    for name in ("cameras.txt", "images.txt"):
        (folder / name).write_text(changed((folder / name).read_text()))
    with pytest.raises(InputError, match=sentence):
        read_poses(folder)


def test_quaternions_of_any_length(tmp_path: Path):
    """COLMAP brings them to length 1."""
    folder = text_model(tmp_path, [f"{name}.jpg" for name in NAMES])
    lines = (folder / "images.txt").read_text().splitlines()
    for i, line in enumerate(lines):
        words = line.split()
        if line.endswith(".jpg"):
            lines[i] = " ".join([words[0], *(str(2 * float(word)) for word in words[1:5]), *words[5:]])
    (folder / "images.txt").write_text("\n".join(lines))
    assert_reprojects(read_poses(folder), opencv, [f"{name}.jpg" for name in NAMES])


def npy(header: str, data: bytes = b"") -> bytes:
    return b"\x93NUMPY\1\0" + struct.pack("<H", len(header) + 1) + header.encode() + b"\n" + data


SHAPED = "{{'descr': '{}', 'fortran_order': False, 'shape': {}, }}"


@pytest.mark.parametrize(
    ("member", "sentence"),
    [
        (npy(SHAPED.format("<f8", "(1000000000000,)"), bytes(128)), "says that it is .* but has 128 bytes"),
        (npy(SHAPED.format("|V0", "(1000000000000,)")), "numbers are needed"),
        (npy(SHAPED.format("|O", "(1,)"), pickle.dumps([1])), "numbers are needed"),
        (npy(SHAPED.format("<f8", "(-1,)")), "says that it is"),
        (npy(SHAPED.format("<f8", "(4, 4)"), bytes(128)), "numbers that are not finite|cannot be"),
        (npy(SHAPED.format("<f8", "(3, 4)"), bytes(96)), r"no 4 x 4 matrix \(\(3, 4\)"),
        (npy(SHAPED.format("<f8", "(4, 4)"), np.full((4, 4), 1e300).tobytes()), r"cannot|not finite|no rotation"),
        (npy("(" * 5000), "cannot be read"),
        (b"", "cannot be read"),
        (bytes(100_000_000), "unpacks to 100000198 bytes, at most"),
    ],
)
def test_arrays_that_lie(tmp_path: Path, member: bytes, sentence: str):
    file = write_neus(tmp_path, ["0.png"])
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("world_mat_0.npy", member)
        archive.writestr("scale_mat_0.npy", npy(SHAPED.format("<f8", "(4, 4)"), np.eye(4).tobytes()))
    with pytest.raises(InputError, match=sentence):
        read_poses(file)
    file.write_bytes(b"")
    with pytest.raises(InputError, match="cannot be read"):
        read_poses(file)


class Named:
    """Pickled as a call of any function."""

    def __init__(self, call: Callable[..., object], *given: object) -> None:
        self.call = call, given

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\x80\x04r\xff\xff\xff\x7f.",  # the memo at 2^31: C takes 16 GB for it
        b"\x80\x04\x8e" + struct.pack("<Q", 1 << 60) + b"x.",  # bytes of 2^60
        b"]" + b"q\0(h\0h\0l" * 40 + b".",  # lists of lists that are one
        b"(" * 100_000 + b"l" * 100_000 + b".",
        pickle.dumps((1, 2)),
        pickle.dumps({"a": 1}),
        pickle.dumps((np.array([None]), np.eye(3))),
        pickle.dumps((np.eye(3, 4) * np.nan, np.eye(3))),
        pickle.dumps((np.eye(3, 4), np.zeros((3, 3)))),
        pickle.dumps((np.zeros((3, 4)), np.diag([FOCAL, FOCAL, 1]))),
        pickle.dumps((Named(np.ndarray, (10**12,)), Named(np.ndarray, (10**12,)))),
        pickle.dumps((Named(codecs.encode, b"a", "hex"), 1)),
    ],
)
def test_pickles_that_cannot_be(tmp_path: Path, data: bytes):
    write_nero(tmp_path)
    (tmp_path / "0-camera.pkl").write_bytes(data)
    with pytest.raises(InputError, match=r"0\.png|0-camera"):
        read_poses(tmp_path)


def test_tensors_that_cannot_be(tmp_path: Path):
    import torch

    write_meganerf(tmp_path)
    file = tmp_path / "metadata" / "000000.pt"
    whole = torch.load(file)
    wide = torch.zeros(1).as_strided((10**6, 10**6), (0, 0))  # 4 bytes
    for key, value in (("c2w", wide), ("W", wide), ("W", 10**400), ("H", math.nan), ("c2w", whole["c2w"] * math.nan),
                       ("c2w", [[1.0]]), ("W", 0)):  # fmt: skip
        torch.save({**whole, key: value}, file)
        with pytest.raises(InputError, match="000000"):
            read_poses(tmp_path)
    torch.save({**whole, "c2w": Named(os.mkdir, str(tmp_path / "hacked"))}, file)
    with pytest.raises(InputError, match="more than tensors and plain values"):
        read_poses(tmp_path)
    torch.save(whole, file, _use_new_zipfile_serialization=False)
    with pytest.raises(InputError, match="not a zip file"):
        read_poses(tmp_path)
    assert not (tmp_path / "hacked").exists()


@pytest.mark.parametrize("word", ["nan", "inf", "1e300", "x", "0", ""])
def test_numbers_of_mvsnet_that_cannot_be(tmp_path: Path, word: str):
    file = next(write_mvsnet(tmp_path).glob("*_cam.txt"))
    words = file.read_text().split()
    file.write_text(" ".join([*words[:1], *[word] * 3, *words[4:]]))
    with pytest.raises(InputError, match=file.name):
        read_poses(tmp_path)


# ---------------------------------------------------------------- finding and matching
def test_no_poses_there(tmp_path: Path):
    with pytest.raises(InputError, match="There are no poses at"):
        locate_poses(tmp_path / "nothing")
    with pytest.raises(InputError, match="No poses were found in"):
        locate_poses(tmp_path)
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(InputError, match="is no file of poses"):
        locate_poses(tmp_path / "notes.txt")


def known(*names: str) -> KnownPoses:
    pose = cam_from_world(0)
    return KnownPoses(
        Path("poses.json"),
        tuple(KnownCamera(n, (WIDTH, HEIGHT), "PINHOLE", (90.0, 90.0, 48.0, 36.0), pose) for n in names),
    )


@pytest.mark.parametrize(
    ("cameras", "photos", "expected"),
    [
        (["a.jpg", "b.jpg"], ["a.jpg", "b.jpg", "c.jpg"], {"a.jpg": "a.jpg", "b.jpg": "b.jpg"}),
        (["a.jpg"], ["images/a.jpg"], {"images/a.jpg": "a.jpg"}),
        (["images/a.jpg"], ["a.png"], {"a.png": "images/a.jpg"}),
        (["image/0.png"], ["image/0.png", "mask/0.png"], {"image/0.png": "image/0.png"}),
        (["train/r_0", "test/r_0"], ["train/r_0.png", "test/r_0.png"],
         {"train/r_0.png": "train/r_0", "test/r_0.png": "test/r_0"}),
        (["train/r_0", "test/r_0"], ["test/r_0.png"], {"test/r_0.png": "test/r_0"}),
        (["a.jpg"], ["a.jpg", "a.png"], {"a.jpg": "a.jpg"}),
        (["frame.0001", "frame.0002"], ["frame.0002.png"], {"frame.0002.png": "frame.0002"}),
    ],
)  # fmt: skip
def test_names_that_agree(cameras: list[str], photos: list[str], expected: dict[str, str]):
    assert {photo: camera.name for photo, camera in match_photos(known(*cameras), photos).items()} == expected


def test_names_that_do_not_agree():
    with pytest.raises(InputError, match="There are no photos") as none:
        match_photos(known("x.jpg"), [])
    assert "x.jpg" in none.value.hint
    with pytest.raises(
        InputError, match=r"None of the 2 photos has a pose in poses.json: it names 1 images, e.g. x.jpg"
    ):
        match_photos(known("x.jpg"), ["a.jpg", "b.jpg"])
    with pytest.raises(InputError, match=r"fits 2 photos: left/a.jpg, right/a.jpg"):
        match_photos(known("a.jpg"), ["left/a.jpg", "right/a.jpg"])
    with pytest.raises(InputError, match=r"has two poses for a.jpg"):
        known("a.jpg", "a.jpg")
    with pytest.raises(InputError, match="has no poses"):
        known()


# ---------------------------------------------------------------- ingest
def ingested(photos: Path, out: Path, params: IngestParams | None = None, **sources: Path) -> artifacts.ImageSet:
    out.mkdir()
    context = StageContext({}, {"photos": photos, **sources}, out, out, params or IngestParams(), workers=1)
    INGEST.run(context)
    return artifacts.IMAGE_SET.load(out)


def test_photos_without_pose_and_poses_without_photo_are_named_and_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    write_images(tmp_path / "photos" / "images", [f"{name}.png" for name in NAMES])
    (tmp_path / "photos" / "images" / "003.png").rename(tmp_path / "photos" / "images" / "extra.png")
    file = write_transforms(tmp_path, {"fl_x": FOCAL, **SIZE}, IMAGES)
    image_set = ingested(tmp_path / "photos", tmp_path / "out", poses=file)
    assert [record.name for record in image_set.images] == IMAGES[:3]
    assert "left out images/extra.png: has no pose in transforms.json" in caplog.text
    assert "1 of 4 poses in transforms.json have no photo: images/003.png" in caplog.text


def test_photos_that_are_left_out_are_no_poses_without_a_photo(tmp_path: Path, caplog: pytest.LogCaptureFixture):
    write_images(tmp_path / "photos" / "images", [f"{name}.png" for name in NAMES])
    file = write_transforms(tmp_path, {"fl_x": FOCAL, **SIZE}, IMAGES)
    image_set = ingested(
        tmp_path / "photos", tmp_path / "out", IngestParams(leave_out=("images/00[13].png",), min_images=2), poses=file
    )
    assert [record.name for record in image_set.images] == [IMAGES[0], IMAGES[2]]
    assert {item.source for item in image_set.skipped} == {IMAGES[1], IMAGES[3]}
    assert "have no photo" not in caplog.text


def test_too_few_photos_with_a_pose(tmp_path: Path):
    write_images(tmp_path / "photos", [f"images/{name}.png" for name in ("000", "001", "x", "y")])
    file = write_transforms(tmp_path, {"fl_x": FOCAL, **SIZE}, IMAGES)
    with pytest.raises(
        InputError, match=r"Found 2 usable photos .* need at least 3.* 2 x has no pose in transforms.json"
    ):
        ingested(tmp_path / "photos", tmp_path / "out", poses=file)


def test_the_region_is_that_of_the_file_where_there_are_no_masks():
    from stages.geometry.cameras import PinholeCameras
    from stages.geometry.region import RegionOfInterest, find_region

    facing_one_way = PinholeCameras(
        names=("a", "b"),
        sizes=np.array([[WIDTH, HEIGHT]] * 2),
        intrinsics=np.array([[[FOCAL, 0, 160], [0, FOCAL, 120], [0, 0, 1]]] * 2),
        extrinsics=np.stack([np.c_[np.eye(3), [x, 0, 0]] for x in (0.0, 1.0)]),
    )
    nothing = np.zeros((0, 3))
    with pytest.raises(ValueError, match="got 0 sparse points"):
        find_region(facing_one_way, nothing)
    stated = RegionOfInterest(CENTER, 2.0, "object", "the file")
    assert find_region(facing_one_way, nothing, stated=stated) is stated


@pytest.mark.parametrize(("radius", "source"), [(1.0, "the visual hull of the masks"), (0.3, "the file")])
def test_of_hull_and_stated_region_the_smaller_is_taken(radius: float, source: str):
    from stages.geometry.cameras import PinholeCameras
    from stages.geometry.region import RegionOfInterest, find_region

    cameras = PinholeCameras(
        names=tuple(NAMES),
        sizes=np.array([[WIDTH, HEIGHT]] * NUM),
        intrinsics=np.array([[[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]] * NUM),
        extrinsics=np.stack([cam_from_world(i) for i in range(NUM)]),
    )
    x, y = np.meshgrid(np.arange(WIDTH) - WIDTH / 2, np.arange(HEIGHT) - HEIGHT / 2)
    masks = [np.hypot(x, y) < 50] * NUM  # a ball of about 0.46
    stated = RegionOfInterest(CENTER, radius, "object", "the file")
    assert find_region(cameras, np.zeros((0, 3)), masks=masks, stated=stated).source == source


# ---------------------------------------------------------------- a real set
@pytest.mark.data
def test_silhouettes_of_a_real_set_agree_with_its_cameras(data_dir: Path):
    """More of the file's sphere lies in all silhouettes than with the cameras in another order, or not at all."""
    cameras, masks, region = real_set(data_dir / "dtu_scan24")
    axes = [np.linspace(-1, 1, 20)] * 3
    grid = np.stack(np.meshgrid(*axes), -1).reshape(-1, 3)
    points = region.center + region.radius * grid[np.linalg.norm(grid, axis=1) < 1]

    def share(order: np.ndarray) -> float:
        outside = np.zeros(len(points))
        for mask, camera in zip(masks, order, strict=True):
            pixels, depth = cameras.project(int(camera), points)
            column, row = np.floor(pixels).astype(int).T
            inside = (depth > 0) & (row >= 0) & (column >= 0) & (row < mask.shape[0]) & (column < mask.shape[1])
            outside[inside] += ~mask[row[inside], column[inside]]
        return float((outside <= 0.05 * len(masks)).mean())

    order = np.arange(len(masks))
    right = share(order)
    assert right > 0.1
    assert all(share(np.roll(order, turn)) < 0.8 * right for turn in (7, 24))


@pytest.mark.data
@pytest.mark.slow
def test_points_of_a_real_set_fit_its_cameras(data_dir: Path, tmp_path: Path):
    """A mean reprojection error under a pixel, which cameras with other axes or another order could not give."""
    from configs.params import SfmParams
    from stages.artifacts import ImageRecord
    from stages.posing.triangulation import triangulate

    root = data_dir / "dtu_scan24"
    chosen = {
        camera.name: (camera, ImageRecord(camera.name, camera.name, *camera.size, None, "", 1.0, False, ""))
        for camera in read_poses(root).cameras[:4]
    }
    params = SfmParams(max_features=2000, max_image_size=800)
    model, _ = triangulate(tmp_path, root, chosen, params, 1, 2, cuda=False, progress=lambda *progress: None)
    assert model.num_points3D() > 50
    assert model.compute_mean_reprojection_error() < 0.8


def real_set(root: Path):
    """Pinhole cameras, masks and the stated region of a set in the layout of NeuS."""
    from stages.geometry.cameras import PinholeCameras

    poses = read_poses(root)
    masks = [cv2.imread(str(poses.masks[camera.name]), cv2.IMREAD_GRAYSCALE) > 127 for camera in poses.cameras]
    intrinsics = [
        [[camera.params[0], 0, camera.params[2]], [0, camera.params[1], camera.params[3]], [0, 0, 1]]
        for camera in poses.cameras
    ]
    cameras = PinholeCameras(
        names=tuple(camera.name for camera in poses.cameras),
        sizes=np.array([camera.size for camera in poses.cameras]),
        intrinsics=np.array(intrinsics),
        extrinsics=np.stack([camera.cam_from_world for camera in poses.cameras]),
    )
    return cameras, masks, poses.region
