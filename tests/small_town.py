"""A strip of land with a few houses, photographed from the air: small, textured all over, with poses that are known."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from stages import artifacts
from stages.drawing.rendering import look_at
from stages.engine.stage import StageContext
from stages.scenes.photo_files import write_truth

SIZE, FOCAL = (240, 180), 200.0
LAND = np.array([[0.0, 0.0], [6.0, 3.0]])  # lowest and highest corner on the ground
HEIGHT = 3.0  # of the flight
HOUSES = ((1.2, 0.9, 0.5), (2.9, 2.0, 0.8), (4.6, 1.0, 0.6))  # x, y and height; all are 0.7 wide
WIDTH = 0.7


def town() -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and faces [F, 3]: land that goes on beyond what is flown over, and houses on it."""
    import trimesh

    beyond = 4.0
    low, high = LAND[0] - beyond, LAND[1] + beyond
    ground = trimesh.Trimesh(
        [[low[0], low[1], 0], [high[0], low[1], 0], [high[0], high[1], 0], [low[0], high[1], 0]], [[0, 1, 2], [0, 2, 3]]
    )
    houses = []
    for x, y, height in HOUSES:
        house = trimesh.creation.box((WIDTH, WIDTH, height))
        house.apply_translation((x, y, height / 2))
        houses.append(house)
    mesh = trimesh.util.concatenate([ground, *houses])
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def flight(columns: int = 8, rows: int = 3) -> np.ndarray:
    """[N, 4, 4] world-to-camera: along the strip and back, tilted to one side and the other in turn."""
    poses = []
    for row, y in enumerate(np.linspace(0.4, 2.6, rows)):
        for column, x in enumerate(np.linspace(0.3, 5.7, columns)):
            lean = np.array([0.7, 0.4, 0]) * (1 if (row + column) % 2 else -1)
            center = np.array([x, y, HEIGHT])
            pose = np.eye(4)
            pose[:3] = look_at(center - lean, np.array([x, y, 0.0]), np.array([0, 1.0, 0]), 1, 1).extrinsics[0]
            poses.append(pose)
    return np.array(poses)


def photograph(folder: Path, columns: int = 8, rows: int = 3) -> Path:
    """Write `photos/*.png` and `transforms.json` beside them; returns the folder of the photos."""
    import open3d as o3d

    from stages.surface.triangle_mesh import face_normals, raycaster

    vertices, faces = town()
    scene = raycaster(vertices.astype(np.float32), faces.astype(np.int32))
    normals = face_normals(vertices, faces)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    poses = flight(columns, rows)
    names = [f"photos/{i:03d}.png" for i in range(len(poses))]
    (folder / "photos").mkdir(parents=True)
    for name, pose in zip(names, poses, strict=True):
        u, v = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
        rays = np.stack([(u - SIZE[0] / 2) / FOCAL, (v - SIZE[1] / 2) / FOCAL, np.ones_like(u)], -1) @ pose[:3, :3]
        center = -pose[:3, :3].T @ pose[:3, 3]
        sent = np.concatenate([np.broadcast_to(center, rays.shape), rays], -1).astype(np.float32)
        hit = scene.cast_rays(o3d.core.Tensor(sent))
        places = center + hit["t_hit"].numpy()[..., None] * rays
        facing = np.abs(normals[np.minimum(hit["primitive_ids"].numpy(), len(faces) - 1).astype(int)])
        Image.fromarray(_painted(places, facing)).save(folder / name)
    write_truth(folder, names, poses, SIZE, FOCAL, {"made_by": "small_town"})
    return folder / "photos"


def _painted(places: np.ndarray, facing: np.ndarray) -> np.ndarray:
    """Colours [H, W, 3] uint8 of points: blotches of three sizes, each side of a house shaded by where it faces."""
    value = np.zeros(places.shape[:2])
    for size, strength, seed in ((0.45, 0.5, 1), (0.16, 0.9, 2), (0.07, 0.8, 3)):
        value += strength * _noise(np.nan_to_num(places) / size, seed)
    shade = 0.6 + 0.4 * facing @ np.array([0.4, 0.7, 1.0])
    tint = np.stack([0.9 + 0.1 * np.sin(3 * places[..., 0]), np.ones_like(value), 0.8 + 0.2 * facing[..., 0]], -1)
    colour = np.clip((0.5 + 0.33 * value)[..., None] * shade[..., None] * tint, 0, 1)
    return (255 * np.nan_to_num(colour)).astype(np.uint8)


