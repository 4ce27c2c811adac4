"""A USDZ for physics simulators: the textured mesh, convex shapes to collide with, the light. Arrays in, bytes out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from stages.artifacts import AtlasMesh
from stages.files.contents import Textures, checked_mesh
from stages.files.usd import (
    ROOT,
    ROOT_LAYER,
    add_material,
    add_mesh,
    add_shape,
    describe,
    layer_bytes,
    packed,
    texture_files,
)

LIGHT_FILE = "light.exr"
# UsdLux takes the middle of an environment map for +Z; of ours (stages.light.environment) it is +X.
LIGHT_TURN = 90.0  # degrees about +Y


def simulation_bytes(
    mesh: AtlasMesh,
    textures: Textures,
    pieces: Sequence[tuple[np.ndarray, np.ndarray]],
    light_exr: bytes | None = None,
    extras: dict[str, Any] | None = None,
) -> bytes:
    """A USDZ package of what is seen (`ROOT`/mesh) and, as guides that are not, of what is hit (`ROOT`/collision).

    Scene and light lie beside `ROOT`, so that who refers to the asset gets neither. The asset stands still: it is no
    rigid body.

    Args:
        mesh: in a right-handed, Y-up frame, metres.
        textures: of the material.
        pieces: convex, vertices [V, 3] in the same frame and faces [F, 3] of each.
        light_exr: an environment map, see `stages.light.environment`, or None.
        extras: JSON-able, see `stages.files.usd.usdz_bytes`.

    Raises:
        ImportError: there is no usd-core.
        ValueError: see `checked_mesh`.
    """
    mesh = checked_mesh(mesh)
    files = texture_files(textures)
    if light_exr is not None:
        files[LIGHT_FILE] = light_exr

    def fill(stage: Any) -> None:
        from pxr import UsdPhysics

        describe(stage, extras)
        UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
        add_material(stage, add_mesh(stage, mesh), set(files))
        _add_collision(stage, pieces)
        UsdPhysics.Scene.Define(stage, "/physics_scene")  # its gravity is by default the Earth's, down
        if light_exr is not None:
            _add_light(stage)

    return packed({ROOT_LAYER: layer_bytes(fill), **files})


def _add_collision(stage: Any, pieces: Sequence[tuple[np.ndarray, np.ndarray]]) -> None:
    from pxr import UsdGeom, UsdPhysics

    group = UsdGeom.Xform.Define(stage, f"{ROOT}/collision")
    group.CreatePurposeAttr(UsdGeom.Tokens.guide)
    for k, (vertices, faces) in enumerate(pieces):
        shape = add_shape(stage, f"{ROOT}/collision/piece_{k:02d}", vertices, faces).GetPrim()
        UsdPhysics.CollisionAPI.Apply(shape)
        UsdPhysics.MeshCollisionAPI.Apply(shape).CreateApproximationAttr(UsdPhysics.Tokens.convexHull)


def _add_light(stage: Any) -> None:
    """The environment map as a dome of its own radiance."""
    from pxr import Sdf, UsdLux

    dome = UsdLux.DomeLight.Define(stage, "/light")
    dome.CreateTextureFileAttr(Sdf.AssetPath(LIGHT_FILE))
    dome.CreateTextureFormatAttr(UsdLux.Tokens.latlong)
    dome.AddRotateYOp().Set(LIGHT_TURN)
