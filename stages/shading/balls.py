"""Balls in photos: which way their surface faces, what a chrome one mirrors and what a grey one receives.

A camera sees a ball within a cone. Where the light comes from far away, the cone and the rays in it say all that
matters, and the ball's size and distance nothing: with the camera at the origin and the ball's centre at distance 1
along the axis a, its radius is sin α, and a ray d of unit length meets it first at

    t d,  t = d·a - sqrt((d·a)² - cos² α),   with the normal  (t d - a) / sin α.

In the photo the cone is an ellipse, the longer the further from the middle; a circle is marked in its place, and the
cone is the one that fits the rays through that circle best.

Shapes: N rays, Q pixels of a ball. Camera frame where nothing else is said.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from stages.geometry.vectors import unit
from stages.light.environment import directions, resized
from stages.light.srgb import decoded

Kind = Literal["chrome", "grey"]
# Codes of 8 bits from here on are clipped.
CLIPPED_CODE = 250
# The outermost part of a ball's radius is not looked at: there its own edge and what lies behind it mix.
RIM, RIM_PX = 0.02, 1.5
CIRCLE_POINTS = 64
# Rounds of `fitted_cone` and of `mirroring_normals`; both converge by a factor of at least 3 each.
_ROUNDS = 12
# A chrome ball's map has as many rows as its radius has pixels, within these; each pixel is looked up so many times
# along a side.
FEWEST_ROWS, MOST_ROWS, FINER = 16, 128, 4
# A ball of which less is usable shows no light.
LEAST_USABLE = 0.05
# A grey ball is looked at about so many times along its radius.
GREY_STEPS = 16


@dataclass(frozen=True)
class Cone:
    """Unit axis [3] and the angle α between it and the sides, radians."""

    axis: np.ndarray
    angle: float


@dataclass(frozen=True)
class MirrorBall:
    """What a chrome ball shows of the light.

    Attributes:
        radiance: [h, 2 h, 3] float32 map as in `stages.light.environment`; a lower bound where it is clipped.
        seen: [h, 2 h] whether the ball mirrors that direction to the camera.
        clipped: [h, 2 h, 3] whether the photo is clipped there.
    """

    radiance: np.ndarray
    seen: np.ndarray
    clipped: np.ndarray


@dataclass(frozen=True)
class MatteBall:
    """What a grey ball shows, but where it is clipped.

    Attributes:
        normals: [Q, 3] unit, in the light's frame.
        colors: [Q, 3] linear.
    """

    normals: np.ndarray
    colors: np.ndarray


@dataclass(frozen=True)
class BallPhoto:
    """A ball, and the photo it is in.

    Attributes:
        center, radius: of the circle in pixels of the photo, pixel centres at .5.
        pixels: [H, W, 3] uint8 RGB, coded as sRGB.
        rays_of: from pixel positions [N, 2] to rays [N, 3] of any length.
        pixels_of: back.
        light_from_cam: rotation [3, 3] into the light's frame.
    """

    center: tuple[float, float]
    radius: float
    pixels: np.ndarray
    rays_of: Callable[[np.ndarray], np.ndarray]
    pixels_of: Callable[[np.ndarray], np.ndarray]
    light_from_cam: np.ndarray

    @property
    def cone(self) -> Cone:
        turn = 2 * np.pi * np.arange(CIRCLE_POINTS) / CIRCLE_POINTS
        circle = np.stack([np.cos(turn), np.sin(turn)], axis=1) * self.radius + self.center
        return fitted_cone(unit(self.rays_of(circle)))

    @property
    def widest(self) -> float:
        """Part of the radius that is looked at."""
        return 1 - max(RIM, RIM_PX / self.radius)

    @property
    def linear(self) -> np.ndarray:
        """[H, W, 3] float32."""
        table: np.ndarray = decoded(np.arange(256) / 255).astype(np.float32)
        return table[self.pixels]

    @property
    def clipped(self) -> np.ndarray:
        """[H, W, 3]."""
        return self.pixels >= CLIPPED_CODE


def fitted_cone(rays: np.ndarray) -> Cone:
    """The cone whose sides unit rays [N, 3] miss by the least angles, by Gauss-Newton from their mean."""
    axis, angle = unit(rays.mean(0)), 0.0
    for _ in range(_ROUNDS):
        cosine = rays @ axis
        sine = np.linalg.norm(np.cross(rays, axis), axis=1)
        angles = np.arctan2(sine, cosine)
        # what the axis gains towards a ray, the angle to it loses
        towards = (rays - cosine[:, None] * axis) / sine[:, None]
        step = np.linalg.lstsq(np.column_stack([-towards, -np.ones(len(rays))]), -angles, rcond=None)[0]
        axis, angle = unit(axis + step[:3]), float(step[3])
    return Cone(axis, angle)


def normals_on(cone: Cone, rays: np.ndarray) -> np.ndarray:
    """Normals [N, 3] where unit rays [N, 3] within the cone meet the ball."""
    along = rays @ cone.axis
    distance = along - np.sqrt(np.maximum(along**2 - np.cos(cone.angle) ** 2, 0))
    return unit(distance[:, None] * rays - cone.axis)


def mirroring_normals(cone: Cone, towards: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where the ball mirrors what comes from unit directions [N, 3] to the camera.

    The normal lies halfway between the direction and the way back to the camera, which starts where the normal is:
    found in turn, as that place hardly moves the way back. Directions from behind the ball have no such place; what is
    found for them faces sideways.

    Returns:
        normals [N, 3] and unit rays [N, 3] from the camera to there.
    """
    rays = np.broadcast_to(cone.axis, towards.shape)
    for _ in range(_ROUNDS):
        normals = unit(towards - rays)
        rays = unit(cone.axis + np.sin(cone.angle) * normals)
    return normals, rays


