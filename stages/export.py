"""The textured mesh to GLB, 3D Tiles, USDZ, OBJ + MTL + PNG, PLY and STL, and seen from above to GeoTIFF; dense points
to PLY and LAZ, Gaussian splats to PLY, SPZ and GLB; all in the world frame or on a map."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from configs.params import ExportParams
from stages import artifacts
from stages.artifacts import (
    ASSET,
    ATLAS_MESH,
    BASE_COLOR,
    GIVEN_REGION,
    LIGHT,
    LIGHT_HARMONICS,
    LIGHT_HDR,
    MATERIAL_COLOR,
    NORMAL_MAP,
    OCCLUSION,
    ORM,
    POINT_CLOUD,
    PROVENANCE,
    SCENE,
    SPLATS,
    WORLD_PLACE,
    read_texture,
    texture_bytes,
)
from stages.engine.stage import Stage, StageContext
from stages.engine.system import installed_version
from stages.errors import ConfigError, ReconstructionError, SystemRequirementError
from stages.geometry.cameras import PosedScene
from stages.geometry.place import GivenRegion, Place
from stages.geometry.point_cloud import PointCloud
from stages.geometry.similarity import Similarity
from stages.geometry.up import y_up_rotation
from stages.surface.placing import placed, turned

if TYPE_CHECKING:
    from stages.drawing.from_above import GroundGrid
    from stages.files.contents import Textures


log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Asset:
    """What all files are written from.

    Attributes:
        mesh: in the scene frame.
        world_from_scene: similarity.
        gltf_from_world: rotation [3, 3] to Y up.
        textures: of the one material.
        light: the files of the light that the photos were taken in, by their kind (exr, hdr, json); none where it was
            not learned.
        extras: what the file says of its origin.
        note: the same in a line of ASCII.
        out: the folder for files.
    """

    mesh: artifacts.AtlasMesh
    world_from_scene: Similarity
    gltf_from_world: np.ndarray
    textures: Textures
    light: dict[str, bytes]
    extras: dict[str, Any]
    note: str
    out: Path

    def in_world(self, mesh: artifacts.AtlasMesh) -> artifacts.AtlasMesh:
        """A mesh of the scene frame in the world, its vertices and normals as float64 and the normals unit."""
        return placed(mesh, self.world_from_scene)

    def in_gltf(self, mesh: artifacts.AtlasMesh) -> artifacts.AtlasMesh:
        """The same with Y up."""
        return turned(self.in_world(mesh), self.gltf_from_world)


def run(context: StageContext[ExportParams]) -> dict[str, Any]:
    """Write what the settings ask for, and where on Earth it lies. Returns counts, extents, and bytes of each file."""
    params = context.params
    scene, place = context.read(SCENE), context.read(WORLD_PLACE)
    world_from_scene = scene.world_from_scene(place)
    gltf_from_world = y_up_rotation(world_from_scene.rotation @ scene.up_in(place))
    textures = load_textures(context)
    textured = context.manifests.get("bake" if textures.orm is None else "materials")
    asset = Asset(
        mesh=context.read(ATLAS_MESH),
        world_from_scene=world_from_scene,
        gltf_from_world=gltf_from_world,
        textures=textures,
        light=load_light(context),
        # The fingerprint of its textures, and so of photos, settings and versions, tells this asset from others.
        extras=provenance(scene, place, gltf_from_world, textured.identity.fingerprint if textured else None),
        note=place.describe().replace("±", "+-"),
        out=context.out,
    )
    numbers: dict[str, Any] = {
        "vertices": len(asset.mesh.vertices),
        "faces": len(asset.mesh.faces),
        "units": place.units,
    }
    writers = {"glb": _write_glb, "usdz": _write_usdz, "obj": _write_obj, "ply": _write_ply, "stl": _write_stl}
    warnings = [_no_metres()] if params.simulation == "usd" and not place.metric else []
    # of a map only the tiles ask for it, and it takes pyproj
    geoid = _geoid(place, params.heights) if place.origin is not None or params.tiles else None
    warnings += [_no_geoid()] if geoid is None and params.tiles and (place.origin or place.crs) else []
    _write_georeference(asset, place, geoid)
    try:
        extent = np.ptp(asset.in_world(asset.mesh).vertices, axis=0)
        numbers["extent"] = [round(float(side), 6) for side in extent]
        formats = {*params.formats, *(("glb",) if params.tiles else ())}
        sizes: dict[str, int] = {name: write(asset) for name, write in writers.items() if name in formats}
        levels = []
        for level, (light, size) in enumerate(_write_levels(asset, params.lods), 1):
            levels.append(light)
            numbers.setdefault("lod_faces", []).append(len(light.faces))
            sizes[f"lod{level}"] = size
        if params.tiles:
            errors, sizes["tiles"] = _write_tileset(asset, levels, place, geoid or 0.0)
            numbers["tile_errors"] = [round(error, 6) for error in errors]
        if params.collision == "hulls" or params.simulation == "usd":
            pieces = _convex_pieces(asset, params.collision_pieces)
            numbers["collision_pieces"] = len(pieces)
        if params.collision == "hulls":
            sizes["collision"] = _write_collision(asset, pieces)
        if params.simulation == "usd":
            sizes["simulation"] = _write_simulation(asset, pieces)
        for kind, data in asset.light.items():
            sizes[f"light_{kind}"] = artifacts.light_path(asset.out, kind).write_bytes(data)
    except ValueError as error:
        raise ReconstructionError(
            f"The mesh cannot be exported: {error}.", "Rebuild it: `hineus run PHOTOS --from cleanup`."
        ) from error
    if params.splats and (file := context.read(SPLATS)).exists():
        about_splats, of_splats = _write_splats(asset, file, params)
        numbers |= about_splats
        sizes |= of_splats
    if "points" in params.formats:
        about_points, of_points = _write_points(context, asset, place)
        warnings += about_points.pop("warnings", [])
        numbers |= about_points
        sizes |= of_points
    if "orthophoto" in params.formats:
        about_ground, of_ground = _write_from_above(context, asset, place)
        numbers |= about_ground
        sizes |= of_ground
    return {**numbers, **({"warnings": warnings} if warnings else {}), "bytes": sizes}


def _write_glb(asset: Asset) -> int:
    return artifacts.asset_path(asset.out, "glb").write_bytes(_textured_glb(asset, asset.mesh, asset.extras))


def _textured_glb(asset: Asset, mesh: artifacts.AtlasMesh, extras: dict[str, Any]) -> bytes:
    from stages.files.glb import glb_bytes

    return glb_bytes(asset.in_gltf(mesh), asset.textures, generator=generator(), extras=extras)


def _write_levels(asset: Asset, count: int) -> Iterator[tuple[artifacts.AtlasMesh, int]]:
    """Mesh and bytes of each level of detail."""
    from stages.surface.levels_of_detail import levels_of_detail

    for level, light in enumerate(levels_of_detail(asset.mesh, count) if count else (), 1):
        data = _textured_glb(asset, light, {**asset.extras, "level_of_detail": level})
        yield light, artifacts.lod_path(asset.out, level).write_bytes(data)


def _write_tileset(
    asset: Asset, levels: list[artifacts.AtlasMesh], place: Place, geoid: float
) -> tuple[list[float], int]:
    """Geometric error of each level but the finest, and bytes of the tileset."""
    from stages.files.tiles_3d import TILE_FROM_GLTF, Level, tileset
    from stages.posing.map_coordinates import earth_centred_from_world
    from stages.surface.levels_of_detail import deviation

    tile_from_world = TILE_FROM_GLTF @ asset.gltf_from_world
    errors = [0.0, *(asset.world_from_scene.scale * deviation(light, asset.mesh) for light in levels)]
    paths = [
        artifacts.asset_path(asset.out, "glb"),
        *(artifacts.lod_path(asset.out, k + 1) for k in range(len(levels))),
    ]
    tiles = []
    for path, mesh, error in zip(paths, [asset.mesh, *levels], errors, strict=True):
        corners = (asset.in_world(mesh).vertices @ tile_from_world.T).astype(np.float32).astype(np.float64)
        tiles.append(Level(path.name, np.stack([corners.min(0), corners.max(0)]), error))
    matrix = earth_centred_from_world(place, asset.in_world(asset.mesh).vertices.mean(0), geoid)
    if matrix is not None:
        matrix[:3, :3] = matrix[:3, :3] @ tile_from_world.T
    path = asset.out / artifacts.TILESET
    artifacts.write_json(path, tileset(tiles, matrix, {"generator": generator(), "units": place.units}))
    return errors[1:], path.stat().st_size


def _convex_pieces(asset: Asset, count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Vertices in the frame of the GLB and faces of each collision shape."""
    from stages.surface.collision import convex_pieces

    try:
        pieces = convex_pieces(asset.mesh.vertices, asset.mesh.faces, count)
    except ImportError as error:
        raise SystemRequirementError(
            f"Convex pieces are found by coacd, which cannot be imported: {error}.",
            "Try `pip install coacd`, or `--set export.collision=off --set export.simulation=off`.",
        ) from error
    return [(asset.world_from_scene.apply(corners) @ asset.gltf_from_world.T, faces) for corners, faces in pieces]


