"""The textured mesh to GLB, USDZ, OBJ + MTL + PNG, PLY and STL, back in the world frame."""

from __future__ import annotations

from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stages import artifacts
from stages.engine.manifest import MANIFEST
from stages.engine.stage import Stage, StageContext
from stages.errors import ReconstructionError, SystemRequirementError
from stages.geometry.cameras import PosedScene
from stages.geometry.orientation import y_up_rotation

if TYPE_CHECKING:
    from stages.meshing.writing import Textures


def run(context: StageContext) -> dict[str, Any]:
    """Write each format of the settings. Returns counts, extents in world units, and bytes of each file."""
    from stages.meshing.writing import glb_bytes, mtl_text, obj_text, ply_bytes, stl_bytes

    scene = artifacts.load_scene(context.inputs["undistort"])
    atlas = artifacts.load_atlas(context.inputs["atlas"])
    textures = load_textures(context.inputs["bake"])
    world = scene.world_from_scene
    vertices = world.apply(atlas.vertices.astype(np.float64))
    normals = unit_normals(atlas.vertices, atlas.normals, atlas.faces) @ world.rotation.T
    numbers: dict[str, Any] = {
        "vertices": len(vertices),
        "faces": len(atlas.faces),
        "units": "arbitrary units" if scene.place is None else scene.place.units,
        "extent": [round(float(side), 6) for side in np.ptp(vertices, axis=0)],
    }
    note = "" if scene.place is None else scene.place.describe().replace("±", "+-")
    sizes: dict[str, int] = {}
    try:
        gltf_from_world = y_up_rotation(world.rotation @ scene.up)
        extras = provenance(scene, gltf_from_world, run_id(context.inputs["bake"]))
        if "glb" in context.params.formats:
            data = glb_bytes(
                vertices @ gltf_from_world.T,
                normals @ gltf_from_world.T,
                atlas.uvs,
                atlas.faces,
                textures,
                generator=generator(),
                extras=extras,
            )
            artifacts.glb_path(context.out).write_bytes(data)
            sizes["glb"] = len(data)
        if "usdz" in context.params.formats:
            data = _usdz(vertices @ gltf_from_world.T, normals @ gltf_from_world.T, atlas, textures, extras)
            artifacts.usdz_path(context.out).write_bytes(data)
            sizes["usdz"] = len(data)
        if "obj" in context.params.formats:
            texture_path, mtl = artifacts.obj_texture_path(context.out), artifacts.mtl_path(context.out)
            texture_path.write_bytes(textures.base_color)
            normal_map_name = None
            if textures.normal is not None:
                normal_map_path = artifacts.obj_normal_map_path(context.out)
                normal_map_path.write_bytes(textures.normal)
                normal_map_name = normal_map_path.name
            mtl.write_text(mtl_text(texture_path.name, normal_map_name), encoding="utf-8")
            text = obj_text(vertices, normals, atlas.uvs, atlas.faces, mtl.name, note)
            artifacts.obj_path(context.out).write_text(text, encoding="utf-8")
            sizes["obj"] = len(text)
        if "ply" in context.params.formats:
            colors = vertex_colors(textures.base_color, atlas.uvs)
            data = ply_bytes(vertices, normals, colors, atlas.faces, note)
            artifacts.ply_path(context.out).write_bytes(data)
            sizes["ply"] = len(data)
        if "stl" in context.params.formats:
            data = stl_bytes(vertices, atlas.faces, note)
            artifacts.stl_path(context.out).write_bytes(data)
            sizes["stl"] = len(data)
    except ValueError as error:
        raise ReconstructionError(
            f"The mesh cannot be exported: {error}.", "Rebuild it: `hineus run PHOTOS --from cleanup`."
        ) from error
    return {**numbers, "bytes": sizes}


