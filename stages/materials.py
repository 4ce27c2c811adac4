"""Photos, mesh and texture to what the surface is made of, and the light it was photographed in.

The light is learned, too, unless it is given.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from configs.params import MaterialsParams
from stages.artifacts import (
    AROUND_MESH,
    ATLAS_MESH,
    BASE_COLOR,
    HELD_OUT,
    IMAGE_SET,
    KNOWN,
    LIGHT,
    LIGHT_HARMONICS,
    LIGHT_HDR,
    MATERIAL_COLOR,
    MODEL,
    OCCLUSION,
    ORM,
    PHOTOS,
    PINHOLE_PHOTOS,
    SCENE,
    WORLD_PLACE,
    read_texture,
    write_json,
    write_png,
)
from stages.engine.stage import Stage, StageContext
from stages.errors import ConfigError, ReconstructionError
from stages.files.light_files import GIVEN_LIGHT

if TYPE_CHECKING:
    from stages.shading.ball_light import BallLight
    from stages.shading.given_light import GivenLight, Placed

log = logging.getLogger(__name__)

# Points that materials and light are learned at, and photos that a point must be seen in.
POINTS, FEWEST_VIEWS = 6000, 3
FEWEST_POINTS = 50


def run(context: StageContext[MaterialsParams]) -> dict[str, Any]:
    """Learn materials and light, where asked. Returns them in numbers."""
    if not context.params.enabled:
        return {}
    import torch

    from stages.drawing.rasterizing import rasterize_atlas, surface_points
    from stages.files.light_files import harmonics_json, write_exr, write_hdr
    from stages.geometry.up import gltf_from_scene
    from stages.light.srgb import as_bytes, decoded
    from stages.shading.learning import learn
    from stages.shading.observations import observe
    from stages.shading.reflection import reflection
    from stages.shading.stains import without_stains
    from stages.shading.surroundings import look_around
    from stages.shading.texels import Points, base_colors
    from stages.texture.padding import pad_charts
    from stages.texture.prepared_views import PreparedViews

    torch.set_num_threads(context.workers)
    photos, held_out, scene = context.read(PINHOLE_PHOTOS), context.read(HELD_OUT), context.read(SCENE)
    cameras = scene.cameras.select([i for i, name in enumerate(scene.cameras.names) if name not in held_out])
    light_from_scene = gltf_from_scene(scene, context.read(WORLD_PLACE)).rotation
    given, of_balls = _given_light(context, light_from_scene @ scene.poses_from_scene.rotation.T)
    atlas = context.read(ATLAS_MESH)
    texture = read_texture(context.read(BASE_COLOR))
    texels = rasterize_atlas(atlas.uvs, atlas.faces, atlas.texture_size)
    baked = texture.reshape(-1, 3)[texels.index]
    others = context.read(AROUND_MESH)
    views = PreparedViews(atlas, len(texels), cameras, lambda index: photos.masked(cameras.names[index]), others)
    chosen = np.sort(np.random.default_rng(0).permutation(len(texels))[:POINTS])
    positions, normals = surface_points(atlas, texels.face_ids[chosen], texels.corner[chosen])
    tell = context.progress
    with ThreadPoolExecutor(max_workers=max(1, context.workers)) as pool:
        tell(0, 10, "looking at points in all photos")
        seen = observe(positions, normals, views.in_order(pool, context.workers))
        rows = np.flatnonzero((seen.weights > 0).sum(1) >= FEWEST_VIEWS)
        if len(rows) < FEWEST_POINTS:
            raise ReconstructionError(
                f"Materials cannot be learned: {len(rows)} of {len(positions)} points on the surface are seen by "
                f"{FEWEST_VIEWS} photos or more (need {FEWEST_POINTS}).",
                "Try it without: `hineus run PHOTOS --set materials.enabled=false`, or add photos from more sides.",
            )
        seen, positions, normals, chosen = seen.select(rows), positions[rows], normals[rows], chosen[rows]
        tell(2, 10, "what lies around points")
        linear = decoded(texture.astype(np.float32) / 255)
        around = look_around(atlas, linear, positions, normals, light_from_scene)
        reflected = reflection(seen, normals, around, light_from_scene)
        learned = learn(
            seen, reflected, positions, len(cameras),
            lambda done, total: tell(3 + 4 * done / total, 10, "materials and light in turn"), given,
        )  # fmt: skip
        tell(7, 10, "base colour of each texel")
        points = Points(positions, normals, baked[chosen].astype(np.float32) / 255, around)
        everywhere = surface_points(atlas, texels.face_ids, texels.corner)
        found = base_colors(
            *everywhere, baked, points, learned, light_from_scene,
            lambda: views.in_order(pool, context.workers), context.workers,
        )  # fmt: skip
    roughness = np.array([material.roughness for material in learned.materials])[found.which]
    metallic = np.array([material.metallic for material in learned.materials])[found.which]
    shown = baked.astype(np.float32) / 255
    color = without_stains(found.color, *everywhere, shown, metallic, chosen, context.workers)
    occlusion = _occlusion(context.read(OCCLUSION), atlas.texture_size).reshape(-1)[texels.index]
    orm = np.stack([occlusion, 255 * roughness + 0.5, 255.0 * metallic], axis=1).astype(np.uint8)
    write_png(context.to_write(MATERIAL_COLOR), pad_charts(*texels.paint(as_bytes(color)))[0])
    write_png(context.to_write(ORM), pad_charts(*texels.paint(orm))[0])
    write_png(context.to_write(KNOWN), texels.paint(found.told[:, None])[0][..., 0])
    placed = learned.placed
    light = learned.light if given is None or placed is None else given.written(placed)
    write_exr(context.to_write(LIGHT), light)
    write_hdr(context.to_write(LIGHT_HDR), light)
    write_json(context.to_write(LIGHT_HARMONICS), harmonics_json(light))
    shares = np.bincount(found.which, minlength=len(learned.materials)) / max(len(found.which), 1)
    return {
        "materials": [
            {
                "share": round(float(share), 4),
                "metallic": material.metallic,
                "roughness": round(material.roughness, 3),
                "roughness_told": material.told,
            }
            for share, material in zip(shares, learned.materials, strict=True)
        ],
        "light_max_over_mean": round(float(light.max() / light.mean()), 2),
        **({} if placed is None else _placed_numbers(placed)),
        **of_balls,
        "gain_min": round(float(learned.gains.min()), 4),
        "gain_max": round(float(learned.gains.max()), 4),
        "cost": round(learned.cost, 4),
    }


def _given_light(
    context: StageContext[MaterialsParams], light_from_poses: np.ndarray
) -> tuple[GivenLight | None, dict[str, Any]]:
    """The light of a file or of balls, where there is one, and what balls leave open of it, in numbers.

    Args:
        light_from_poses: rotation [3, 3].

    Raises:
        ConfigError: both are given.
        InputError: it cannot be used.
    """
    from stages.files.light_files import read_light
    from stages.shading.given_light import GivenLight

    file, params = context.sources.get(GIVEN_LIGHT), context.params
    if file is not None and params.balls:
        raise ConfigError(
            f"The light is given twice: as {file} and by balls in photos.",
            "`--no-light --ball ...` forgets the file, `--set materials.balls=[]` the balls.",
        )
    if params.balls:
        found = _light_of_balls(context, light_from_poses)
        numbers = {"light_unseen": round(found.unseen, 4), "light_clipped": round(found.clipped, 4)}
        return GivenLight(found.radiance, params.light_turn or 0.0), numbers
    return None if file is None else GivenLight(read_light(file), params.light_turn), {}


def _light_of_balls(context: StageContext[MaterialsParams], light_from_poses: np.ndarray) -> BallLight:
    import pycolmap

    from stages.posing.undistortion import png_names, registered_photos
    from stages.shading.named_balls import light_of_balls

    model = pycolmap.Reconstruction(str(context.read(MODEL)))
    names = [photo.name for photo in registered_photos(model)]
    held_out: Sequence[str] = context.read(HELD_OUT)
    found = light_of_balls(
        context.params.balls,
        context.read(IMAGE_SET).images,
        context.read(PHOTOS),
        model,
        [name for name, pinhole in zip(names, png_names(names), strict=True) if pinhole in held_out],
        light_from_poses,
    )
    if found.clipped:
        log.warning(
            "The balls are clipped where the light is brightest, over %.2g %% of all directions: the light is only a "
            "lower bound there. Name a ball in a photo with a shorter exposure, too, or a grey ball.",
            100 * found.clipped,
        )
    return found


def _placed_numbers(placed: Placed) -> dict[str, Any]:
    """How the light that was given lies, told to who cannot rely on it, too."""
    if not placed.told:
        log.warning(
            "The photos do not tell how the light that was given is turned about the vertical: other turns than "
            "%.0f degrees explain them as well. If you know it, say it: `--set materials.light_turn=90`.",
            placed.degrees,
        )
    return {
        "light_turn_deg": round(placed.degrees, 2),
        "light_turn_told": placed.told,
        "light_scale": float(f"{placed.scale:.4g}"),
    }


def _occlusion(path: Path, size: int) -> np.ndarray:
    """[size, size] uint8; all open where there is no such map."""
    import cv2

    if not path.exists():
        return np.full((size, size), 255, np.uint8)
    image = read_texture(path)[..., 0]
    resized: np.ndarray = cv2.resize(image, (size, size), interpolation=cv2.INTER_LINEAR)
    return resized


MATERIALS: Stage[MaterialsParams] = Stage(
    name="materials",
    version=5,
    settings=lambda config: config.materials,
    run=run,
    sources=(GIVEN_LIGHT,),
    reads=(
        PHOTOS,
        IMAGE_SET,
        MODEL,
        PINHOLE_PHOTOS,
        HELD_OUT,
        SCENE,
        WORLD_PLACE,
        AROUND_MESH,
        ATLAS_MESH,
        BASE_COLOR,
        OCCLUSION,
    ),
    writes=(MATERIAL_COLOR, ORM, KNOWN, LIGHT, LIGHT_HDR, LIGHT_HARMONICS),
    summary="texture + photos -> base colour, roughness, metalness, light",
)
