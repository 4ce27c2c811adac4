"""What a made-up scene consists of. Frame: z up, the ground is z = 0, the largest extent of what is looked at is 1."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

# Linear albedo [P, 3] at points [P, 3] with unit normals [P, 3].
Paint = Callable[[np.ndarray, np.ndarray], np.ndarray]

FINISHES = ("matte", "glossy", "metal", "mirror")


@dataclass(frozen=True)
class Principled:
    """A finish with known parameters: Disney's principled surface with F0 = 0.04 where it is no metal.

    Attributes:
        roughness: perceptual, 0 to 1; the microfacets' alpha is its square.
        metallic: 0 to 1.
    """

    roughness: float
    metallic: float


@dataclass(frozen=True)
class Part:
    """A triangle mesh with its paint.

    Attributes:
        vertices: [V, 3].
        faces: [F, 3] int, outward.
        finish: one of FINISHES, or one with known parameters.
        paint: evaluated at the vertices.
        normals: [V, 3] unit, to shade with; None: each face is flat.
        grain: longest edge that is painted; longer ones are split before, which leaves the surface as it is. None:
            the vertices lie dense enough.
    """

    vertices: np.ndarray
    faces: np.ndarray
    finish: str | Principled
    paint: Paint
    normals: np.ndarray | None = None
    grain: float | None = None

    def __post_init__(self) -> None:
        if not isinstance(self.finish, Principled) and self.finish not in FINISHES:
            raise ValueError(f"finish: expected one of {FINISHES}, got {self.finish}")


@dataclass(frozen=True)
class Ground:
    """A printed square around the origin, `side` wide, at z = `height`; image [S, S, 3] of linear albedo."""

    image: np.ndarray
    side: float
    height: float


@dataclass(frozen=True)
class Scene:
    """What the photographer finds.

    Attributes:
        parts: what is looked at; together they are the known surface.
        ground: under it, not part of it; None: the parts are all there is, and the exposure is set for them.
        sky: radiance [H, 2 H, 3] by direction, row 0 at the zenith, column 0 at +x, towards +y.
        cam_from_world: [N, 4, 4], OpenCV axes.
    """

    parts: tuple[Part, ...]
    ground: Ground | None
    sky: np.ndarray
    cam_from_world: np.ndarray

    def surface(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices [V, 3] and faces [F, 3] of all parts."""
        starts = np.cumsum([0, *(len(part.vertices) for part in self.parts)])
        faces = [part.faces + start for part, start in zip(self.parts, starts, strict=False)]
        return np.concatenate([part.vertices for part in self.parts]), np.concatenate(faces)


def plain(*color: float) -> Paint:
    """One colour everywhere."""
    return lambda points, normals: np.broadcast_to(np.array(color), points.shape)
