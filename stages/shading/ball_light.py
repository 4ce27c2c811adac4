"""The light of all around from what balls show of it.

A chrome ball shows each direction but those behind it. Photos of several are brought to one exposure and averaged; what
is clipped in all of them is at least so bright. A grey ball shows sums over half of all directions, which tell a
smooth light; beside chrome ones they tell what those leave open: how bright is what is clipped, and what lies behind.

P: pixels of the map. Q: normals of a grey ball.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from stages.light.environment import directions, look_up, resized, solid_angles
from stages.shading.balls import MatteBall, MirrorBall
from stages.shading.fitting import smoothed

# Rows of a map that grey balls tell alone, and at most where they complete one of chrome balls.
GREY_ROWS, COMPLETED_ROWS = 16, 64
STEPS = 300
SMOOTHNESS = 0.02
# What lights a grey ball less than this part of what lights it best, which is seen along its rim alone, is not told:
# a little noise there would make it a lamp.
LEAST_TOLD = 0.1
# Linear radiance between these is exposed well enough to compare two photos by; so many directions must be.
DARKEST, BRIGHTEST = 0.004, 0.8
FEWEST_SHARED = 20
_TINY = 1e-6  # weights and radiances below this are none


@dataclass(frozen=True)
class BallLight:
    """A light, and what the balls leave open of it.

    Attributes:
        radiance: [H, 2 H, 3] float32, in units of the first ball's photo.
        clipped: share of the sphere that is at least so bright and maybe brighter.
        unseen: share of the sphere that no ball shows.
    """

    radiance: np.ndarray
    clipped: float
    unseen: float


def light_of(mirrors: Sequence[MirrorBall], mattes: Sequence[MatteBall]) -> BallLight:
    """The light that balls show; at least one of them, none black.

    Raises:
        ValueError: photos of chrome balls have exposures that are too far apart.
    """
    if not mirrors:
        height = GREY_ROWS
        start = np.full((height, 2 * height, 3), np.concatenate([ball.colors for ball in mattes]).mean(), np.float32)
        light = completed(start, np.ones_like(start, dtype=bool), np.zeros_like(start), mattes)
        return BallLight(light, 0.0, _share(~told_by(mattes, height)))
    merged, seen, clipped = averaged(mirrors)
    light = filled(merged, seen)
    if mattes:
        height = min(len(light), COMPLETED_ROWS)
        light = resized(light, height)
        unknown = resized((~seen).astype(np.float32)[..., None], height) > 0.5
        bound = resized(clipped.astype(np.float32), height) > 0
        light = completed(light, unknown | bound, np.where(bound, light, 0), mattes)
    return BallLight(light, 0.0 if mattes else _share(np.any(clipped, axis=2)), _share(~seen))


# ---------------------------------------------------------------- chrome
def averaged(mirrors: Sequence[MirrorBall]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One map of all, each brought to the exposure of those before it.

    A photo counts by its exposure, for the light that it gathered; what is clipped only where all others are, too, or
    do not show it.

    Returns:
        radiance [H, 2 H, 3]; [H, 2 H] what is seen; [H, 2 H, 3] what is clipped in all that see it.

    Raises:
        ValueError: exposures are too far apart.
    """
    height = max(len(ball.radiance) for ball in mirrors)
    total = weights = np.zeros((height, 2 * height, 3), np.float32)
    bound, seen = np.zeros_like(total), np.zeros(total.shape[:2], bool)
    for k, ball in enumerate(mirrors):
        parts = [ball.radiance, ball.seen[..., None], ball.clipped]
        found = resized(np.concatenate(parts, axis=2, dtype=np.float32), height)
        shown, sees, clips = found[..., :3], found[..., 3:4] > 0.5, found[..., 4:] > 0
        usable = sees & ~clips
        gain = _gain(shown, usable, total / np.maximum(weights, _TINY), weights > 0) if k else 1.0
        total = total + usable.astype(np.float32) * shown  # of radiance times the exposure 1 / gain
        weights = weights + usable.astype(np.float32) / np.float32(gain)
        bound = np.maximum(bound, sees * shown * np.float32(gain))
        seen |= sees[..., 0]
    known = weights > 0
    merged = np.where(known, total / np.maximum(weights, _TINY), bound)
    return merged.astype(np.float32), seen, seen[..., None] & ~known