def _write_collision(asset: Asset, pieces: list[tuple[np.ndarray, np.ndarray]]) -> int:
    from stages.files.glb import shapes_glb_bytes

    # the name by which Unreal knows a convex collision shape of the mesh "model"
    shapes = {f"UCX_model_{k:02d}": piece for k, piece in enumerate(pieces)}
    return artifacts.collision_path(asset.out).write_bytes(shapes_glb_bytes(shapes, generator(), asset.extras))


def _write_simulation(asset: Asset, pieces: list[tuple[np.ndarray, np.ndarray]]) -> int:
    from stages.files.simulation import simulation_bytes

    try:
        light = asset.light.get("exr")
        data = simulation_bytes(asset.in_gltf(asset.mesh), asset.textures, pieces, light, asset.extras)
    except ImportError as error:
        raise SystemRequirementError(
            f"The file for simulators is written with usd-core, which cannot be imported: {error}.",
            "Try `pip install usd-core`, or `--set export.simulation=off`.",
        ) from error
    return artifacts.simulation_path(asset.out).write_bytes(data)


def _no_metres() -> dict[str, str]:
    """For the report: that things may fall too fast or too slowly."""
    sentence = (
        "Simulators read the lengths in model_simulation.usdz as metres, but the true size is not known: one known "
        "distance, markers or GPS give it."
    )
    log.warning("%s", sentence)
    command = "hineus run --workspace WORKSPACE --set 'place.known_distance=X1 Y1 Z1 X2 Y2 Z2 METRES'"
    return {"sentence": sentence, "command": command}


