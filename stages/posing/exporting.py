"""Poses for other programs: the undistorted photos with a COLMAP model, or with nerfstudio's transforms.json.

Everything is in the world frame, that of the exported PLY and OBJ.
"""

from __future__ import annotations

import logging
import shutil
from pathlib import Path
from typing import Any

import numpy as np

from stages import artifacts
from stages.geometry.cameras import PosedScene
from stages.geometry.normalisation import into_frame
from stages.geometry.place import Place
from stages.posing.colmap_model import pinhole_model
from stages.posing.undistortion import registered_photos

log = logging.getLogger(__name__)

SPARSE, TRANSFORMS, POINTS = "sparse", "transforms.json", "sparse_pc.ply"


def write_colmap(undistort: Path, sfm: Path, place: Path, out: Path) -> dict[str, Any]:
    """Write images/, masks/ (where there are any) and sparse/ (.bin and .txt), as COLMAP's own undistorter does.

    Args:
        undistort, sfm, place: folders of these stages. out: exists.

    Returns:
        Numbers of images, points and observations.
    """
    _, model = _images_and_model(undistort, sfm, artifacts.WORLD_PLACE.load(place), out)
    folder = out / SPARSE
    folder.mkdir()
    model.write_binary(str(folder))
    model.write_text(str(folder))
    return _numbers(model)


def write_transforms(undistort: Path, sfm: Path, place: Path, out: Path) -> dict[str, Any]:
    """Write images/, masks/ (where there are any), transforms.json and a PLY of the sparse points.

    transforms.json names the masks where every photo has one.

    Arguments and numbers are those of `write_colmap`.
    """
    in_world = artifacts.WORLD_PLACE.load(place)
    scene, model = _images_and_model(undistort, sfm, in_world, out)
    model.export_PLY(str(out / POINTS))
    cameras = into_frame(scene.cameras, scene.world_from_scene(in_world).inverse())
    frames = []
    for i, name in enumerate(cameras.names):
        cam_from_world = np.vstack([cameras.extrinsics[i], [0, 0, 0, 1]])
        K, (width, height) = cameras.intrinsics[i], cameras.sizes[i].tolist()
        frame = {
            "file_path": f"{artifacts.IMAGES}/{name}",
            "w": width,
            "h": height,
            "fl_x": K[0, 0],
            "fl_y": K[1, 1],
            "cx": K[0, 2],
            "cy": K[1, 2],
            # OpenGL axes: y up, z backward
            "transform_matrix": (np.linalg.inv(cam_from_world) @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist(),
        }
        mask = artifacts.Pictures(out).mask_path(name)
        if mask.exists():
            frame["mask_path"] = mask.relative_to(out).as_posix()
        frames.append(frame)
    masked = sum("mask_path" in frame for frame in frames)
    if 0 < masked < len(frames):  # nerfstudio stops unless all frames have one, or none
        log.warning("%s names no masks: only %d of %d photos have one", TRANSFORMS, masked, len(frames))
        for frame in frames:
            frame.pop("mask_path", None)
    artifacts.write_json(
        out / TRANSFORMS, {"camera_model": "OPENCV", "units": in_world.units, "ply_file_path": POINTS, "frames": frames}
    )
    return _numbers(model)


def _images_and_model(undistort: Path, sfm: Path, place: Place, out: Path) -> tuple[PosedScene, Any]:
    """Copy images and masks that were given to `out`; the scene, and the pycolmap model of it."""
    scene = artifacts.FIRST_SCENE.load(undistort)
    ours, theirs = artifacts.Pictures(undistort), artifacts.Pictures(out)
    outlines = artifacts.OUTLINES.load(undistort)
    for name in scene.cameras.names:
        mask = artifacts.given_mask_of(name, ours, outlines).mask_path(name)
        for source, target in ((ours.path(name), theirs.path(name)), (mask, theirs.mask_path(name))):
            if source.exists():
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source, target)
    return scene, undistorted_model(scene, place, sfm, out / artifacts.IMAGES)


def undistorted_model(scene: PosedScene, in_world: Place, sfm: Path, images_folder: Path) -> Any:
    """The pycolmap model of the pinhole images, with the points' colours and tracks.

    Where the features were seen comes from the model of `sfm`, whose photos and points are in the scene's order.
    """
    import pycolmap

    source = pycolmap.Reconstruction(str(artifacts.MODEL.load(sfm)))
    photos = registered_photos(source)
    cameras = into_frame(scene.cameras, scene.world_from_scene(in_world).inverse())
    pixels = []
    for photo, K in zip(photos, cameras.intrinsics, strict=True):
        seen = np.array([point.xy for point in photo.points2D]).reshape(-1, 2)
        rays = np.asarray(source.cameras[photo.camera_id].cam_from_img(seen)).reshape(-1, 2)
        # a lens may not reach the photo's corners
        pixels.append(np.nan_to_num(rays * K[[0, 1], [0, 1]] + K[:2, 2], nan=-1.0))
    model = pinhole_model(cameras, pixels)
    index_of = {photo.image_id: i + 1 for i, photo in enumerate(photos)}
    points = scene.world_from_scene(in_world).apply(scene.points.astype(np.float64))
    for point_id, xyz in zip(sorted(source.points3D), points, strict=True):
        track = pycolmap.Track()
        for element in source.points3D[point_id].track.elements:
            if element.image_id in index_of:
                track.add_element(index_of[element.image_id], element.point2D_idx)
        model.add_point3D(xyz, track, np.zeros(3, np.uint8))
    model.extract_colors_for_all_images(str(images_folder))
    model.update_point_3d_errors()
    return model


def _numbers(model: Any) -> dict[str, Any]:
    return {
        "images": model.num_reg_images(),
        "points": model.num_points3D(),
        "observations": model.compute_num_observations(),
    }
