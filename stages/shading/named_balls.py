"""Balls that a run names as tellers of the light: in which photos they are, and what these show of them."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from configs.texts import read_ball
from stages.artifacts import ImageRecord
from stages.errors import InputError
from stages.posing.marks import photos_named

if TYPE_CHECKING:
    from stages.artifacts import Pictures
    from stages.shading.ball_light import BallLight
    from stages.shading.balls import BallPhoto, Kind

LEAST_RADIUS = 10.0  # pixels
EDGE_PX = 1.0  # a circle may reach so far out of its photo: programs count pixels from 0, .5 or 1
SETTING = "chrome:IMG_1.jpg:1520,840,120"


@dataclass(frozen=True)
class NamedBall:
    """A ball and the circle around it.

    Attributes:
        text: as it was named.
        source: its photo, relative to the photo folder.
        center, radius: pixels of the upright photo as it was taken.
    """

    text: str
    kind: Kind
    source: str
    center: tuple[float, float]
    radius: float


def named_balls(texts: Sequence[str], sizes: Mapping[str, tuple[int, int]]) -> list[NamedBall]:
    """The balls that settings name.

    Args:
        sizes: photo, as a relative posix path -> upright width and height as it was taken.

    Raises:
        InputError: a photo is not there, a circle is too small or reaches out of its photo.
    """
    found = []
    for text in texts:
        kind, photo, (x, y, radius) = read_ball(text)
        fitting = photos_named(photo, sizes)
        if not fitting:
            raise InputError(
                f"There is no photo {photo}, in which a {kind} ball is to be; photos are called e.g. "
                f"{min(sizes, default='-')}.",
                f"Name the photo as its file is named: `--ball {SETTING}`.",
            )
        if len(fitting) > 1:
            raise InputError(
                f"{photo}, in which a {kind} ball is to be, fits {len(fitting)} photos: {fitting[0]}, {fitting[1]}.",
                "Write the photo's folder before its name.",
            )
        source, ball = fitting[0], NamedBall(text, kind, fitting[0], (x, y), radius)
        width, height = sizes[source]
        if min(x, y, width - x, height - y) < radius - EDGE_PX:
            raise InputError(
                f"The circle around the {kind} ball, {radius:g} pixels around {x:g} {y:g}, reaches out of {source}, "
                f"which has {width} x {height} pixels.",
                "Pixels count from the upper left corner of the photo as viewers show it: upright, in its full size. "
                "The whole ball must be in the photo.",
            )
        _check_radius(ball, 1.0)
        found.append(ball)
    return found


def taken_sizes(records: Collection[ImageRecord]) -> dict[str, tuple[int, int]]:
    """Upright sizes as they were taken of what ingest took in."""
    return {record.source: record.taken or (record.width, record.height) for record in records}


def light_of_balls(
    texts: Sequence[str],
    records: Collection[ImageRecord],
    pictures: Pictures,
    model: Any,
    held_out: Collection[str],
    light_from_poses: np.ndarray,
) -> BallLight:
    """What all balls together show.

    Args:
        records, pictures: what ingest took in.
        model: pycolmap reconstruction.
        held_out: names in it of photos that must not be used.
        light_from_poses: rotation [3, 3].

    Raises:
        InputError: see `named_balls`; or a photo cannot be used, or shows nothing.
    """
    from stages.shading.ball_light import light_of
    from stages.shading.balls import seen_in_chrome, seen_on_grey

    of_source = {record.source: record for record in records}
    mirrors, mattes = [], []
    for ball in named_balls(texts, taken_sizes(records)):
        photo = _photo_of(ball, of_source[ball.source], pictures, model, held_out, light_from_poses)
        try:
            if ball.kind == "chrome":
                mirrors.append(seen_in_chrome(photo))
            else:
                mattes.append(seen_on_grey(photo))
        except ValueError as error:
            raise InputError(
                f"The {ball.kind} ball in {ball.source} tells no light: {error}.",
                "Look whether the circle is around it, or name one in a photo with another exposure.",
            ) from error
    try:
        return light_of(mirrors, mattes)
    except ValueError as error:
        raise InputError(
            f"The balls tell no light: {error}.", "Add a photo with an exposure between, or name fewer balls."
        ) from error


def _photo_of(
    ball: NamedBall,
    record: ImageRecord,
    pictures: Pictures,
    model: Any,
    held_out: Collection[str],
    light_from_poses: np.ndarray,
) -> BallPhoto:
    from stages.shading.balls import BallPhoto

    image = model.find_image_with_name(record.name)
    if image is None or not image.has_pose:
        raise InputError(
            f"{ball.source}, in which a {ball.kind} ball is, could not be placed among the photos: nothing says where "
            "its light comes from.",
            "Name a ball in a photo that has a pose: the report lists them.",
        )
    if record.name in held_out:
        raise InputError(
            f"{ball.source}, in which a {ball.kind} ball is, is held out: nothing may be learned from it.",
            "Name a ball in another photo, or hold others out: `--hold-out N`.",
        )
    scale = record.width / (record.taken or (record.width, record.height))[0]
    _check_radius(ball, scale)
    camera = model.cameras[image.camera_id]

    def rays_of(pixels: np.ndarray) -> np.ndarray:
        return np.concatenate([camera.cam_from_img(pixels), np.ones((len(pixels), 1))], axis=1)

    return BallPhoto(
        center=(scale * ball.center[0], scale * ball.center[1]),
        radius=scale * ball.radius,
        pixels=pictures.image(record.name),
        rays_of=rays_of,
        pixels_of=lambda rays: np.asarray(camera.img_from_cam(rays)),
        light_from_cam=light_from_poses @ image.cam_from_world().rotation.matrix().T,
    )


def _check_radius(ball: NamedBall, scale: float) -> None:
    if scale * ball.radius < LEAST_RADIUS:
        reduced = "" if scale == 1 else f" and {scale * ball.radius:.1f} in the photo as it was reduced"
        raise InputError(
            f"The {ball.kind} ball in {ball.source} has a radius of {ball.radius:g} pixels{reduced}; at least "
            f"{LEAST_RADIUS:g} are needed.",
            "Name one in a photo from nearer by" + ("." if scale == 1 else ", or raise `--set ingest.max_side`."),
        )
