"""Charts and photos to a base-colour texture, with maps of where colours came from, of normals and of occlusion."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from configs.params import BakeParams
from stages.artifacts import (
    AROUND_MESH,
    ATLAS_MESH,
    BASE_COLOR,
    CAMERAS,
    CLEAN_FULL_MESH,
    FIELD,
    GAINS,
    HELD_OUT,
    NORMAL_MAP,
    OCCLUSION,
    PINHOLE_PHOTOS,
    PROVENANCE,
    QUALITY,
    write_png,
)
from stages.artifacts.blocks import ROUGH_GAINS, read_rough_gains
from stages.engine.stage import Stage, StageContext
from stages.errors import ReconstructionError


def run(context: StageContext[BakeParams]) -> dict[str, Any]:
    """Bake the textures. Returns `stages.texture.baking.Baked.numbers`, and how much of the normal map is known."""
    from stages.drawing.rasterizing import rasterize_atlas
    from stages.neural.trained_field import load_field
    from stages.surface.triangle_mesh import median_edge
    from stages.texture.baking import bake_texture
    from stages.texture.relief import bake_normals, bake_occlusion, relief_texels
    from stages.texture.vertex_quality import VertexWitness

    photos, cameras, held_out = context.read(PINHOLE_PHOTOS), context.read(CAMERAS), context.read(HELD_OUT)
    cameras = cameras.select([i for i, name in enumerate(cameras.names) if name not in held_out])
    atlas = context.read(ATLAS_MESH)
    field = load_field(context.read(FIELD), context.device)
    params = context.params
    texels = rasterize_atlas(atlas.uvs, atlas.faces, atlas.texture_size)
    witness = VertexWitness(atlas, len(cameras))
    try:
        baked = bake_texture(
            atlas,
            texels,
            cameras,
            lambda index: photos.masked(cameras.names[index]),
            field.color,
            views=params.views,
            detail=params.detail,
            gain=params.gain,
            diffuse=params.diffuse,
            robust_sigma=params.robust_sigma,
            workers=context.workers,
            listener=context.progress,
            visit=witness.look,
            rough_gains=_rough_gains(context, cameras.names),
            others=context.read(AROUND_MESH),
        )
    except ValueError as error:
        raise ReconstructionError(
            f"The texture could not be baked: {error}.",
            "Rebuild the inputs: `hineus run PHOTOS --from undistort`.",
        ) from error
    write_png(context.to_write(BASE_COLOR), baked.base_color)
    write_png(context.to_write(PROVENANCE), baked.provenance)
    context.write(GAINS, dict(zip(cameras.names, baked.gains, strict=True)))
    context.write(QUALITY, witness.quality(texels, baked.provenance))
    numbers = dict(baked.numbers)
    full = context.read(CLEAN_FULL_MESH)
    texels = relief_texels(atlas, texels, median_edge(*full))
    if params.normal_map:
        normal_map, met = bake_normals(atlas, texels, *full, partial(context.progress, note="normals"))
        write_png(context.to_write(NORMAL_MAP), normal_map)
        numbers["normals_share"] = round(met, 4)
    if params.occlusion_rays > 0:
        tell = partial(context.progress, note="occlusion")
        occlusion = bake_occlusion(atlas, texels, params.occlusion_rays, params.occlusion_reach, tell)
        write_png(context.to_write(OCCLUSION), occlusion)
    return numbers


def _rough_gains(context: StageContext[BakeParams], names: Sequence[str]) -> np.ndarray | None:
    """[N, 3] of the photos as the whole of this block has them, NaN where it has none; None where this is no block."""
    if ROUGH_GAINS not in context.sources:
        return None
    given = read_rough_gains(context.sources[ROUGH_GAINS])
    return np.array([given.get(name, (np.nan, np.nan, np.nan)) for name in names])


BAKE: Stage[BakeParams] = Stage(
    name="bake",
    version=9,
    settings=lambda config: config.bake,
    run=run,
    reads=(PINHOLE_PHOTOS, CAMERAS, FIELD, HELD_OUT, AROUND_MESH, CLEAN_FULL_MESH, ATLAS_MESH),
    writes=(BASE_COLOR, PROVENANCE, NORMAL_MAP, OCCLUSION, GAINS, QUALITY),
    sources=(ROUGH_GAINS,),
    summary="charts + photos -> textures",
)
