"""Clean mesh to UV charts: no overlaps, padding between them."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from configs.params import AtlasParams
from stages.artifacts import ATLAS_MESH, CAMERAS, CLEAN_MESH, AtlasMesh
from stages.engine.stage import Stage, StageContext
from stages.errors import ReconstructionError

if TYPE_CHECKING:
    from stages.texture.charts import UvLayout

logger = logging.getLogger(__name__)


def run(context: StageContext[AtlasParams]) -> dict[str, Any]:
    from stages.texture.chart_quality import chart_quality
    from stages.texture.charts import smooth_normals

    vertices, faces = context.read(CLEAN_MESH)
    context.progress(0, 1, f"charts for {len(faces)} faces")
    method, size, layout, why = _unwrapped(context, vertices, faces)
    context.write(
        ATLAS_MESH,
        AtlasMesh(
            vertices=vertices[layout.source].astype(np.float32),
            normals=smooth_normals(vertices, faces, layout.source),
            uvs=np.clip(layout.texels / size, 0, 1).astype(np.float32),
            faces=layout.faces,
            texture_size=size,
        ),
    )
    quality = chart_quality(vertices, faces, layout, size)
    return {
        "method": method,
        "texture_size": size,
        "fallback_reason": why,
        "charts": quality.charts,
        "faces": len(faces),
        "vertices": len(layout.source),
        "texture_used": round(quality.fill, 4),
        "seam_length": round(quality.seam_length, 2),
        "stretch": round(quality.stretch, 4),
    }


def _unwrapped(
    context: StageContext[AtlasParams], vertices: np.ndarray, faces: np.ndarray
) -> tuple[str, int, UvLayout, str]:
    """The way that was taken, the texture's size, the charts, and why other ways were not taken.

    Raises:
        ReconstructionError: the charts do not fit the texture whichever way they are made.
    """
    from stages.texture import charts

    params = context.params
    size_for = _texture_size(context, vertices, faces)
    names = list(charts.WAYS)
    reasons: list[str] = []
    for name in names[names.index(params.method) :]:
        way = charts.WAYS[name]
        size = size_for(way.fill)
        try:
            return name, size, way.unwrap(vertices, faces, size, params.padding, params.time_limit), "; ".join(reasons)
        except charts.ChartsError as error:
            reasons.append(str(error))
            logger.warning("%s; trying another way", error)
    size = size_for(charts.PROJECTED_FILL)
    try:
        return "projected", size, charts.unwrap_projected(vertices, faces, size, params.padding), "; ".join(reasons)
    except ValueError as misfit:
        raise ReconstructionError(
            f"The charts do not fit the texture: {misfit}.",
            f"Try `--set atlas.texture_size={2 * size}`, or `--set cleanup.target_faces=20000`.",
        ) from misfit


def _texture_size(
    context: StageContext[AtlasParams], vertices: np.ndarray, faces: np.ndarray
) -> Callable[[float], int]:
    """The size of texture for charts that fill such a part of it: as asked for, or what the photos can fill."""
    from stages.texture.footprint import pixels_per_area, texels_needed, texture_size_for

    if context.params.texture_size is not None:
        asked = context.params.texture_size
        return lambda fill: asked
    texels = texels_needed(*pixels_per_area(vertices, faces, context.read(CAMERAS)))
    return lambda fill: texture_size_for(texels, fill)


ATLAS: Stage[AtlasParams] = Stage(
    name="atlas",
    version=4,
    settings=lambda config: config.atlas,
    run=run,
    reads=(CAMERAS, CLEAN_MESH),
    writes=(ATLAS_MESH,),
    summary="UV charts without overlaps",
)