def _write_usdz(asset: Asset) -> int:
    """Lengths without a known unit are taken for metres, as glTF does with all."""
    from stages.files.usd import usdz_bytes

    try:
        data = usdz_bytes(asset.in_gltf(asset.mesh), asset.textures, asset.extras)
    except ImportError as error:
        raise SystemRequirementError(
            f"USDZ files are written with usd-core, which cannot be imported: {error}.",
            "Try `pip install usd-core`, or take usdz out of `export.formats`.",
        ) from error
    return artifacts.asset_path(asset.out, "usdz").write_bytes(data)


def _write_obj(asset: Asset) -> int:
    """The OBJ, its material and its images. Returns the bytes of the OBJ."""
    from stages.files.obj import mtl_text, obj_text, roughness_and_metalness

    texture_path, mtl = artifacts.asset_path(asset.out, "png"), artifacts.asset_path(asset.out, "mtl")
    texture_path.write_bytes(asset.textures.base_color)
    maps = {} if asset.textures.normal is None else {"normal": asset.textures.normal}
    if asset.textures.orm is not None:
        maps["roughness"], maps["metallic"] = roughness_and_metalness(asset.textures.orm)
    paths = {kind: artifacts.obj_map_path(asset.out, kind) for kind in maps}
    for kind, png in maps.items():
        paths[kind].write_bytes(png)
    mtl.write_text(mtl_text(texture_path.name, {kind: path.name for kind, path in paths.items()}), encoding="utf-8")
    text = obj_text(asset.in_world(asset.mesh), mtl.name, asset.note)
    return artifacts.asset_path(asset.out, "obj").write_text(text, encoding="utf-8")


