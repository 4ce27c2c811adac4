"""Gaussians that draw what the photos show: Adam on everything, one photo a step (Kerbl et al. 2023).

Gaussians of the surface stay near it, as in the paper's supplement: each has an anchor, and keeps within a bound of it.
Those whose places in the image would move most are split, for that is where detail is missing; those that nobody sees
through are left out. The number of steps says how much is done, so that a run gives the same on any machine.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Protocol

import numpy as np

from stages.gaussians import drawing as cpu
from stages.gaussians import kernels
from stages.gaussians.drawing import Camera, Gradients
from stages.gaussians.gaussians import Gaussians
from stages.gaussians.photo_error import photo_error
from stages.gaussians.targets import Target

LEARNED = ("centers", "rotations", "log_scales", "opacity_logits", "harmonics")
# Steps' lengths at first: of centers in parts of the extent, then of the numbers themselves. Those of centers fall to a
# hundredth in the end; harmonics above degree 0 take smaller steps, for there are many of them (3DGS).
RATES = {"centers": 1.6e-4, "rotations": 1e-3, "log_scales": 5e-3, "opacity_logits": 2.5e-2, "harmonics": 2.5e-3}
LAST_RATE = 0.01
HIGHER_HARMONICS = 0.1
BETA_1, BETA_2 = 0.9, 0.999
# How far anchored Gaussians may get from their anchors, along the normal and across it, in parts of the extent.
ALONG, ACROSS = 0.004, 0.008
# Those that are not anchored keep as near to the point that they stand for.
AROUND = 0.02
# Splits happen at these parts of all steps, and each time this part of the Gaussians is added, as far as there is room.
SPLITS, SPLIT_SHARE = (0.15, 0.25, 0.35, 0.45, 0.55), 0.06
# A split one's halves: so many of its deviations apart from its centre, and smaller by this factor.
HALF_OFFSET, HALF_SIZE = 0.5, 1.6
# Less opaque ones are left out.
LEAST_OPACITY = 0.02

Listener = Callable[[float, float, str], None]


class Renderer(Protocol):
    """What draws, and leads errors back: `stages.gaussians.drawing` or `drawing_cuda`."""

    def render(self, gaussians: Gaussians, camera: Camera, background: tuple[float, float, float]) -> Any: ...

    def gradients(
        self, gaussians: Gaussians, drawing: Any, d_image: np.ndarray, d_transmittance: np.ndarray
    ) -> Gradients: ...


@dataclass
class Moments:
    """Adam's two moments of each learned array."""

    means: dict[str, np.ndarray]
    squares: dict[str, np.ndarray]

    @classmethod
    def none(cls, gaussians: Gaussians) -> Moments:
        return cls(*({name: np.zeros_like(getattr(gaussians, name)) for name in LEARNED} for _ in range(2)))

    def select(self, rows: np.ndarray, new: int) -> Moments:
        """Those of some rows, and of `new` more without any."""

        def chosen(moments: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
            return {
                name: np.concatenate([array[rows], np.zeros((new, *array.shape[1:]), np.float32)])
                for name, array in moments.items()
            }

        return Moments(chosen(self.means), chosen(self.squares))


@dataclass(frozen=True)
class Anchors:
    """Where Gaussians belong: [N, 3] points and, on the surface, its unit normals, 0 elsewhere; `extent` is the
    object's size."""

    points: np.ndarray
    normals: np.ndarray
    extent: float

    def select(self, rows: np.ndarray) -> Anchors:
        return Anchors(self.points[rows], self.normals[rows], self.extent)

    def hold(self, centers: np.ndarray, ids: np.ndarray) -> None:
        """Bring centers [N, 3] of Gaussians `ids` back into their bounds. In place."""
        points, normals = self.points[ids], self.normals[ids]
        off = centers[ids] - points
        height = (off * normals).sum(1, keepdims=True)
        across = off - height * normals
        length = np.linalg.norm(across, axis=1, keepdims=True)
        reach = np.where(normals.any(1, keepdims=True), ACROSS, AROUND) * self.extent
        across *= np.minimum(1, reach / np.maximum(length, 1e-12))
        height = np.clip(height, -ALONG * self.extent, ALONG * self.extent)
        centers[ids] = points + height * normals + across


def refine(
    gaussians: Gaussians,
    anchors: Anchors,
    targets: Sequence[Target],
    steps: int,
    most: int,
    listener: Listener | None = None,
    renderer: Renderer = cpu,
) -> tuple[Gaussians, list[float]]:
    """Refine by `steps` photos, up to `most` Gaussians. Returns them, and each step's error.

    Args:
        anchors: of all.
        targets: at least one.
    """
    rng = np.random.default_rng(0)
    gaussians = Gaussians(**{field.name: getattr(gaussians, field.name).copy() for field in fields(gaussians)})
    moments = Moments.none(gaussians)
    pull, seen = np.zeros(len(gaussians), np.float32), np.zeros(len(gaussians), np.float32)
    splits = {round(part * steps) for part in SPLITS}
    errors: list[float] = []
    order: list[int] = []
    for step in range(steps):
        order = order or rng.permutation(len(targets)).tolist()
        target = targets[order.pop()]
        background = rng.random(3).astype(np.float32)
        drawing = renderer.render(gaussians, target.camera, tuple(background))
        error, slope = photo_error(drawing.image, target.over(background, drawing.image))
        found = renderer.gradients(gaussians, drawing, slope.astype(np.float32), np.zeros_like(drawing.transmittance))
        pull[found.ids] += np.linalg.norm(found.means, axis=1)
        seen[found.ids] += 1
        _step(gaussians, found, moments, step, steps, anchors.extent)
        anchors.hold(gaussians.centers, found.ids)
        errors.append(error)
        if step in splits:
            room = max(0, min(most - len(gaussians), round(SPLIT_SHARE * most)))
            gaussians, anchors, moments = _split_and_prune(
                gaussians, anchors, moments, pull / np.maximum(seen, 1), room
            )
            pull, seen = np.zeros(len(gaussians), np.float32), np.zeros(len(gaussians), np.float32)
        if listener is not None and (step % 10 == 0 or step == steps - 1):
            listener(step + 1, steps, "refining")
    kept = gaussians.opacities >= LEAST_OPACITY
    return gaussians.select(kept), errors


def _step(gaussians: Gaussians, found: Gradients, moments: Moments, step: int, steps: int, extent: float) -> None:
    """One step of Adam, in place, on what showed in the photo."""
    fall = LAST_RATE ** (step / max(steps - 1, 1))
    for name in LEARNED:
        rows = len(gaussians)
        values = getattr(gaussians, name).reshape(rows, -1)
        rates = np.full(values.shape[1], RATES[name], np.float32)
        if name == "centers":
            rates *= extent * fall
        if name == "harmonics":
            rates[3:] *= HIGHER_HARMONICS
        gradient = getattr(found, name).reshape(len(found.ids), -1)
        mean, square = moments.means[name].reshape(rows, -1), moments.squares[name].reshape(rows, -1)
        kernels.adam(
            values, gradient, found.ids, mean, square, rates, np.float32(BETA_1), np.float32(BETA_2),
            np.float32(1 - BETA_1 ** (step + 1)), np.float32(1 - BETA_2 ** (step + 1)),
        )  # fmt: skip


def _split_and_prune(
    gaussians: Gaussians, anchors: Anchors, moments: Moments, pull: np.ndarray, room: int
) -> tuple[Gaussians, Anchors, Moments]:
    """Without transparent ones, and two in the place of each of the `room` with the largest mean gradients [N]."""
    kept = np.flatnonzero(gaussians.opacities >= LEAST_OPACITY)
    wanted = kept[np.argsort(-pull[kept], kind="stable")[:room]]
    wanted = wanted[pull[wanted] > 0]
    stays = np.setdiff1d(kept, wanted)
    rows = np.concatenate([stays, wanted, wanted])
    halves = _halves(gaussians.select(wanted)) if len(wanted) else []  # SciPy 1.13 takes no empty arrays of turns
    together = Gaussians.joined([gaussians.select(stays), *halves])
    return together, anchors.select(rows), moments.select(stays, 2 * len(wanted))


def _halves(gaussians: Gaussians) -> list[Gaussians]:
    """Two for each, side by side along its longest axis."""
    from scipy.spatial.transform import Rotation

    longest = gaussians.log_scales.argmax(1)
    rows = np.arange(len(gaussians))
    turns = Rotation.from_quat(gaussians.rotations[:, [1, 2, 3, 0]])  # SciPy has w last
    axes = turns.as_matrix()[rows, :, longest]
    offset = HALF_OFFSET * np.exp(gaussians.log_scales[rows, longest])[:, None] * axes
    log_scales = gaussians.log_scales.copy()
    log_scales[rows, longest] -= np.log(HALF_SIZE)
    smaller = replace(gaussians, log_scales=log_scales)
    return [replace(smaller, centers=(gaussians.centers + sign * offset).astype(np.float32)) for sign in (1, -1)]
