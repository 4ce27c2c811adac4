"""A capture whose projections are known exactly: white dots on black photos through lenses that distort."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from configs.params import PlaceParams, UndistortParams
from stages import artifacts
from stages.artifacts import ImageRecord, ImageSet
from stages.engine.stage import StageContext
from stages.geometry.cameras import PosedScene
from stages.place import PLACE
from stages.undistort import UNDISTORT

WIDTH, HEIGHT, FOCAL = 320, 240, 300.0
CENTER, UP = np.array([2.0, -1.0, 0.5]), np.array([0.0, -1.0, 0.0])  # COLMAP's world often has y down
BALL = 0.6  # radius of the ball the masks show
DOTS = CENTER + np.array([[0, 0, 0], [0.4, 0, 0], [0, 0.4, 0], [0, 0, -0.4], [-0.3, -0.3, 0], [0.2, -0.4, 0.3]])
NUM_CAMERAS = 8
NOT_MOVED = np.zeros(3)
# What the ball floats above: dots that it hides, or that lie out of the frame, are no features.
_AROUND = np.random.default_rng(0).uniform(-1, 1, (200, 3)) * [1.0, 0.0, 1.0] + [0.0, 0.7, 0.0]


def cam_from_world(index: int, shift: np.ndarray = NOT_MOVED) -> np.ndarray:
    angle = 2 * np.pi * index / NUM_CAMERAS
    offset = np.array([3.0 * np.cos(angle), -1.2, 3.0 * np.sin(angle)])
    z = -offset / np.linalg.norm(offset)
    x = np.cross(z, UP)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    return np.concatenate([rotation, -(rotation @ (CENTER + shift + offset))[:, None]], 1)


def write_capture(
    root: Path,
    model_name: str,
    parameters: list[float],
    masks: bool,
    shift: np.ndarray = NOT_MOVED,
    table: float | None = None,
) -> dict[str, Path]:
    """Ingest and sfm folders: black photos with a white dot where each point projects, and masks of the ball.

    The whole world may be moved by a shift. A table below the ball, which is not drawn, has features, and such a part
    of them are points of the model; None: no features.
    """
    import pycolmap

    ingest, sfm = root / "ingest", root / "sfm"
    camera = pycolmap.Camera.create_from_model_name(1, model_name, FOCAL, WIDTH, HEIGHT)
    camera.camera_id = 1
    camera.params = parameters
    model = pycolmap.Reconstruction()
    model.add_camera_with_trivial_rig(camera)

    x, y = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    pixels = np.stack([x.ravel(), y.ravel()], 1)
    rays = np.concatenate([np.asarray(camera.cam_from_img(pixels)), np.ones((len(pixels), 1))], 1)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    records = []
    around = CENTER + _AROUND[: 0 if table is None else None]
    seen_around: list[list[tuple[int, int]]] = [[] for _ in around]
    for i in range(NUM_CAMERAS):
        pose, name = cam_from_world(i, shift), f"photo_{i}.jpg"
        at = np.asarray(camera.img_from_cam((DOTS + shift) @ pose[:, :3].T + pose[:, 3]))
        features = list(at)
        for k, dot in enumerate(around + shift):
            local = pose[:, :3] @ dot + pose[:, 3]
            u, v = np.asarray(camera.img_from_cam(local[None]))[0]
            ball, way = pose[:, :3] @ (CENTER + shift) + pose[:, 3], local / np.linalg.norm(local)
            if 0 <= u < WIDTH and 0 <= v < HEIGHT and np.linalg.norm(ball - (way @ ball) * way) > 1.1 * BALL:
                seen_around[k].append((i + 1, len(features)))
                features.append(np.array([u, v]))
        photo = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        for dot in at:
            distance = np.hypot(x - dot[0], y - dot[1])
            photo = np.maximum(photo, (255 * np.clip(3.5 - distance, 0, 1))[..., None].astype(np.uint8))
        path = artifacts.Pictures(ingest).path(name)
        path.parent.mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(path), photo, [cv2.IMWRITE_JPEG_QUALITY, 100])
        if masks:
            center = pose[:, :3] @ (CENTER + shift) + pose[:, 3]
            miss = np.linalg.norm(center - (rays @ center)[:, None] * rays, axis=1)
            path = artifacts.Pictures(ingest).mask_path(name)
            path.parent.mkdir(parents=True, exist_ok=True)
            assert cv2.imwrite(str(path), (miss < BALL).reshape(HEIGHT, WIDTH).astype(np.uint8) * 255)
        records.append(ImageRecord(name, name, WIDTH, HEIGHT, None, "camera", 1.0, masks, str(i)))
        image = pycolmap.Image(name, pycolmap.Point2DList([pycolmap.Point2D(p) for p in features]), 1, i + 1)
        pose3d = pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:, :3]), pose[:, 3])
        model.add_image_with_trivial_frame(image, pose3d)
    for k, dot in enumerate(DOTS):
        track = pycolmap.Track()
        for i in range(NUM_CAMERAS):
            track.add_element(i + 1, k)
        model.add_point3D(dot + shift, track, np.zeros(3, np.uint8))
    for dot, seen in list(zip(around, seen_around, strict=True))[: round((table or 0) * len(around))]:
        track = pycolmap.Track()
        for element in seen:
            track.add_element(*element)
        model.add_point3D(dot + shift, track, np.zeros(3, np.uint8))
    artifacts.IMAGE_SET.save(ingest, ImageSet(tuple(records)))
    folder = artifacts.MODEL.load(sfm)
    folder.mkdir(parents=True)
    model.write(str(folder))
    contents = {record.name: record.sha256 for record in records}
    artifacts.PHOTO_CONTENTS.save(sfm, artifacts.PhotoContents(lineage="first", contents=contents))
    return {"ingest": ingest, "sfm": sfm}


def undistort(
    inputs: dict[str, Path], root: Path, previous: Path | None = None, **params: object
) -> tuple[PosedScene, Path, dict[str, object]]:
    """Place and undistort, after a `previous` run; settings of either. Scene, folder and numbers of both."""
    out, place = root / "undistort", root / "place"
    for folder in (out, place):
        folder.mkdir()
    placing = PlaceParams(**{key: params[key] for key in params if key in PlaceParams.model_fields})  # type: ignore[arg-type]
    rest = UndistortParams(**{key: params[key] for key in params if key not in PlaceParams.model_fields})  # type: ignore[arg-type]
    placed = PLACE.run(StageContext(inputs, {}, place, root, placing))
    context = StageContext({**inputs, "place": place}, {}, out, root, rest, workers=2, previous=previous)
    numbers = UNDISTORT.run(context)
    return (
        artifacts.FIRST_SCENE.load(out),
        out,
        {**numbers, **{key: value for key, value in placed.items() if value != ""}},
    )


def dots_seen(photo: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Centroid of the white pixels around each expected position [P, 2] (pixel centres at .5)."""
    found = []
    for u, v in expected:
        x0, y0 = int(u) - 6, int(v) - 6
        patch = photo[y0 : y0 + 13, x0 : x0 + 13].astype(float)
        patch[patch < 20] = 0
        y, x = np.mgrid[: patch.shape[0], : patch.shape[1]]
        found.append([x0 + 0.5 + (x * patch).sum() / patch.sum(), y0 + 0.5 + (y * patch).sum() / patch.sum()])
    return np.array(found)


MODELS = [
    ("SIMPLE_PINHOLE", [FOCAL, WIDTH / 2, HEIGHT / 2]),
    ("SIMPLE_RADIAL", [FOCAL, WIDTH / 2, HEIGHT / 2, -0.15]),
    ("SIMPLE_RADIAL", [FOCAL, WIDTH / 2, HEIGHT / 2, 0.12]),
    ("OPENCV", [FOCAL, 1.02 * FOCAL, WIDTH / 2 + 6, HEIGHT / 2 - 4, -0.1, 0.02, 0.002, -0.001]),
]