def _noise(places: np.ndarray, seed: int) -> np.ndarray:
    """Smooth noise in -1..1: values at whole numbers, and between them trilinear."""
    low = np.floor(places).astype(np.int64)
    part = places - low
    total = np.zeros(places.shape[:-1])
    for corner in np.ndindex(2, 2, 2):
        at = low + corner
        mixed = (at @ np.array([73856093, 19349663, 83492791]) + seed * 2654435761) & 0xFFFFFFFF
        mixed = (mixed ^ (mixed >> 15)) * 2246822519 & 0xFFFFFFFF
        mixed = (mixed ^ (mixed >> 13)) * 3266489917 & 0xFFFFFFFF
        weight = np.where(corner, part, 1 - part).prod(-1)
        total += weight * ((mixed >> 8 & 0xFFFF) / 32767.5 - 1)
    return total


# ---------------------------------------------------------------- a workspace of it, without looking at any photo
def points_on_town(count: int = 1500, seed: int = 0) -> np.ndarray:
    """Points [count, 3] on the land about the strip and on the roofs."""
    rng = np.random.default_rng(seed)
    (left, low), (right, high) = LAND[0] - 1, LAND[1] + 1
    points = np.column_stack([rng.uniform(left, right, count), rng.uniform(low, high, count), np.zeros(count)])
    for x, y, height in HOUSES:
        points[(np.abs(points[:, :2] - (x, y)) < WIDTH / 2).all(1), 2] = height
    return points


def town_workspace(root: Path, masks: bool = False, **place: object) -> Path:
    """`root`, in which ingest and sfm have left what they would have, and place has run; grey photos beside it."""
    from dataclasses import replace

    from configs.params import Config, PlaceParams
    from stages.engine.runner import run_pipeline
    from stages.engine.workspace import Workspace
    from stages.pipeline import PIPELINE

    photos = root.parent / f"{root.name}_photos"
    photos.mkdir()
    left = {"ingest": partial(_leave_photos, masks), "sfm": _leave_model}
    run_pipeline(
        [replace(stage, run=left.get(stage.name, stage.run)) for stage in PIPELINE],
        Workspace.open(root, create=True),
        Config(place=PlaceParams(**place)),
        {"photos": photos},
        until="place",
    )
    return root


def _leave_photos(masks: bool, context: StageContext) -> dict[str, Any]:
    pictures, records = context.to_write(artifacts.PHOTOS), []
    for i in range(len(flight())):
        name = f"row_{i // 8}/{i:03d}.png"
        pictures.path(name).parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", SIZE, (i, 90, 90)).save(pictures.path(name))
        if masks:
            mask = np.zeros(SIZE[::-1], np.uint8)
            mask[40:140, 60:200] = 255
            pictures.mask_path(name).parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(mask).save(pictures.mask_path(name))
        records.append(artifacts.ImageRecord(name, name, *SIZE, FOCAL, "camera", 1.0, masks, str(i)))
    context.write(artifacts.IMAGE_SET, artifacts.ImageSet(tuple(records)))
    return {}


def _leave_model(context: StageContext) -> dict[str, Any]:
    import pycolmap

    points, poses = points_on_town(), flight()
    model = pycolmap.Reconstruction()
    lens = pycolmap.Camera(
        model="SIMPLE_RADIAL",
        width=SIZE[0],
        height=SIZE[1],
        params=[FOCAL, SIZE[0] / 2, SIZE[1] / 2, 0.01],
        camera_id=1,
    )
    model.add_camera_with_trivial_rig(lens)
    tracks: list[list[tuple[int, int]]] = [[] for _ in points]
    for i, (pose, record) in enumerate(zip(poses, context.read(artifacts.IMAGE_SET).images, strict=True)):
        pixels = np.asarray(lens.img_from_cam(points @ pose[:3, :3].T + pose[:3, 3]))
        framed = np.flatnonzero(((pixels > 0) & (pixels < SIZE)).all(1))
        for number, k in enumerate(framed):
            tracks[k].append((i + 1, number))
        places = pycolmap.Point2DList([pycolmap.Point2D(pixel) for pixel in pixels[framed]])
        rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(pose[:3, :3]), pose[:3, 3])
        model.add_image_with_trivial_frame(pycolmap.Image(record.name, places, 1, i + 1), rigid)
    for point, track in zip(points, tracks, strict=True):
        if len(track) > 1:
            elements = [pycolmap.TrackElement(*element) for element in track]
            added = model.add_point3D(point, pycolmap.Track(elements), np.zeros(3, np.uint8))
            model.points3D[added].error = 0.5
    folder = context.to_write(artifacts.MODEL)
    folder.mkdir()
    model.write(str(folder))
    context.write(artifacts.REGISTRATION, artifacts.Registration())
    context.write(artifacts.PHOTO_CONTENTS, artifacts.PhotoContents(lineage="first", contents={}))
    return {}
