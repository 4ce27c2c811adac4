"""What bake publishes: textures, where their colours came from, and how well each vertex is known."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages.artifacts.artifact import Artifact, arrays_artifact, place_artifact
from stages.artifacts.json_files import read_record, write_json


@dataclass(frozen=True)
class VertexQuality:
    """How well each vertex of the atlas is known, see `stages.texture.vertex_quality`.

    Attributes:
        seen_by: [V] uint16 photos that see it.
        facing: [V] float32 cosine between the normal and the direction to the photo that sees it most squarely; 0
            where none does.
        ambiguity: [V] float32 the paper's lambda: how far the photos disagree on its colour.
        photo_density: [V] float32 pixels per scene unit of the photo that shows it largest; 0 where none does.
        texel_density: [V] float32 texels per scene unit.
        invented: [V] float32 part of the texels around it that no photo saw.
    """

    seen_by: np.ndarray
    facing: np.ndarray
    ambiguity: np.ndarray
    photo_density: np.ndarray
    texel_density: np.ndarray
    invented: np.ndarray


_GAINS = "gains.json"


def _save_gains(folder: Path, gains: Mapping[str, Sequence[float]]) -> None:
    write_json(folder / _GAINS, {name: [float(factor) for factor in factors] for name, factors in gains.items()})


def _load_gains(folder: Path) -> Mapping[str, Sequence[float]]:
    return read_record(folder / _GAINS, dict[str, tuple[float, float, float]])


# 8-bit sRGB texture; row 0 is v = 1.
BASE_COLOR = place_artifact("bake", "base_color.png")
# 8-bit grey, one value a texel, see `stages.texture.baking.Provenance`.
PROVENANCE = place_artifact("bake", "provenance.png")
# 8-bit tangent-space normals, +Y up, see `stages.texture.relief.bake_normals`.
NORMAL_MAP = place_artifact("bake", "normal_map.png", optional=True)
# 8-bit grey, 255 where all is open, see `stages.texture.relief.bake_occlusion`.
OCCLUSION = place_artifact("bake", "occlusion.png", optional=True)
QUALITY = arrays_artifact("bake", "vertex_quality.npz", VertexQuality)
# Factors on each photo's channels, by its name, that bring its exposure to that of the others; all 1 where `bake.gain`
# is off. Photos held out have none.
GAINS: Artifact[Mapping[str, Sequence[float]]] = Artifact("bake", (_GAINS,), _load_gains, _save_gains)