def _write_ply(asset: Asset) -> int:
    from stages.files.ply_stl import ply_bytes

    mesh = asset.in_world(asset.mesh)
    colors = vertex_colors(asset.textures.base_color, mesh.uvs)
    data = ply_bytes(mesh.vertices, mesh.normals, colors, mesh.faces, asset.note)
    return artifacts.asset_path(asset.out, "ply").write_bytes(data)


def _write_stl(asset: Asset) -> int:
    from stages.files.ply_stl import stl_bytes

    mesh = asset.in_world(asset.mesh)
    return artifacts.asset_path(asset.out, "stl").write_bytes(stl_bytes(mesh.vertices, mesh.faces, asset.note))


def _write_splats(asset: Asset, file: Path, params: ExportParams) -> tuple[dict[str, Any], dict[str, int]]:
    """Numbers of the Gaussian splats, and bytes of each file: the PLY in the frame of the OBJ, others in the GLB's."""
    from stages.files.splat_files import splat_glb_bytes, splat_ply_bytes, spz_bytes
    from stages.gaussians.keeping import read_gaussians
    from stages.gaussians.levels_of_detail import levels_of_detail
    from stages.gaussians.transforming import transformed

    gltf_from_scene = Similarity(1.0, asset.gltf_from_world, np.zeros(3)).compose(asset.world_from_scene)
    writers = {
        "ply": lambda some: splat_ply_bytes(transformed(some, asset.world_from_scene), asset.note),
        "spz": lambda some: spz_bytes(transformed(some, gltf_from_scene)),
        "glb": lambda some: splat_glb_bytes(transformed(some, gltf_from_scene), generator(), asset.extras),
    }
    counts, sizes = [], {}
    try:
        gaussians = read_gaussians(file)
        for level, some in enumerate((gaussians, *levels_of_detail(gaussians, params.splat_lods))):
            counts.append(len(some))
            for kind in params.splats:
                name = f"splats_{kind}" if level == 0 else f"splats_lod{level}_{kind}"
                sizes[name] = artifacts.splats_path(asset.out, kind, level).write_bytes(writers[kind](some))
    except (ValueError, KeyError) as error:
        raise ReconstructionError(
            f"The splats cannot be exported: {error}.", "Make them again: `hineus run PHOTOS --from splats`."
        ) from error
    return {"splats": counts[0], **({"splat_lods": counts[1:]} if counts[1:] else {})}, sizes


