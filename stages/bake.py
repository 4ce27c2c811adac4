"""Charts and photos to a base-colour texture, with maps of where colours came from, of normals and of occlusion."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from stages import artifacts
from stages.engine.stage import Stage, StageContext
from stages.errors import ReconstructionError
from stages.geometry.cameras import PinholeCameras


def run(context: StageContext) -> dict[str, Any]:
    """Bake the textures. Returns `stages.texture.baking.Baked.numbers`, and how much of the normal map is known."""
    from stages.drawing.rasterizing import rasterize_atlas
    from stages.neural.trained_field import load_field
    from stages.texture.baking import bake_texture
    from stages.texture.relief import bake_normals, bake_occlusion
    from stages.texture.vertex_quality import VertexWitness

    undistorted = context.inputs["undistort"]
    cameras = artifacts.load_scene(undistorted).cameras
    held_out = artifacts.load_held_out(context.inputs["train"])
    cameras = cameras.select([i for i, name in enumerate(cameras.names) if name not in held_out])
    atlas = artifacts.load_atlas(context.inputs["atlas"])
    field = load_field(artifacts.field_path(context.inputs["train"]), context.device)
    params = context.params
    texels = rasterize_atlas(atlas.uvs, atlas.faces, atlas.texture_size)
    witness = VertexWitness(atlas, len(cameras))
    try:
        baked = bake_texture(
            atlas,
            texels,
            cameras,
            lambda index: load_photo(undistorted, cameras, index),
            field.color,
            views=params.views,
            detail=params.detail,
            gain=params.gain,
            diffuse=params.diffuse,
            robust_sigma=params.robust_sigma,
            workers=context.workers,
            listener=context.progress,
            visit=witness.look,
        )
    except ValueError as error:
        raise ReconstructionError(
            f"The texture could not be baked: {error}.",
            "Rebuild the inputs: `hineus run PHOTOS --from undistort`.",
        ) from error
    artifacts.write_png(artifacts.base_color_path(context.out), baked.base_color)
    artifacts.write_png(artifacts.provenance_path(context.out), baked.provenance)
    artifacts.save_quality(context.out, witness.quality(texels, baked.provenance))
    numbers = dict(baked.numbers)
    if params.normal_map:
        full = artifacts.load_mesh(context.inputs["cleanup"], artifacts.FULL_MESH)
        normal_map, met = bake_normals(
            atlas, texels, *full, lambda done, total: context.progress(done, total, "normals")
        )
        artifacts.write_png(artifacts.normal_map_path(context.out), normal_map)
        numbers["normals_share"] = round(met, 4)
    if params.occlusion_rays > 0:
        occlusion = bake_occlusion(
            atlas,
            texels,
            params.occlusion_rays,
            params.occlusion_reach,
            lambda done, total: context.progress(done, total, "occlusion"),
        )
        artifacts.write_png(artifacts.occlusion_path(context.out), occlusion)
    return numbers


def load_photo(undistorted: Path, cameras: PinholeCameras, index: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Undistorted photo [H, W, 3] uint8 RGB and its mask [H, W] bool, or None where there is no mask."""
    name = cameras.names[index]
    mask = artifacts.load_mask(undistorted, name)
    return artifacts.load_image(undistorted, name), None if mask is None else mask > 127


BAKE = Stage(
    name="bake",
    version=6,
    needs=("undistort", "train", "cleanup", "atlas"),
    params="bake",
    run=run,
    summary="charts + photos -> textures",
)
