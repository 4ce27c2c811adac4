"""How exactly the photos determine poses and intrinsics: the covariance of a bundle adjustment.

It is that of the least-squares problem at its solution, scaled by the a-posteriori variance of unit weight, the sum of
squared residuals over the redundancy [Triggs et al., Bundle Adjustment - A Modern Synthesis, 2000, section 6 and 9].
COLMAP estimates one, too (`pycolmap.estimate_ba_covariance`), but in a gauge that holds three points or two cameras
fixed, so that its numbers depend on which. Here that of the camera centres is the one after alignment by a similarity:
what is left when a model is laid over the truth.

Residuals are taken for independent. Features err in like ways in neighbouring photos, so true errors are larger.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float
    from scipy.sparse import csr_matrix

DERIVATIVE_STEP = 1e-6  # relative to the depth or parameter; central differences in double precision
POINT_DAMPING = 1e-10  # of a point's normal equations, so that one seen without parallax has an inverse, too
POSE = 6  # rotation, translation: cam_from_world followed by a small motion in the camera's frame


@dataclass(frozen=True)
class Precision:
    """Standard errors of an adjusted model.

    Attributes:
        residual_px: a-posteriori standard deviation of an observation's coordinate, pixels.
        centers: [N] root mean square error to expect of each camera's centre once the model is aligned to the truth by
            a similarity, in the model's unit.
        intrinsics: camera id -> standard errors of its free parameters, by their place in COLMAP's list.
    """

    residual_px: float
    centers: Float[np.ndarray, " n"]
    intrinsics: dict[int, dict[int, float]]


@dataclass(frozen=True)
class Observations:
    """The observations of a model, by number of the photo and of the point.

    Attributes:
        images: ids of the photos in the order of their numbers.
        photo, point: [M] numbers. camera: [M] ids. feature: [M] index of the feature in its photo.
        pixels: [M, 2]. points: [P, 3] world coordinates. point_ids: [P].
    """

    images: list[int]
    photo: np.ndarray
    point: np.ndarray
    camera: np.ndarray
    feature: np.ndarray
    pixels: Float[np.ndarray, "m 2"]
    points: Float[np.ndarray, "p 3"]
    point_ids: np.ndarray


def observations_of(model: Any) -> Observations:
    """All observations of a pycolmap model, photo by photo."""
    images, point_ids = sorted(model.reg_image_ids()), np.array(sorted(model.points3D), dtype=np.int64)
    photo, point, feature, pixels = [], [], [], []
    for number, image_id in enumerate(images):
        for index, point2D in enumerate(model.images[image_id].points2D):
            if point2D.has_point3D():
                photo.append(number)
                point.append(point2D.point3D_id)
                feature.append(index)
                pixels.append(point2D.xy)
    cameras = np.array([model.images[image_id].camera_id for image_id in images], dtype=np.int64)
    return Observations(
        images=images,
        photo=np.array(photo, dtype=np.int64),
        camera=cameras[np.array(photo, dtype=np.int64)],
        point=np.searchsorted(point_ids, np.array(point, dtype=np.int64)),
        feature=np.array(feature, dtype=np.int64),
        pixels=np.array(pixels, dtype=np.float64).reshape(-1, 2),
        points=np.array([model.points3D[i].xyz for i in point_ids.tolist()], dtype=np.float64).reshape(-1, 3),
        point_ids=point_ids,
    )


def free_parameters(camera: Any, principal_point: bool) -> list[int]:
    """Places in COLMAP's list of the intrinsics that an adjustment changes."""
    places = [*camera.focal_length_idxs(), *camera.extra_params_idxs()]
    return sorted([*places, *(camera.principal_point_idxs() if principal_point else ())])