def _write_points(
    context: StageContext[ExportParams], asset: Asset, place: Place
) -> tuple[dict[str, Any], dict[str, int]]:
    """Numbers of the dense points, and bytes of each of their files; none where there are no points."""
    from stages.files.points import laz_bytes, points_ply_bytes
    from stages.posing.map_coordinates import cloud_on_map

    found, region, params = context.read(POINT_CLOUD), context.read(GIVEN_REGION), context.params
    chosen = found.chosen(asked_for(found, region, context.read(SCENE).poses_from_scene, params))
    if not len(chosen):
        return {"points": 0, "warnings": [_no_points(len(found))]}, {}
    # in float64: poses that were given may be far from their origin, the world's is near
    world = replace(
        chosen,
        points=place.world_from_poses.apply(chosen.points.astype(np.float64)),
        normals=chosen.normals @ place.world_from_poses.rotation.T,
    )
    warnings = []
    try:
        on_map, offset, crs = cloud_on_map(place, world)
    except SystemRequirementError as error:
        on_map, offset, crs = world, (0.0, 0.0, 0.0), ""
        warnings.append(_not_on_map(error))
    try:
        laz, far = laz_bytes(on_map, offset, crs, generator())
    except ImportError as error:
        raise SystemRequirementError(
            f"Dense points are written as LAZ with laspy, lazrs and, on a map, pyproj: {error}.",
            "Try `pip install laspy lazrs pyproj`, or take points out of `export.formats`.",
        ) from error
    files = {"ply": points_ply_bytes(world, asset.note), "laz": laz}
    sizes = {f"points_{kind}": artifacts.points_path(asset.out, kind).write_bytes(files[kind]) for kind in files}
    if far:
        warnings.append(_too_far(far))
    about = {"points": len(chosen), **({"points_crs": crs} if crs else {})}
    return {**about, **({"warnings": warnings} if warnings else {})}, sizes


def _not_on_map(error: SystemRequirementError) -> dict[str, str]:
    """For the report and the log: that points.laz has no coordinates of a map, though they are known."""
    sentence = f"points.laz is in metres about the origin, as points.ply, and names no map. {error} {error.hint}"
    log.warning("%s", sentence)
    return {"sentence": sentence}


def _too_far(count: int) -> dict[str, str]:
    """For the report and the log: that points.laz lacks so many points."""
    sentence = (
        f"points.laz lacks the {count:,} dense points that lie thousands of times as far out as the others: they are "
        "wrong, and its whole numbers would be coarse for all. points.ply has them."
    )
    log.warning("%s", sentence)
    return {"sentence": sentence}


def asked_for(
    cloud: PointCloud, region: GivenRegion | None, poses_from_scene: Similarity, params: ExportParams
) -> np.ndarray:
    """Which dense points the settings ask for [N] bool, cloud and `region` in the frame of the poses."""
    rows = np.asarray(cloud.trust >= params.points_trust)
    if params.points_from == "region" and region is not None:
        rows &= region.holds(cloud.points)
    elif params.points_from == "region":
        rows &= np.linalg.norm(poses_from_scene.inverse().apply(cloud.points), axis=1) < 1
    return rows


def _no_points(found: int) -> dict[str, str]:
    """For the report and the log: that no dense points are exported, of so many that were found."""
    if not found:
        sentence = (
            "There are no dense points to export: no photos overlap enough, what they show is plain or shiny, or "
            "`densify.method` is off."
        )
        log.warning("%s", sentence)
        return {"sentence": sentence}
    settings = "--set export.points_trust=0 --set export.points_from=everywhere"
    return {
        "sentence": f"No dense points are exported: of {found:,} none is trusted enough and in the region of interest.",
        "command": f"hineus run --workspace WORKSPACE {settings}",
    }


# ---------------------------------------------------------------- from above
def _write_from_above(
    context: StageContext[ExportParams], asset: Asset, place: Place
) -> tuple[dict[str, Any], dict[str, int]]:
    """Ground resolution and coordinate system of the orthophoto and the surface model, and their bytes."""
    from stages.drawing.from_above import seen_from_above
    from stages.files.geotiff import LOCAL_METRES, heights_bytes, orthophoto_bytes
    from stages.texture.baking import Provenance

    mesh, crs = _mesh_on_map(asset, place)
    grid = _ground_grid(context, asset, mesh)
    known = read_texture(context.read(PROVENANCE))[..., 0] != Provenance.FIELD
    picture, heights = seen_from_above(mesh, read_texture(context.read(BASE_COLOR)), known, grid)
    where = (grid.west, grid.north, grid.resolution, crs or (LOCAL_METRES if place.metric else ""))
    note = f"A pixel is {grid.resolution:.6g} {place.units} wide. {asset.note}"
    try:
        files = {
            artifacts.ORTHOPHOTO: orthophoto_bytes(picture, *where, note),
            artifacts.SURFACE_MODEL: heights_bytes(heights, *where, note, "metre" if place.metric else "unknown"),
        }
    except ImportError as error:
        raise SystemRequirementError(
            f"Orthophotos are written by rasterio, which cannot be imported: {error}.",
            "Try `pip install 'hineus[survey]'`, or take orthophoto out of `export.formats`.",
        ) from error
    sizes = {Path(name).stem: (asset.out / name).write_bytes(data) for name, data in files.items()}
    about = {"ground_resolution": grid.resolution, "ground_pixels": [grid.width, grid.height]}
    return {**about, **({"ground_crs": crs} if crs else {})}, sizes


