"""What export publishes: the asset in the formats of other programs. Which files there are depends on the settings."""

from __future__ import annotations

from pathlib import Path

from stages.artifacts.artifact import in_folder

GEOREFERENCE, METADATA = "georeference.json", "metadata.xml"
TILESET, ORTHOPHOTO, SURFACE_MODEL = "tileset.json", "orthophoto.tif", "dsm.tif"

ASSET = in_folder(
    "export",
    ("model*", "points.*", GEOREFERENCE, METADATA, TILESET, ORTHOPHOTO, SURFACE_MODEL),
    lambda folder: folder,
)


def asset_path(folder: Path, kind: str) -> Path:
    """The file of a format: glb, usdz, obj, ply or stl; mtl and png (material and texture) go with the OBJ."""
    return folder / f"model.{kind}"


def points_path(folder: Path, kind: str) -> Path:
    """The dense points: ply or laz."""
    return folder / f"points.{kind}"


def obj_map_path(folder: Path, kind: str) -> Path:
    """A map that the MTL names beside the texture, where there is one: normal, roughness or metallic."""
    return folder / f"model_{kind}.png"


def lod_path(folder: Path, level: int) -> Path:
    """The GLB of a level of detail, 1 or more; level 0 is the model itself."""
    return folder / f"model_lod{level}.glb"


def collision_path(folder: Path) -> Path:
    """The GLB of convex pieces."""
    return folder / "model_collision.glb"


def simulation_path(folder: Path) -> Path:
    """The USDZ for simulators."""
    return folder / "model_simulation.usdz"


def light_path(folder: Path, kind: str) -> Path:
    """The light of the photos: exr, hdr or json (its spherical harmonics), in the frame of the GLB."""
    return folder / f"model_light.{kind}"


def splats_path(folder: Path, kind: str, level: int = 0) -> Path:
    """The Gaussian splats: ply, spz or glb; level 0 is all of them, 1 or more a level of detail."""
    return folder / f"model{f'_lod{level}' if level else ''}.splats.{kind}"


def overview_path(tileset: Path, number: int) -> Path:
    """A coarse model of several tilesets, beside the tileset that joins them."""
    return tileset.with_name(f"{tileset.stem}_overviews") / f"{number}.glb"


def forget_overviews(tileset: Path, count: int) -> None:
    """Remove what an earlier tileset of more parts left: all but the first `count`."""
    for path in overview_path(tileset, 0).parent.glob("*.glb"):
        if path.stem.isdecimal() and int(path.stem) >= count:
            path.unlink()
