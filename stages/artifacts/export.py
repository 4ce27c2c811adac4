"""What export publishes: the asset in the formats of other programs, all named model.*."""

from __future__ import annotations

from pathlib import Path

from stages.artifacts.artifact import place_artifact


def glb_path(folder: Path) -> Path:
    return folder / "model.glb"


def lod_path(folder: Path, level: int) -> Path:
    """The GLB of a level of detail, 1 or more; `glb_path` is level 0."""
    return folder / f"model_lod{level}.glb"


def collision_path(folder: Path) -> Path:
    """The GLB of convex pieces."""
    return folder / "model_collision.glb"


def obj_path(folder: Path) -> Path:
    return folder / "model.obj"


def mtl_path(folder: Path) -> Path:
    """The OBJ's material; it names the texture at `obj_texture_path`."""
    return folder / "model.mtl"


def obj_texture_path(folder: Path) -> Path:
    return folder / "model.png"


def obj_normal_map_path(folder: Path) -> Path:
    """The normal map that the MTL names, where there is one."""
    return folder / "model_normal.png"


def ply_path(folder: Path) -> Path:
    return folder / "model.ply"


def usdz_path(folder: Path) -> Path:
    return folder / "model.usdz"


def stl_path(folder: Path) -> Path:
    return folder / "model.stl"


# Which files there are depends on the settings, so it is the whole folder.
ASSET = place_artifact("export", ".", "model*")
