"""Sets of real and rendered photos, from workspaces in which `hineus run --until undistort` has been: what was found,
and points on what the photos are about, in the scene frame of the workspace."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.captures.model import Posed
from benchmarks.captures.subject import MIN_PHOTOS, SAMPLES
from benchmarks.captures.tracks import sight
from stages import artifacts
from stages.evaluation.alignment import by_cameras
from stages.evaluation.protocols.known_object import file_stem, has_truth, load_known_object
from stages.evaluation.surfaces import sample_faces
from stages.geometry.cameras import PinholeCameras
from stages.posing import neus
from stages.surface.triangle_mesh import raycaster

# A sparse point that is surely what the photos are about: this many photos have it in the middle half of both
# directions, and the rays of two that see it meet at this angle.
BY_MESH, BY_MASKS, BY_PROXY = "mesh", "points on masks", "points in the middle"
CENTRAL_PHOTOS, CENTRAL, MIN_ANGLE_DEG = 3, 0.25, 4.0
MAX_ERROR_PX = 1.5
ON_MASKS = 3  # photos whose masks hold a point that lies outside none


def load_posed(workspace: Path) -> Posed:
    """What is known of the photos after undistort, in the scene frame."""
    scene = artifacts.SCENE.load(workspace / "undistort")
    pictures = artifacts.PINHOLE_PHOTOS.load(workspace / "undistort")
    masks = tuple(pictures.mask(name) for name in scene.cameras.names)
    known = any(mask is not None for mask in masks)
    return Posed(
        scene.cameras,
        scene.points.astype(np.float64),
        scene.point_errors,
        scene.observations,
        masks if known else None,
    )


def subject_of(folder: Path, posed: Posed) -> tuple[np.ndarray, str]:
    """Points [P, 3] of the subject of a set in the frame of `posed`, and what they are."""
    if has_truth(folder):
        return known_surface(folder, posed.cameras), BY_MESH
    if (folder / neus.MASKS).is_dir():
        return points_on_masks(folder, posed), BY_MASKS
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


def points_on_masks(folder: Path, posed: Posed) -> np.ndarray:
    """Well-found sparse points that lie on the masks of all photos that have them in the frame."""
    import cv2

    photos, masks = (sorted(path for path in (folder / name).iterdir()) for name in (neus.IMAGES, neus.MASKS))
    mask_of = dict(zip(map(file_stem, map(str, photos)), masks, strict=True))  # by their order, as NeuS has them
    framed, on = np.zeros((2, len(posed.points)), dtype=int)
    for i, name in enumerate(posed.cameras.names):
        pixels = cv2.imread(str(mask_of[file_stem(name)]), cv2.IMREAD_GRAYSCALE)
        mask = cv2.resize(pixels, tuple(posed.cameras.sizes[i].tolist()), interpolation=cv2.INTER_NEAREST)
        in_frame, on_mask = posed.cameras.on_mask(i, posed.points, mask > 127)
        framed, on = framed + in_frame, on + on_mask
    return posed.points[well_found(posed) & (on == framed) & (on >= ON_MASKS)]


def central_points(posed: Posed) -> np.ndarray:
    """Well-found sparse points that at least three of the photos that see them have near their middle."""
    image, point = posed.observations.T
    central = np.zeros(len(posed.points), dtype=int)
    for i in range(len(posed.cameras)):
        seen = point[image == i]
        pixels, _ = posed.cameras.project(i, posed.points[seen])
        near = (np.abs(pixels / posed.cameras.sizes[i] - 0.5) < CENTRAL).all(1)
        np.add.at(central, seen[near], 1)
    return posed.points[well_found(posed) & (central >= CENTRAL_PHOTOS)]


def well_found(posed: Posed) -> np.ndarray:
    """[P] bool: small error, and rays that meet at an angle."""
    image, point = posed.observations.T
    rays = posed.points[point] - posed.cameras.centers[image]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    mean = np.zeros_like(posed.points)
    np.add.at(mean, point, rays)
    mean /= np.maximum(np.linalg.norm(mean, axis=1, keepdims=True), 1e-12)
    least = np.ones(len(mean))
    np.minimum.at(least, point, np.einsum("mi,mi->m", rays, mean[point]))
    wide = 2 * np.degrees(np.arccos(np.clip(least, -1, 1))) >= MIN_ANGLE_DEG
    return wide & (posed.errors < MAX_ERROR_PX)
