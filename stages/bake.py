"""Charts and photos to a base-colour texture, with a map of where each texel's colour came from."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from stages import artifacts
from stages.engine.stage import Stage, StageContext
from stages.errors import ReconstructionError, WorkspaceError
from stages.geometry.cameras import PinholeCameras


def run(context: StageContext) -> dict[str, Any]:
    """Bake the texture. Returns `stages.meshing.baking.Baked.numbers`."""
    from stages.meshing.baking import bake_texture
    from stages.neural.field import load_field

    undistorted = context.inputs["undistort"]
    cameras = artifacts.load_scene(undistorted).cameras
    atlas = artifacts.load_atlas(context.inputs["atlas"])
    field = load_field(artifacts.field_path(context.inputs["train"]), context.device)
    params = context.params
    try:
        baked = bake_texture(
            atlas,
            cameras,
            lambda index: load_photo(undistorted, cameras, index),
            field.color,
            atlas.texture_size,
            views=params.views,
            detail=params.detail,
            gain=params.gain,
            robust_sigma=params.robust_sigma,
            workers=context.workers,
            listener=context.progress,
        )
    except ValueError as error:
        raise ReconstructionError(
            f"The texture could not be baked: {error}.",
            "Rebuild the inputs: `hineus run PHOTOS --from undistort`.",
        ) from error
    write_png(artifacts.base_color_path(context.out), baked.base_color)
    write_png(artifacts.provenance_path(context.out), baked.provenance)
    return baked.numbers


def load_photo(undistorted: Path, cameras: PinholeCameras, index: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Undistorted photo [H, W, 3] uint8 RGB and its mask [H, W] bool, or None where there is no mask."""
    import cv2

    name = cameras.names[index]
    photo = cv2.imread(str(artifacts.image_path(undistorted, name)), cv2.IMREAD_COLOR)
    if photo is None:
        raise WorkspaceError(
            f"The undistorted image {name} cannot be read.",
            "Make it again: `hineus run PHOTOS --force undistort`.",
        )
    mask_file = artifacts.mask_path(undistorted, name)
    mask = cv2.imread(str(mask_file), cv2.IMREAD_GRAYSCALE) if mask_file.exists() else None
    return cv2.cvtColor(photo, cv2.COLOR_BGR2RGB), None if mask is None else mask > 127


def write_png(path: Path, image: np.ndarray) -> None:
    """Write [H, W] or [H, W, 3] RGB uint8. A full disk raises OSError; OpenCV's own writer hides it."""
    import cv2

    data = cv2.cvtColor(image, cv2.COLOR_RGB2BGR) if image.ndim == 3 else image
    _, encoded = cv2.imencode(".png", data)
    path.write_bytes(encoded.tobytes())


BAKE = Stage(
    name="bake",
    version=2,
    needs=("undistort", "train", "atlas"),
    params="bake",
    run=run,
    summary="charts + photos -> texture",
)