def _mesh_on_map(asset: Asset, place: Place) -> tuple[artifacts.AtlasMesh, str]:
    """The mesh in coordinates of a map or of the control points, else as the GLB with z up; the system's name or ""."""
    from stages.files.tiles_3d import TILE_FROM_GLTF
    from stages.posing.map_coordinates import map_of, on_map

    if place.origin is None and place.offset is None:
        return turned(asset.in_gltf(asset.mesh), TILE_FROM_GLTF), ""
    world = asset.in_world(asset.mesh)
    return replace(world, vertices=on_map(place, world.vertices)), map_of(place)


def _ground_grid(context: StageContext[ExportParams], asset: Asset, mesh: artifacts.AtlasMesh) -> GroundGrid:
    """The pixels that hold the mesh, as wide as the settings or the photos say.

    Raises:
        ConfigError: there are too many.
        ReconstructionError: no photo shows the mesh from above.
    """
    from stages.drawing.from_above import MOST_PIXELS, finest_resolution, ground_grid, two_digits
    from stages.surface.triangle_mesh import face_normals
    from stages.texture.footprint import ground_sampling, pixels_per_area

    places, asked = mesh.vertices[:, :2], context.params.ground_resolution
    if asked is None:
        own = asset.mesh
        density, _ = pixels_per_area(own.vertices, own.faces, context.read(SCENE).cameras)
        from_above = np.maximum(face_normals(mesh.vertices, mesh.faces)[:, 2], 0)
        sampling = asset.world_from_scene.scale * ground_sampling(density, from_above)
        if sampling == 0:
            raise ReconstructionError(
                "No photo shows the model from above, so that there is no orthophoto.",
                "Take orthophoto out of `export.formats`, or name a resolution: `--set export.ground_resolution=0.05`.",
            )
        asked = two_digits(max(sampling, finest_resolution(places)))
    elif asked < finest_resolution(places):
        raise ConfigError(
            f"At `export.ground_resolution` = {asked:g} the orthophoto has more than {MOST_PIXELS / 1e6:.0f} million "
            "pixels.",
            f"Try `--set export.ground_resolution={two_digits(finest_resolution(places)):g}`, or a smaller region.",
        )
    return ground_grid(places, asked)


def _geoid(place: Place, heights: str) -> float | None:
    """Metres above the ellipsoid of what altitudes count from; None where that is not known."""
    from stages.posing.geoid import geoid_height
    from stages.posing.map_coordinates import latitude_and_longitude

    if heights == "ellipsoid":
        return 0.0
    where = latitude_and_longitude(place)
    return None if where is None else geoid_height(*where)


def _no_geoid() -> dict[str, str]:
    """For the report: that tiles may stand too high or low on the Earth."""
    sentence = (
        "Altitudes count from the sea, globes count from the ellipsoid, and the distance between them, up to 100 "
        "metres, comes with `pip install 'hineus[survey]'`: without it the tiles stand too high or too low."
    )
    log.warning("%s", sentence)
    return {"sentence": sentence, "command": "hineus export --workspace WORKSPACE"}


