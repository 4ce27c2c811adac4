"""Sets of real and rendered photos, from workspaces in which `hineus run --until sfm` has been: what was found,
and points on what the photos are about, in the frame of the poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.captures.model import Posed
from benchmarks.captures.subject import MIN_PHOTOS, SAMPLES
from benchmarks.captures.tracks import sight
from configs.params import UndistortParams
from stages import artifacts
from stages.capture.masks import load_mask
from stages.evaluation.alignment import by_cameras
from stages.evaluation.protocols.known_object import file_stem, has_truth, load_known_object
from stages.evaluation.surfaces import sample_faces
from stages.geometry.attention import parallax_deg
from stages.geometry.cameras import PinholeCameras
from stages.geometry.plane import find_ground
from stages.geometry.region import STANDING, enclosing_sphere
from stages.geometry.up import estimate_up
from stages.posing import neus
from stages.posing.undistortion import (
    plan_warp,
    png_names,
    posed_cameras,
    registered_photos,
    sparse_points,
    warp_maps,
    warp_mask,
)
from stages.surface.triangle_mesh import raycaster

# A sparse point that is surely what the photos are about: this many that see it have it in the middle half of both
# directions, and the rays of two of them meet at this angle.
BY_MESH, BY_MASKS, BY_PROXY = "mesh", "points on masks", "points in the middle"
CENTRAL_PHOTOS, CENTRAL, MIN_ANGLE_DEG = 3, 0.25, 4.0
MAX_ERROR_PX, MIN_TRACK = 1.5, 3  # matches of two photos alone are false too often
ON_MASKS = 0.5  # part of the photos whose masks hold a point that lies outside none: false points are in few frames


def load_posed(workspace: Path, masks: dict[str, Path] | None = None) -> Posed:
    """What `undistort` knows of the photos, in the frame of the poses.

    Args:
        masks: the mask of each photo, by the photo's name without suffix; None: nothing is known of silhouettes.
    """
    import pycolmap

    model = pycolmap.Reconstruction(str(artifacts.MODEL.load(workspace / "sfm")))
    photos = registered_photos(model)
    warps = {number: plan_warp(camera, UndistortParams().max_side) for number, camera in model.cameras.items()}
    cameras = posed_cameras(photos, png_names([photo.name for photo in photos]), warps)
    points, errors, observations = sparse_points(model, photos)
    if masks is None:
        return Posed(cameras, points, errors, observations)
    warped = []
    for photo in photos:
        camera, warp = model.cameras[photo.camera_id], warps[photo.camera_id]
        size = camera.width, camera.height
        mask = load_mask(masks[file_stem(photo.name)], photo.name, size, size, orientation=1).kept
        pixels = np.where(mask, 255, 0).astype(np.uint8)
        warped.append(warp_mask(pixels, warp, warp_maps(camera, warp), erode=0))
    return Posed(cameras, points, errors, observations, tuple(warped))


def find_masks(folder: Path) -> dict[str, Path] | None:
    """The masks that a set comes with, by the names of its photos without suffix; None where it has none."""
    for images, masks in ((neus.IMAGES, neus.MASKS), ("images", "masks")):
        if (folder / masks).is_dir():
            photos, files = (sorted(path for path in (folder / name).iterdir()) for name in (images, masks))
            return {photo.stem: file for photo, file in zip(photos, files, strict=True)}  # in the same order
    return None


def subject_of(folder: Path, posed: Posed, masked: Posed | None) -> tuple[np.ndarray, str]:
    """Points [P, 3] of the subject of a set in the frame of `posed`, and what they are."""
    if has_truth(folder):
        return known_surface(folder, posed.cameras), BY_MESH
    if masked is not None:
        return points_on_masks(masked), BY_MASKS
    return central_points(posed), BY_PROXY


def known_surface(folder: Path, cameras: PinholeCameras) -> np.ndarray:
    """Points on what at least two of `cameras` see of a known mesh; the two frames meet by camera centres.

    Raises:
        InputError, ValueError: there is no truth, or too few cameras are known.
    """
    known = load_known_object(folder)
    theirs = dict(zip(map(file_stem, known.cameras.names), known.cameras.centers, strict=True))
    ours = dict(zip(map(file_stem, cameras.names), cameras.centers, strict=True))
    scene_from_truth, _ = by_cameras(theirs, ours)
    vertices = scene_from_truth.apply(known.vertices)
    points, _ = sample_faces(vertices, known.faces, SAMPLES)
    seen = sight(cameras, points, raycaster(vertices, known.faces)).seen
    return points[seen.sum(0) >= MIN_PHOTOS]


def points_on_masks(posed: Posed) -> np.ndarray:
    """Well-found sparse points on the masks of all photos that have them in the frame, at least half of the photos."""
    framed, on = np.zeros((2, len(posed.points)), dtype=int)
    for i, mask in enumerate(posed.masks or ()):
        if mask is not None:
            in_frame, on_mask = posed.cameras.on_mask(i, posed.points, mask)
            framed, on = framed + in_frame, on + on_mask
    return posed.points[well_found(posed) & (on == framed) & (on >= ON_MASKS * len(posed.cameras))]


def central_points(posed: Posed) -> np.ndarray:
    """Well-found sparse points that at least three photos have near their middle, but for those on the ground."""
    image, point = posed.observations.T
    central = np.zeros(len(posed.points), dtype=int)
    for i in range(len(posed.cameras)):
        seen = point[image == i]
        pixels, _ = posed.cameras.project(i, posed.points[seen])
        near = (np.abs(pixels / posed.cameras.sizes[i] - 0.5) < CENTRAL).all(1)
        np.add.at(central, seen[near], 1)
    chosen = well_found(posed) & (central >= CENTRAL_PHOTOS)
    center, radius = enclosing_sphere(posed.points[chosen])
    ground = find_ground(posed.points, posed.cameras.centers, estimate_up(posed.cameras).direction, center, radius)
    return posed.points[chosen if ground is None else chosen & (ground.heights(posed.points) > STANDING * radius)]


def well_found(posed: Posed) -> np.ndarray:
    """[P] bool: small error, seen by three photos at least, and rays that meet at an angle."""
    track = np.bincount(posed.observations[:, 1], minlength=len(posed.points))
    wide = parallax_deg(posed.cameras, posed.points, posed.observations) >= MIN_ANGLE_DEG
    return wide & (posed.errors < MAX_ERROR_PX) & (track >= MIN_TRACK)