def _usdz(
    vertices: np.ndarray,
    normals: np.ndarray,
    atlas: artifacts.AtlasMesh,
    textures: Textures,
    extras: dict[str, Any],
) -> bytes:
    """The USDZ package; lengths without a known unit are taken for metres, as glTF does with all."""
    from stages.meshing.usd import usdz_bytes

    try:
        return usdz_bytes(vertices, normals, atlas.uvs, atlas.faces, textures, meters_per_unit=1.0, extras=extras)
    except ImportError as error:
        raise SystemRequirementError(
            f"USDZ files are written with usd-core, which cannot be imported: {error}.",
            "Try `pip install usd-core`, or take usdz out of `export.formats`.",
        ) from error


def load_textures(baked: Path) -> Textures:
    """The images that the bake stage left."""
    from stages.meshing.writing import Textures

    optional = (artifacts.normal_map_path(baked), artifacts.occlusion_path(baked))
    normal, occlusion = (path.read_bytes() if path.exists() else None for path in optional)
    return Textures(artifacts.base_color_path(baked).read_bytes(), normal, occlusion)


def unit_normals(vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Vertex normals [V, 3] float64 of length 1: those without a length take an adjoining face's, else +Z."""
    unit = normals.astype(np.float64)
    lengths = np.linalg.norm(unit, axis=1)
    bad = ~np.isfinite(lengths) | (lengths < 1e-6)
    if bad.any():
        corners = vertices[faces].astype(np.float64)
        flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        usable = np.linalg.norm(flat, axis=1) > 0
        unit[bad] = (0, 0, 1)
        for k in range(3):
            takes = usable & bad[faces[:, k]]
            unit[faces[takes, k]] = flat[takes]
        lengths = np.linalg.norm(unit, axis=1)
    return unit / lengths[:, None]


def vertex_colors(texture_png: bytes, uvs: np.ndarray) -> np.ndarray:
    """The texture's colours [V, 3] (0..255) at UVs [V, 2]."""
    import cv2

    from stages.meshing.rendering import sample_texture

    texture = cv2.imdecode(np.frombuffer(texture_png, np.uint8), cv2.IMREAD_COLOR)
    if texture is None:
        raise ValueError("expected a readable texture")
    return sample_texture(cv2.cvtColor(texture, cv2.COLOR_BGR2RGB), uvs)


def generator() -> str:
    """Name and version of this program."""
    try:
        return f"hineus {version('hineus')}"
    except PackageNotFoundError:  # run from a checkout that was never installed
        return "hineus"


def run_id(baked: Path) -> str | None:
    """What tells this asset from others: the fingerprint of its textures, and so of photos, settings and versions."""
    return artifacts.read_json(baked / MANIFEST)["fingerprint"] if (baked / MANIFEST).exists() else None


def provenance(scene: PosedScene, gltf_from_world: np.ndarray, run: str | None) -> dict[str, Any]:
    """What an asset says of its origin: run, photos, units, place on Earth, and the way back to the other frames."""
    extras: dict[str, Any] = {} if run is None else {"run": run}
    extras |= {
        "photos": len(scene.cameras),
        "units": "arbitrary units" if scene.place is None else scene.place.units,
        "gltf_from_world_rotation": gltf_from_world.tolist(),
        "world_from_scene": scene.world_from_scene.matrix().tolist(),
    }
    if scene.place is None:
        return extras
    extras["world_from_model"] = scene.place.world_from_model.matrix().tolist()
    if scene.place.metric:
        extras |= {"scale_from": scene.place.scale_from, "scale_relative_error": scene.place.scale_error}
    if scene.place.origin is not None:
        keys = ("latitude_deg", "longitude_deg", "altitude_m")
        extras["world_origin"] = dict(zip(keys, scene.place.origin, strict=True))
        extras["gps_residual_m"] = scene.place.gps_residual
    return extras


EXPORT = Stage(
    name="export",
    version=4,
    needs=("undistort", "atlas", "bake"),
    params="export",
    run=run,
    summary="textured mesh -> GLB, USDZ, OBJ, PLY, STL",
)