def estimate_precision(model: Any, free: dict[int, list[int]]) -> Precision | None:
    """The precision of an adjusted pycolmap model.

    Args:
        free: camera id -> places of the intrinsics that were adjusted.

    Returns:
        None where there are no more observations than unknowns, or they leave something undetermined.
    """
    import scipy.linalg

    seen = observations_of(model)
    poses = [model.images[i].cam_from_world() for i in seen.images]
    rotations = np.array([pose.rotation.matrix() for pose in poses])
    translations = np.array([pose.translation for pose in poses])
    columns = {}
    width = POSE * len(poses)
    for camera_id in sorted(free):
        columns[camera_id] = np.arange(width, width + len(free[camera_id]))
        width += len(free[camera_id])
    residuals, by_camera, by_point = _linearise(model, seen, rotations, translations, free, columns, width)
    redundancy = residuals.size - width - seen.points.size + 7
    if redundancy <= 0:
        return None
    variance = float((residuals**2).sum()) / redundancy
    normal = _without_points(by_camera, by_point)

    gauge = np.zeros((width, 7))
    gauge[: POSE * len(poses)] = _gauge(rotations, translations)
    scales = np.diag(normal)
    if not (scales > 0).all():
        return None
    weights = np.sqrt(scales)  # Jacobi scaling: poses and intrinsics have units of their own
    basis, _ = np.linalg.qr(gauge * weights[:, None])
    scaled = normal / np.outer(weights, weights) + basis @ basis.T
    try:
        factor = scipy.linalg.cho_factor(scaled)
    except np.linalg.LinAlgError:
        return None
    covariance = variance * scipy.linalg.cho_solve(factor, np.eye(width)) / np.outer(weights, weights)
    errors = np.sqrt(np.maximum(np.diag(covariance), 0))
    return Precision(
        residual_px=float(np.sqrt(variance)),
        centers=_center_errors(covariance[: POSE * len(poses), : POSE * len(poses)], rotations, translations),
        intrinsics={
            camera_id: dict(zip(free[camera_id], errors[places].tolist(), strict=True))
            for camera_id, places in columns.items()
        },
    )


# ---------------------------------------------------------------- the normal equations
def _linearise(
    model: Any,
    seen: Observations,
    rotations: Float[np.ndarray, "n 3 3"],
    translations: Float[np.ndarray, "n 3"],
    free: dict[int, list[int]],
    columns: dict[int, np.ndarray],
    width: int,
) -> tuple[np.ndarray, csr_matrix, csr_matrix]:
    """Residuals [2 M], and their derivatives by poses and intrinsics [2 M, width] and by points [2 M, 3 P]."""
    from scipy.sparse import csr_matrix

    in_camera = np.einsum("mij,mj->mi", rotations[seen.photo], seen.points[seen.point]) + translations[seen.photo]
    residuals = np.zeros((len(in_camera), 2))
    by_place = np.zeros((len(in_camera), 2, 3))
    entries: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []  # row, column, value
    for camera_id in np.unique(seen.camera).tolist():
        camera, rows = model.cameras[camera_id], np.flatnonzero(seen.camera == camera_id)
        places = in_camera[rows]
        residuals[rows] = camera.img_from_cam(places) - seen.pixels[rows]
        for axis in range(3):
            step = np.zeros_like(places)
            step[:, axis] = DERIVATIVE_STEP * places[:, 2]
            difference = camera.img_from_cam(places + step) - camera.img_from_cam(places - step)
            by_place[rows, :, axis] = difference / (2 * step[:, axis, None])
        for place, column in zip(free.get(camera_id, ()), columns.get(camera_id, ()), strict=True):
            derivative = _by_intrinsic(camera, place, places)
            for side in range(2):
                entries.append((2 * rows + side, np.full(len(rows), column), derivative[:, side]))
    turn = np.zeros((len(in_camera), 3, 3))  # d(w x place)/dw
    turn[:, 0, 1], turn[:, 0, 2], turn[:, 1, 2] = in_camera[:, 2], -in_camera[:, 1], in_camera[:, 0]
    turn -= turn.transpose(0, 2, 1)
    by_pose = np.concatenate([by_place @ turn, by_place], 2)
    by_point = by_place @ rotations[seen.photo]
    row = 2 * np.arange(len(in_camera))
    for side in range(2):
        for axis in range(POSE):
            entries.append((row + side, POSE * seen.photo + axis, by_pose[:, side, axis]))
    of_points = [(row + side, 3 * seen.point + axis, by_point[:, side, axis]) for side in range(2) for axis in range(3)]

    def matrix(parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]], number: int) -> csr_matrix:
        rows, places, values = (np.concatenate(side) for side in zip(*parts, strict=True))
        return csr_matrix((values, (rows, places)), shape=(2 * len(in_camera), number))

    return residuals.ravel(), matrix(entries, width), matrix(of_points, seen.points.size)


