"""A workspace of the small town's photos, posed without looking at any."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.small_town import FOCAL, HOUSES, LAND, SIZE, WIDTH, flight
from stages import artifacts
from stages.engine.stage import StageContext


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
