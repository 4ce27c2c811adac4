"""What bake publishes: textures, where their colours came from, and how well each vertex is known."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from stages.artifacts.artifact import Artifact, place_artifact

BASE_COLOR_FILE = "base_color.png"
PROVENANCE_FILE = "provenance.png"
NORMAL_MAP_FILE = "normal_map.png"
OCCLUSION_FILE = "occlusion.png"
QUALITY_FILE = "vertex_quality.npz"


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


def save_quality(folder: Path, quality: VertexQuality) -> None:
    np.savez(folder / QUALITY_FILE, **asdict(quality))


def load_quality(folder: Path) -> VertexQuality:
    with np.load(folder / QUALITY_FILE) as data:
        return VertexQuality(**data)


def base_color_path(folder: Path) -> Path:
    """8-bit sRGB texture; row 0 is v = 1."""
    return folder / BASE_COLOR_FILE


def provenance_path(folder: Path) -> Path:
    """8-bit grey, one value a texel, see `stages.texture.baking.Provenance`."""
    return folder / PROVENANCE_FILE


def normal_map_path(folder: Path) -> Path:
    """8-bit tangent-space normals, +Y up, see `stages.texture.relief.bake_normals`. May not exist."""
    return folder / NORMAL_MAP_FILE


def occlusion_path(folder: Path) -> Path:
    """8-bit grey, 255 where all is open, see `stages.texture.relief.bake_occlusion`. May not exist."""
    return folder / OCCLUSION_FILE


BASE_COLOR = place_artifact("bake", BASE_COLOR_FILE)
PROVENANCE = place_artifact("bake", PROVENANCE_FILE)
NORMAL_MAP = place_artifact("bake", NORMAL_MAP_FILE, optional=True)
OCCLUSION = place_artifact("bake", OCCLUSION_FILE, optional=True)
QUALITY = Artifact("bake", (QUALITY_FILE,), load_quality, save_quality)
