"""Clean mesh to UV charts: no overlaps, padding between them."""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from configs.params import AtlasParams
from stages.artifacts import ATLAS_MESH, CAMERAS, CLEAN_MESH, AtlasMesh
from stages.engine.stage import Stage, StageContext
from stages.errors import ReconstructionError

logger = logging.getLogger(__name__)


def run(context: StageContext[AtlasParams]) -> dict[str, Any]:
    from stages.texture import charts

    params = context.params
    vertices, faces = context.read(CLEAN_MESH)
    size = params.texture_size or _fitting_size(context, vertices, faces)
    context.progress(0, 1, f"charts for {len(faces)} faces")
    method, why = "xatlas", ""
    try:
        layout = charts.unwrap_xatlas(vertices, faces, size, params.padding, params.time_limit)
    except charts.XatlasError as error:
        method, why = "projected", str(error)
        logger.warning("%s; projecting along the axes instead", error)
        try:
            layout = charts.unwrap_projected(vertices, faces, size, params.padding)
        except ValueError as misfit:
            raise ReconstructionError(
                f"The charts do not fit the texture: {misfit}.",
                f"Try `--set atlas.texture_size={2 * size}`, or `--set cleanup.target_faces=20000`.",
            ) from misfit
    uvs = layout.texels / size
    context.write(
        ATLAS_MESH,
        AtlasMesh(
            vertices=vertices[layout.source].astype(np.float32),
            normals=charts.smooth_normals(vertices, faces, layout.source),
            uvs=np.clip(uvs, 0, 1).astype(np.float32),
            faces=layout.faces,
            texture_size=size,
        ),
    )
    corners = uvs[layout.faces]
    edges = corners[:, 1:] - corners[:, :1]
    used = np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]).sum() / 2
    return {
        "method": method,
        "texture_size": size,
        "fallback_reason": why,
        "charts": int(layout.charts.max()) + 1,
        "faces": len(faces),
        "vertices": len(layout.source),
        "texture_used": round(float(used), 4),
    }


def _fitting_size(context: StageContext[AtlasParams], vertices: np.ndarray, faces: np.ndarray) -> int:
    """The size of texture that the photos can fill."""
    from stages.texture.footprint import pixels_per_area, texture_size_for

    return texture_size_for(*pixels_per_area(vertices, faces, context.read(CAMERAS)))


ATLAS: Stage[AtlasParams] = Stage(
    name="atlas",
    version=3,
    settings=lambda config: config.atlas,
    run=run,
    reads=(CAMERAS, CLEAN_MESH),
    writes=(ATLAS_MESH,),
    summary="UV charts without overlaps",
)