def _write_georeference(asset: Asset, place: Place, geoid: float | None) -> None:
    """Where on Earth, or in the control points' frame, the files lie; nothing where that is not known."""
    from stages.files.georeference import georeference, metadata_xml

    if found := georeference(place, asset.gltf_from_world, geoid):
        artifacts.write_json(asset.out / artifacts.GEOREFERENCE, found)
    if text := metadata_xml(place, geoid):
        (asset.out / artifacts.METADATA).write_text(text, encoding="utf-8")


def load_textures(context: StageContext[ExportParams]) -> Textures:
    """The images of the material that was learned, else of the photos' colours as they are."""
    from stages.files.contents import Textures

    optional = (NORMAL_MAP, OCCLUSION, MATERIAL_COLOR, ORM)
    normal, occlusion, color, orm = (
        texture_bytes(path) if (path := context.read(artifact)).exists() else None for artifact in optional
    )
    if color is None or orm is None:
        return Textures(texture_bytes(context.read(BASE_COLOR)), normal, occlusion)
    return Textures(color, normal, orm=orm)


def load_light(context: StageContext[ExportParams]) -> dict[str, bytes]:
    """The files of the light by their kind; none where it was not learned."""
    kinds = {"exr": LIGHT, "hdr": LIGHT_HDR, "json": LIGHT_HARMONICS}
    files = {kind: _bytes_where_made(context.read(artifact)) for kind, artifact in kinds.items()}
    return {kind: data for kind, data in files.items() if data is not None}


def _bytes_where_made(path: Path) -> bytes | None:
    return path.read_bytes() if path.exists() else None


def vertex_colors(texture_png: bytes, uvs: np.ndarray) -> np.ndarray:
    """The texture's colours [V, 3] (0..255) at UVs [V, 2]."""
    import cv2

    from stages.drawing.rendering import sample_texture

    texture = cv2.imdecode(np.frombuffer(texture_png, np.uint8), cv2.IMREAD_COLOR)
    if texture is None:
        raise ValueError("expected a readable texture")
    return sample_texture(cv2.cvtColor(texture, cv2.COLOR_BGR2RGB), uvs)


def generator() -> str:
    """Name and, where it is installed, version of this program."""
    return f"hineus {installed_version('hineus') or ''}".rstrip()


def provenance(scene: PosedScene, place: Place, gltf_from_world: np.ndarray, run: str | None) -> dict[str, Any]:
    """What an asset says of its origin: run, photos, units, place on Earth, and the way back to the other frames."""
    extras: dict[str, Any] = {} if run is None else {"run": run}
    extras |= {
        "photos": len(scene.cameras),
        "units": place.units,
        "gltf_from_world_rotation": gltf_from_world.tolist(),
        "world_from_scene": scene.world_from_scene(place).matrix().tolist(),
        "world_from_model": place.world_from_poses.matrix().tolist(),
    }
    if place.metric:
        extras |= {"scale_from": place.scale_from, "scale_relative_error": place.scale_error}
    if place.origin is not None:
        keys = ("latitude_deg", "longitude_deg", "altitude_m")
        extras["world_origin"] = dict(zip(keys, place.origin, strict=True))
        extras["gps_residual_m"] = place.gps_residual
    if place.offset is not None:
        extras |= {"world_crs": place.crs or None, "world_offset": place.offset}
    if place.control:
        extras["control_residual_m"] = place.control_residual
    return extras


EXPORT: Stage[ExportParams] = Stage(
    name="export",
    version=12,
    settings=lambda config: config.export,
    run=run,
    reads=(
        SCENE,
        WORLD_PLACE,
        GIVEN_REGION,
        POINT_CLOUD,
        ATLAS_MESH,
        BASE_COLOR,
        PROVENANCE,
        NORMAL_MAP,
        OCCLUSION,
        MATERIAL_COLOR,
        ORM,
        LIGHT,
        LIGHT_HDR,
        LIGHT_HARMONICS,
        SPLATS,
    ),
    writes=(ASSET,),
    reads_manifests=("bake", "materials"),
    summary="textured mesh -> GLB, USDZ, OBJ, PLY, STL; dense points -> PLY, LAZ; splats -> PLY, SPZ, GLB",
)