def _by_intrinsic(camera: Any, place: int, places: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 2"]:
    changed = copy.copy(camera)
    pixels = []
    step = DERIVATIVE_STEP * max(1.0, abs(camera.params[place]))
    for sign in (1, -1):
        params = np.array(camera.params)
        params[place] += sign * step
        changed.params = params
        pixels.append(changed.img_from_cam(places))
    return (pixels[0] - pixels[1]) / (2 * step)


def _without_points(by_camera: csr_matrix, by_point: csr_matrix) -> np.ndarray:
    """The normal equations of poses and intrinsics after the points are eliminated: the Schur complement [D, D]."""
    from scipy.sparse import bsr_matrix

    blocks = (by_point.T @ by_point).tobsr((3, 3))
    number = blocks.shape[0] // 3
    order = np.argsort(blocks.indices)  # one block on the diagonal for each point
    damping = POINT_DAMPING * np.trace(blocks.data, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    inverse = np.linalg.inv((blocks.data + damping)[order])
    inverted = bsr_matrix((inverse, np.arange(number), np.arange(number + 1)), shape=blocks.shape)
    mixed = by_camera.T @ by_point
    return np.asarray((by_camera.T @ by_camera - mixed @ inverted @ mixed.T).todense())


def _gauge(rotations: Float[np.ndarray, "n 3 3"], translations: Float[np.ndarray, "n 3"]) -> np.ndarray:
    """[6 N, 7] how poses change when the world is moved, turned and scaled, which no photo sees."""
    gauge = np.zeros((len(rotations), POSE, 7))
    gauge[:, :3, 3:6] = -rotations
    gauge[:, 3:, :3] = -rotations
    gauge[:, 3:, 3:6] = -np.cross(translations[:, None, :], rotations.transpose(0, 2, 1)).transpose(0, 2, 1)
    gauge[:, 3:, 6] = translations
    return gauge.reshape(-1, 7)


def _center_errors(
    covariance: np.ndarray, rotations: Float[np.ndarray, "n 3 3"], translations: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, " n"]:
    """Expected distance of each centre to the truth, root mean square, after the alignment that makes them smallest."""
    number = len(rotations)
    back = rotations.transpose(0, 2, 1)
    moves = covariance.reshape(number, POSE, number, POSE)[:, 3:, :, 3:]
    of_centers = np.einsum("iab,ibjc,jdc->iajd", back, moves, back, optimize=True).reshape(3 * number, 3 * number)
    centers = -np.einsum("nij,nj->ni", back, translations)
    arms = centers - centers.mean(0)
    similarity = np.zeros((number, 3, 7))
    similarity[:, :, :3] = np.eye(3)
    similarity[:, :, 3:6] = np.cross(np.eye(3)[None], arms[:, None, :]).transpose(0, 2, 1)
    similarity[:, :, 6] = arms
    basis, _ = np.linalg.qr(similarity.reshape(-1, 7))
    rest = of_centers - basis @ (basis.T @ of_centers)
    aligned = rest - (rest @ basis) @ basis.T
    return np.sqrt(np.diag(aligned).reshape(-1, 3).sum(1))
