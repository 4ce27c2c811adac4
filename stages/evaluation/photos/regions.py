"""Photos that nothing was learned from, against drawings of the trained field, of the textured mesh and of splats.

H x W pixels. Two regions are scored:

- object: the photo's mask, or the mesh's silhouette where there is none, as far as the field says something;
- whole: the whole photo. A field that has learned a background is held against the photo as it is. Any other
  field, the mesh and the splats are laid on white, as is what the mask leaves out of the photo; without a mask they
  have no such score, but for splats that were made with their background.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.evaluation.photos.images import ImageScore, Lpips, score_image
from stages.neural.drawing import FieldDrawing

WHITE = 255


@dataclass(frozen=True)
class RegionScores:
    """Scores of one drawing; None where a region cannot be scored.

    Attributes:
        object, whole: see the module.
    """

    object: ImageScore | None
    whole: ImageScore | None


@dataclass(frozen=True)
class Judged:
    """One photo against its drawings.

    Attributes:
        field, mesh: their scores.
        splats: theirs; None where there are none.
        pictures: "photo", "field", "mesh" and "splats", [H, W, 3] uint8, as they are compared as a whole.
    """

    field: RegionScores
    mesh: RegionScores
    splats: RegionScores | None
    pictures: dict[str, np.ndarray]


def judge(
    photo: np.ndarray,
    mask: np.ndarray | None,
    field: FieldDrawing,
    mesh: np.ndarray,
    silhouette: np.ndarray,
    lpips: Lpips | None = None,
    splats: np.ndarray | None = None,
    splats_everywhere: bool = False,
) -> Judged:
    """Scores of a photo's drawings.

    Args:
        photo: [H, W, 3] uint8.
        mask: [H, W] bool, true on the object; None: there is none.
        field: of the trained field.
        mesh: [H, W, 3] uint8 of the textured mesh, white around it.
        silhouette: [H, W] bool, where the mesh is.
        splats: as `mesh`, of the Gaussians; None: there are none.
        splats_everywhere: they show what is around the object, too.
    """
    counted = (silhouette if mask is None else mask) & field.drawn
    on_white = _on_white(photo, mask)
    seen = field.colors if field.background else laid_on_white(field)
    field_truth = photo if field.background else None if mask is None else on_white

    def scores(image: np.ndarray, colors: np.ndarray, whole: np.ndarray | None) -> RegionScores:
        return _scores(image, colors, photo, counted, whole, lpips)

    surface_truth = None if mask is None else on_white
    pictures = {"photo": photo if field.background else on_white, "field": seen, "mesh": mesh}
    return Judged(
        scores(seen, field.colors, field_truth),
        scores(mesh, mesh, surface_truth),
        None if splats is None else scores(splats, splats, photo if splats_everywhere else surface_truth),
        pictures if splats is None else {**pictures, "splats": splats},
    )


def judge_surface(
    photo: np.ndarray, mask: np.ndarray | None, mesh: np.ndarray, silhouette: np.ndarray, lpips: Lpips | None = None
) -> RegionScores:
    """Scores of a drawing of a textured mesh where no field is drawn beside it: see `judge`."""
    counted = silhouette if mask is None else mask
    return _scores(mesh, mesh, photo, counted, None if mask is None else _on_white(photo, mask), lpips)


def _scores(
    image: np.ndarray,
    colors: np.ndarray,
    photo: np.ndarray,
    counted: np.ndarray,
    whole: np.ndarray | None,
    lpips: Lpips | None,
) -> RegionScores:
    """Of colours against the photo where it counts, and of an image against a whole one where there is one."""
    inside = score_image(colors, photo, counted, lpips) if counted.any() else None
    return RegionScores(inside, None if whole is None else score_image(image, whole, None, lpips))


def _on_white(photo: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    return photo if mask is None else np.where(mask[..., None], photo, np.uint8(WHITE))


def laid_on_white(field: FieldDrawing) -> np.ndarray:
    """[H, W, 3] uint8: the field's colours, and white as far as it is not opaque."""
    open_part = 1 - field.opacity[..., None]
    return np.clip(field.colors + WHITE * open_part + 0.5, 0, WHITE).astype(np.uint8)
