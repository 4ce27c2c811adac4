"""Neural field to a closed mesh: marching cubes at the resolution the photos support, then what dense points show.

Of a block of a large scene it is a tile, open where its neighbours go on (docs/adr/0022).
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from configs.params import ExtractParams
from stages.artifacts import AROUND_MESH, FIELD, POINT_CLOUD, RAW_MESH, SCENE
from stages.artifacts.blocks import NEIGHBOURS, learned_by, read_tile
from stages.engine.stage import Stage, StageContext
from stages.errors import ReconstructionError
from stages.geometry.cameras import PinholeCameras, PosedScene
from stages.geometry.place import box_sides
from stages.geometry.similarity import Similarity
from stages.geometry.tiling import UPRIGHT

if TYPE_CHECKING:
    from stages.neural.trained_field import TrainedField

log = logging.getLogger(__name__)

# However small the photos, a coarser grid than this loses the object's shape.
MIN_RESOLUTION = 64


def supported_resolution(cameras: PinholeCameras) -> int:
    """Cells along the region of interest (side 2) so that a cell is one pixel of the closest tenth of the photos."""
    distance = np.maximum(np.linalg.norm(cameras.centers, axis=1), 1.0)
    pixels_per_unit = cameras.intrinsics[:, 0, 0] / distance
    return int(np.ceil(2 * np.quantile(pixels_per_unit, 0.9)))


def run(context: StageContext[ExtractParams]) -> dict[str, Any]:
    from stages.neural.trained_field import load_field
    from stages.surface.denoising import denoised
    from stages.surface.fitting import fit_to_points

    field = load_field(context.read(FIELD), context.device)
    scene = context.read(SCENE)
    found = _tile(context, field, scene) if NEIGHBOURS in context.sources else _solid(context, field, scene)
    start, faces, used = found.vertices, found.faces, 0
    vertices = start
    if context.params.fit:
        cloud = context.read(POINT_CLOUD).within(scene.poses_from_scene)
        fit = fit_to_points(vertices, faces, cloud, found.cell)
        vertices, used = fit.vertices, fit.used
    vertices = denoised(vertices, faces, context.params.denoising)
    if found.sides:
        from stages.surface.tiles import fading, surface_around

        vertices = start + fading(start, found.sides, found.cell)[:, None].astype(np.float32) * (vertices - start)
        around = surface_around(field.sdf, found.sides)
        context.write(AROUND_MESH, around if len(around[1]) else None)
    context.write(RAW_MESH, (vertices, faces))
    return {
        **found.numbers,
        "vertices": len(vertices),
        "faces": len(faces),
        "evaluated_points": found.evaluated,
        "points_fitted": used,
    }


class _Found(NamedTuple):
    """A surface in the scene frame.

    Attributes:
        vertices: [V, 3] float32. faces: [F, 3].
        cell: side of a cell of the grid.
        sides: of the tile that it is, see `surface.tiles`; none where it is the whole.
        numbers: for the summary.
    """

    vertices: np.ndarray
    faces: np.ndarray
    cell: float
    sides: list[tuple[np.ndarray, float]]
    evaluated: int
    numbers: dict[str, Any]


def _solid(context: StageContext[ExtractParams], field: TrainedField, scene: PosedScene) -> _Found:
    """All that the region of interest holds, closed."""
    from stages.surface.solids import extract_solid

    supported = max(supported_resolution(scene.cameras), MIN_RESOLUTION)
    resolution = min(context.params.resolution, supported)
    surface = extract_solid(
        field.sdf,
        resolution,
        block=context.params.block,
        progress=partial(context.progress, note=f"marching cubes at {resolution}^3"),
    )
    if len(surface.faces) == 0:
        centre = float(field.sdf(np.zeros((1, 3), dtype=np.float32))[0])
        raise ReconstructionError(
            f"The field has no surface inside the region of interest: 0 faces at {resolution}^3 "
            f"(distance at the centre {centre:+.3f}).",
            "Training ended too early or the region is wrong: try `--set train.steps=20000`, or "
            "`--set undistort.roi_scale=1.5`.",
        )
    numbers = {"resolution": resolution, "supported_resolution": supported}
    return _Found(surface.vertices, surface.faces, 2 / resolution, [], surface.evaluated, numbers)


# ---------------------------------------------------------------- one block of a large scene
def _tile(context: StageContext[ExtractParams], field: TrainedField, scene: PosedScene) -> _Found:
    """What the block's core holds: its field, blended with those of the blocks around it."""
    from stages.neural.trained_field import load_field
    from stages.surface.tiles import BlockField, extract_tile

    folder = context.sources[NEIGHBOURS]
    tile = read_tile(folder)
    fields, missing = [], []
    for name in sorted(tile.boxes):
        learned = learned_by(folder, name)
        if name == tile.name:
            fields.append(BlockField(tile.box, _in_plan(field, scene.poses_from_scene)))
        elif learned is not None:
            frame = SCENE.load(learned).poses_from_scene
            fields.append(
                BlockField(tile.boxes[name].box(), _in_plan(load_field(FIELD.load(learned), context.device), frame))
            )
        else:
            missing.append(name)
    if missing:
        log.warning(
            "%s of the blocks around this one have learned nothing yet (%s): there will be seams to them. Once they "
            "have, run this block again", len(missing), ", ".join(missing),
        )  # fmt: skip
    core, cell = tile.box.core, tile.cell
    note = "marching cubes, " + " x ".join(str(round(side / cell)) for side in core[1] - core[0])
    surface = extract_tile(
        fields, core, cell, context.params.block, progress=lambda done, total: context.progress(done, total, note)
    )
    if len(surface.faces) == 0:
        raise ReconstructionError(
            f"The fields have no surface in the core of block {tile.name}: 0 faces in cells of {cell:.3g}.",
            "Training ended too early: try `--set train.steps=20000`. Where there is nothing in this block, leave it.",
        )
    plan_from_scene = scene.poses_from_scene
    return _Found(
        vertices=plan_from_scene.inverse().apply(surface.vertices).astype(np.float32),
        faces=surface.faces,
        cell=cell / plan_from_scene.scale,
        sides=box_sides(core, plan_from_scene, UPRIGHT),
        evaluated=surface.evaluated,
        numbers={"blended": len(fields), **({"missing": ", ".join(missing)} if missing else {}), "cell": cell},
    )


def _in_plan(field: TrainedField, plan_from_scene: Similarity) -> Callable[[np.ndarray], np.ndarray]:
    """A field's signed distance in the plan's frame and unit."""
    scene_from_plan = plan_from_scene.inverse()
    return lambda places: plan_from_scene.scale * field.sdf(scene_from_plan.apply(places))


EXTRACT: Stage[ExtractParams] = Stage(
    name="extract",
    version=6,
    settings=lambda config: config.extract,
    run=run,
    reads=(SCENE, FIELD, POINT_CLOUD),
    writes=(RAW_MESH, AROUND_MESH),
    sources=(NEIGHBOURS,),
    summary="field to mesh, fitted to the dense points",
)
