"""Gaussians to an image, and an image's gradient to Gaussians.

EWA splatting (Zwicker et al. 2001) as Kerbl et al. 2023 ("3D Gaussian Splatting", 3DGS) have it.

Each Gaussian is an ellipse in the image, its covariance projected to first order and widened by 0.3 pixels²; ellipses
are blended nearest first: pixel = sum_i c_i alpha_i O_i + O background, with O_i the product of (1 - alpha_j) of the
nearer ones. Constants and conventions are those of 3DGS and gsplat, so that what is fitted here looks the same in other
programs.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from stages.gaussians import kernels
from stages.gaussians.gaussians import Gaussians
from stages.geometry.cameras import PinholeCameras

if TYPE_CHECKING:
    from jaxtyping import Float32

BLACK, WHITE = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Camera:
    """One pinhole camera as the kernels take it, float32.

    Attributes:
        pose: [3, 4] camera from scene.
        position: [3].
        focal: [3] fx, skew and fy, pixels.
        middle: [2] principal point, pixels.
        reach: [4] least and most x / z and y / z that projections are taken at.
        width, height: pixels.
    """

    pose: np.ndarray
    position: np.ndarray
    focal: np.ndarray
    middle: np.ndarray
    reach: np.ndarray
    width: int
    height: int


@dataclass(frozen=True)
class Ellipses:
    """N Gaussians in one image, see `kernels.project`, and the tiles that they reach, see `kernels.fill_pairs`.

    Attributes:
        ids: [M] int32 those that are in the image, nearest first.
        first, places: where the pairs of each of them are.
        starts, members: the pairs of each tile.
        columns: of tiles.
    """

    means: np.ndarray
    depths: np.ndarray
    conics: np.ndarray
    opacities: np.ndarray
    colors: np.ndarray
    boxes: np.ndarray
    ids: np.ndarray
    first: np.ndarray
    places: np.ndarray
    starts: np.ndarray
    members: np.ndarray
    columns: int


@dataclass(frozen=True)
class Drawing:
    """An image of Gaussians, and what its gradient needs.

    Attributes:
        image: [H, W, 3] float32, not cut at 1.
        transmittance: [H, W] float32 part of the background that shows.
    """

    camera: Camera
    ellipses: Ellipses
    image: np.ndarray
    transmittance: np.ndarray


@dataclass(frozen=True)
class Gradients:
    """Of a loss to the M Gaussians that show in an image, as `Gaussians` has them.

    Attributes:
        ids: [M] int32 which Gaussians.
        means: [M, 2] to their places in the image, per pixel.
    """

    ids: np.ndarray
    centers: np.ndarray
    rotations: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    harmonics: np.ndarray
    means: np.ndarray


def draw(
    gaussians: Gaussians, cameras: PinholeCameras, index: int, background: tuple[float, float, float] = WHITE
) -> tuple[Float32[np.ndarray, "h w 3"], Float32[np.ndarray, "h w"]]:
    """What camera `index` sees: sRGB image in 0..1 over the background, and alpha, 1 where nothing shines through."""
    drawing = render(gaussians, camera_of(cameras, index), background)
    return np.clip(drawing.image, 0, 1), 1 - drawing.transmittance


def camera_of(cameras: PinholeCameras, index: int) -> Camera:
    """One of the project's cameras."""
    intrinsics = cameras.intrinsics[index]
    width, height = (int(side) for side in cameras.sizes[index])
    focal = np.array([intrinsics[0, 0], intrinsics[0, 1], intrinsics[1, 1]], np.float32)
    middle = intrinsics[:2, 2].astype(np.float32)
    half_x, half_y = 0.5 * width / focal[0], 0.5 * height / focal[2]
    extra = float(kernels.REACH) - 1
    reach = np.array(
        [
            -middle[0] / focal[0] - extra * half_x,
            (width - middle[0]) / focal[0] + extra * half_x,
            -middle[1] / focal[2] - extra * half_y,
            (height - middle[1]) / focal[2] + extra * half_y,
        ],
        np.float32,
    )
    pose = np.ascontiguousarray(cameras.extrinsics[index], np.float32)
    return Camera(pose, cameras.centers[index].astype(np.float32), focal, middle, reach, width, height)