def seen_in_chrome(ball: BallPhoto) -> MirrorBall:
    """The light as a chrome ball mirrors it. Chrome is taken to mirror all colours and angles alike.

    Raises:
        ValueError: nearly all of it is clipped or black.
    """
    import cv2

    cone = ball.cone
    height = int(np.clip(round(ball.radius), FEWEST_ROWS, MOST_ROWS))
    fine = directions(FINER * height).reshape(-1, 3)
    normals, rays = mirroring_normals(cone, fine @ ball.light_from_cam)
    facing = -np.einsum("nc,nc->n", normals, rays)
    seen = facing >= np.sqrt(1 - ball.widest**2)
    # OpenCV has pixel centres at integers
    places = np.full((len(fine), 2), -1, np.float32)
    places[seen] = ball.pixels_of(rays[seen]) - 0.5
    shape = (FINER * height, 2 * FINER * height)
    x, y = np.ascontiguousarray(places[:, 0].reshape(shape)), np.ascontiguousarray(places[:, 1].reshape(shape))
    shown = cv2.remap(ball.linear, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    clipped = cv2.remap(ball.clipped.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    known = seen.reshape(*shape, 1).astype(np.float32)
    found = resized(np.concatenate([known, shown * known, clipped * known], axis=2), height)
    share, radiance, clips = found[..., 0], found[..., 1:4], found[..., 4:] > 0
    _check_usable(~np.any(clips, axis=2)[share > 0.5], radiance)
    return MirrorBall(radiance / np.maximum(share, 1e-6)[..., None], share > 0.5, clips)


def seen_on_grey(ball: BallPhoto) -> MatteBall:
    """What a grey ball shows, by the normals of some of its pixels.

    Raises:
        ValueError: nearly all of it is clipped or black.
    """
    import cv2

    step = max(1, round(ball.radius / GREY_STEPS))
    steps = np.arange(-int(ball.radius / step), int(ball.radius / step) + 1) * step
    x, y = (each.reshape(-1) for each in np.meshgrid(ball.center[0] + steps, ball.center[1] + steps))
    rays = unit(ball.rays_of(np.stack([x, y], axis=1)))
    cone = ball.cone
    inside = np.linalg.norm(np.cross(rays, cone.axis), axis=1) <= ball.widest * np.sin(cone.angle)
    height, width = ball.pixels.shape[:2]
    columns, rows = np.clip(x[inside], 0, width - 1).astype(int), np.clip(y[inside], 0, height - 1).astype(int)
    means = cv2.blur(ball.linear, (step, step))[rows, columns]
    clipped = cv2.blur(ball.clipped.astype(np.float32), (step, step))[rows, columns].max(1) > 0
    _check_usable(~clipped, means)
    normals = normals_on(cone, rays[inside]) @ ball.light_from_cam.T
    return MatteBall(normals[~clipped].astype(np.float32), means[~clipped])


def _check_usable(usable: np.ndarray, radiance: np.ndarray) -> None:
    if usable.mean() < LEAST_USABLE:
        raise ValueError(f"{100 * (1 - usable.mean()):.0f} % of it are clipped")
    if not radiance.any():
        raise ValueError("it is black")