def _gain(shown: np.ndarray, usable: np.ndarray, before: np.ndarray, known: np.ndarray) -> float:
    """What brings a photo to the exposure of the map before.

    Raises:
        ValueError: they share too little.
    """
    both = usable & known & (shown > DARKEST) & (shown < BRIGHTEST) & (before > _TINY)
    if both.sum() < FEWEST_SHARED:
        raise ValueError(
            "two photos of chrome balls have exposures so far apart that they share nothing which both show well"
        )
    return float(np.exp(np.median(np.log(before[both] / shown[both]))))


def filled(radiance: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """A map [H, 2 H, 3] with what is not seen [H, 2 H] taken from around: ever coarser maps, down to the mean."""
    height = len(radiance)
    if seen.all() or height == 1:
        return np.where(seen[..., None], radiance, radiance.mean((0, 1)))
    weights = seen[..., None].astype(np.float32)
    coarse = resized(np.concatenate([radiance * weights, weights], axis=2), height // 2)
    around = filled(coarse[..., :3] / np.maximum(coarse[..., 3:], _TINY), coarse[..., 3] > _TINY)
    return np.where(seen[..., None], radiance, look_up(around, directions(height)))


# ---------------------------------------------------------------- grey
def received_by(normals: np.ndarray, height: int) -> np.ndarray:
    """Clamped cosines dω / π [Q, P] float32: what a white matte ball shows of each pixel of a map at its normals."""
    cosine = np.maximum(normals @ directions(height).reshape(-1, 3).T, 0)
    return (cosine * (solid_angles(height).reshape(-1) / np.pi)).astype(np.float32)


def told_by(mattes: Sequence[MatteBall], height: int) -> np.ndarray:
    """Which directions [H, 2 H] light what is seen of grey balls."""
    lit = np.sum([received_by(ball.normals, height).sum(0) for ball in mattes], axis=0).reshape(height, 2 * height)
    each = lit / solid_angles(height)
    told: np.ndarray = each >= LEAST_TOLD * each.max()
    return told


def completed(light: np.ndarray, free: np.ndarray, least: np.ndarray, mattes: Sequence[MatteBall]) -> np.ndarray:
    """A light of which grey balls tell what is free, by steps that multiply it (ISRA, see `fitting.find_light`).

    What a ball shows is s A L: its reflectance and its photo's exposure are one factor s, the same for all channels,
    which follows in closed form. Where the whole light is free the first ball's is 1, and what none tells is as what
    lies around it.

    Args:
        light: [H, 2 H, 3], the start.
        free: which of it may change [H, 2 H, 3]; `least`: above what it stays.
    """
    height, flat = len(light), light.reshape(-1, 3)
    free, least = free.reshape(-1, 3), least.reshape(-1, 3)
    changing, alone, told = free.any(1), bool(free.all()), told_by(mattes, height)
    received = [received_by(ball.normals, height) for ball in mattes]
    settled = [matrix[:, ~changing] @ flat[~changing] for matrix in received]
    received = [matrix[:, changing] for matrix in received]
    moving = (free & told.reshape(-1, 1))[changing]
    smooth = free & (least == 0)
    for _ in range(STEPS):
        part = flat[changing]
        top, bottom = np.zeros_like(part), np.zeros_like(part)
        for k, (matrix, constant, ball) in enumerate(zip(received, settled, mattes, strict=True)):
            shown = matrix @ part + constant
            scale = 1.0 if alone and k == 0 else float((shown * ball.colors).sum() / (shown**2).sum())
            top += matrix.T @ (ball.colors * np.float32(scale))
            bottom += matrix.T @ (shown * np.float32(scale**2))
        flat = flat.copy()
        flat[changing] = np.maximum(part * np.where(moving, top / np.maximum(bottom, 1e-12), 1), _TINY)
        flat = np.maximum(np.where(smooth, smoothed(torch.from_numpy(flat), SMOOTHNESS).numpy(), flat), least)
        if alone:
            flat = filled(flat.reshape(light.shape), told).reshape(-1, 3)
    return flat.reshape(light.shape)


def _share(part: np.ndarray) -> float:
    """Of the sphere, of a part [H, 2 H]."""
    return float((solid_angles(len(part)) * part).sum() / (4 * np.pi))
