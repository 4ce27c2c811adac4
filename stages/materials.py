"""Photos, mesh and texture to what the surface is made of, and the light it was photographed in."""

from __future__ import annotations

from typing import Any

from configs.params import MaterialsParams
from stages.artifacts import (
    ATLAS_MESH,
    BASE_COLOR,
    HELD_OUT,
    KNOWN,
    LIGHT,
    LIGHT_HARMONICS,
    LIGHT_HDR,
    MATERIAL_COLOR,
    OCCLUSION,
    ORM,
    PINHOLE_PHOTOS,
    SCENE,
    WORLD_PLACE,
)
from stages.engine.stage import Stage, StageContext


def run(context: StageContext[MaterialsParams]) -> dict[str, Any]:
    if not context.params.enabled:
        return {}
    raise NotImplementedError


MATERIALS: Stage[MaterialsParams] = Stage(
    name="materials",
    version=1,
    settings=lambda config: config.materials,
    run=run,
    reads=(PINHOLE_PHOTOS, HELD_OUT, SCENE, WORLD_PLACE, ATLAS_MESH, BASE_COLOR, OCCLUSION),
    writes=(MATERIAL_COLOR, ORM, KNOWN, LIGHT, LIGHT_HDR, LIGHT_HARMONICS),
    summary="texture + photos -> base colour, roughness, metalness, light",
)
