"""What a made-up capture consists of: textured things and cameras."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from stages.geometry.cameras import PinholeCameras

SIZE = (1600, 1200)  # pixels: a phone's photo, made smaller
FOCAL = 0.75  # of the longer side: 27 mm on 35 mm film, a phone's main camera


@dataclass(frozen=True)
class Thing:
    """A triangle mesh of one material.

    Attributes:
        vertices: [V, 3] metres.
        faces: [F, 3] int; two-sided.
        texture: 0 (plain: nothing to find there) to 1 (features everywhere).
        color: linear albedo, to render it.
    """

    vertices: np.ndarray
    faces: np.ndarray
    texture: float
    color: tuple[float, float, float] = (0.5, 0.5, 0.5)


@dataclass(frozen=True)
class Mesh:
    """Several things as one mesh: vertices [V, 3], faces [F, 3], the texture [F] of each face."""

    vertices: np.ndarray
    faces: np.ndarray
    texture: np.ndarray


@dataclass(frozen=True)
class Capture:
    """Who photographed what.

    Attributes:
        subject: what the photos are about.
        surroundings: everything else that they show.
        cam_from_world: [N, 4, 4], OpenCV axes.
        size: width and height in pixels.
        focal: pixels; the principal point is the middle.
    """

    subject: tuple[Thing, ...]
    surroundings: tuple[Thing, ...]
    cam_from_world: np.ndarray
    size: tuple[int, int] = SIZE
    focal: float = FOCAL * SIZE[0]

    @property
    def cameras(self) -> PinholeCameras:
        count, (width, height) = len(self.cam_from_world), self.size
        intrinsics = np.array([[self.focal, 0, width / 2], [0, self.focal, height / 2], [0, 0, 1]])
        return PinholeCameras(
            names=tuple(f"{i:03d}.png" for i in range(count)),
            sizes=np.tile(np.array(self.size), (count, 1)),
            intrinsics=np.tile(intrinsics, (count, 1, 1)),
            extrinsics=self.cam_from_world[:, :3],
        )

    def plain(self, texture: float) -> Capture:
        """The same with this part of the subject's texture."""
        return replace(self, subject=tuple(replace(thing, texture=thing.texture * texture) for thing in self.subject))


@dataclass(frozen=True)
class Posed:
    """What SfM leaves of a capture: all that the region of interest is found from.

    Attributes:
        cameras: N of them.
        points: [P, 3] sparse points in their frame.
        errors: [P] mean reprojection errors in pixels.
        observations: [M, 2] int: image index, point index.
        masks: N silhouettes [H, W], None where a photo has none; or None without any.
    """

    cameras: PinholeCameras
    points: np.ndarray
    errors: np.ndarray
    observations: np.ndarray
    masks: tuple[np.ndarray | None, ...] | None = None


def joined(things: tuple[Thing, ...]) -> Mesh:
    """All of them as one mesh."""
    starts = np.cumsum([0, *(len(thing.vertices) for thing in things)])
    return Mesh(
        np.concatenate([thing.vertices for thing in things]),
        np.concatenate([thing.faces + start for thing, start in zip(things, starts, strict=False)]),
        np.concatenate([np.full(len(thing.faces), thing.texture) for thing in things]),
    )