def project(gaussians: Gaussians, camera: Camera) -> Ellipses:
    """Gaussians in one image, sorted into tiles."""
    count = len(gaussians)
    means, conics = np.empty((count, 2), np.float32), np.empty((count, 3), np.float32)
    depths, opacities = np.empty(count, np.float32), np.empty(count, np.float32)
    colors, boxes = np.empty((count, 3), np.float32), np.empty((count, 4), np.int32)
    kernels.project(
        gaussians.centers, gaussians.rotations, gaussians.log_scales, gaussians.opacity_logits, gaussians.harmonics,
        camera.pose, camera.position, camera.focal, camera.middle, camera.reach, camera.width, camera.height,
        means, depths, conics, opacities, colors, boxes,
    )  # fmt: skip
    visible = np.flatnonzero(boxes[:, 1] > 0).astype(np.int32)
    ids = visible[np.argsort(depths[visible], kind="stable")]
    columns, rows = -(-camera.width // kernels.TILE), -(-camera.height // kernels.TILE)
    first, starts = np.empty(len(ids) + 1, np.int64), np.empty(columns * rows + 1, np.int64)
    kernels.count_pairs(ids, boxes, columns, first, starts)
    members, places = np.empty(first[-1], np.int32), np.empty(first[-1], np.int64)
    kernels.fill_pairs(ids, boxes, columns, first, starts, members, places)
    return Ellipses(
        means, depths, conics, opacities, colors, boxes, ids, first, places, starts, members, columns
    )  # fmt: skip


def render(gaussians: Gaussians, camera: Camera, background: tuple[float, float, float] = WHITE) -> Drawing:
    """Draw, and keep what `gradients` needs."""
    found = project(gaussians, camera)
    image = np.empty((camera.height, camera.width, 3), np.float32)
    transmittance = np.empty((camera.height, camera.width), np.float32)
    kernels.blend(
        found.starts, found.members, found.columns, found.means, found.conics, found.opacities, found.colors,
        found.boxes, np.array(background, np.float32), image, transmittance,
    )  # fmt: skip
    return Drawing(camera, found, image, transmittance)


def gradients(
    gaussians: Gaussians,
    drawing: Drawing,
    d_image: Float32[np.ndarray, "h w 3"],
    d_transmittance: Float32[np.ndarray, "h w"],
) -> Gradients:
    """Gradients to what was drawn, from those to the image over its background, and to the transmittance."""
    found, camera = drawing.ellipses, drawing.camera
    parts = np.empty((len(found.members), kernels.PARTS), np.float32)
    kernels.blend_backward(
        found.starts, found.members, found.columns, found.means, found.conics, found.opacities, found.colors,
        found.boxes, drawing.image, drawing.transmittance, d_image, d_transmittance, parts,
    )  # fmt: skip
    sums = np.empty((len(found.ids), kernels.PARTS), np.float32)
    kernels.add_parts(found.first, found.places, parts, sums)
    shows = sums.any(1)
    ids, sums = found.ids[shows], sums[shows]
    count = len(ids)
    answer = Gradients(
        ids=ids,
        centers=np.empty((count, 3), np.float32),
        rotations=np.empty((count, 4), np.float32),
        log_scales=np.empty((count, 3), np.float32),
        opacity_logits=np.empty(count, np.float32),
        harmonics=np.empty((count, *gaussians.harmonics.shape[1:]), np.float32),
        means=sums[:, :2],
    )
    kernels.project_backward(
        ids, sums, gaussians.centers, gaussians.rotations, gaussians.log_scales, found.opacities,
        gaussians.harmonics, found.conics, found.colors, camera.pose, camera.position, camera.focal, camera.reach,
        answer.centers, answer.rotations, answer.log_scales, answer.opacity_logits, answer.harmonics,
    )  # fmt: skip
    return answer
