"""A model to be judged: the mesh of a GLB in the frame of the truth, its maps, and the light that goes with it."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.materials.held_out import read_exr
from stages import artifacts
from stages.errors import InputError
from stages.light import environment
from stages.light.srgb import decoded
from stages.scenes.room import sphere_directions

LIGHT_HEIGHT = 512  # of the map that the judge lights with


@dataclass(frozen=True)
class Model:
    """A mesh and what it is made of.

    Attributes:
        vertices: [V, 3] in the frame of the truth, z up.
        normals: [V, 3] unit.
        uvs: [V, 2], v = 0 at row 0 of the maps, as glTF has it.
        faces: [F, 3].
        base_color: [H, W, 3] float32, linear.
        roughness: [H, W] float32.
        metallic: [H, W] float32.
    """

    vertices: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray
    faces: np.ndarray
    base_color: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray

    def of(self, base_color: np.ndarray, roughness: float, metallic: float) -> Model:
        """The same mesh with another base colour, and one roughness and one metalness everywhere."""
        flat = [np.full((1, 1), value, np.float32) for value in (roughness, metallic)]
        return replace(self, base_color=base_color, roughness=flat[0], metallic=flat[1])


@dataclass(frozen=True)
class Finished:
    """What a run left.

    Attributes:
        model: with the maps of the stage `materials`, or, without it, those of the GLB.
        has_materials: whether the maps are more than a base colour.
        baked: the texture of the stage `bake` as a base colour [H, W, 3], linear; None: there is none.
        light: as `Scene.sky` is one, in the frame of the truth; None: there is none.
    """

    model: Model
    has_materials: bool
    baked: np.ndarray | None
    light: np.ndarray | None


def read_finished(folder: Path) -> Finished:
    """A workspace, or a folder with `model.glb` and, perhaps, `light.exr`; its poses are those of the truth.

    Raises:
        InputError: there is no model.
    """
    glb = next((path for path in (folder / "export" / "model.glb", folder / "model.glb") if path.is_file()), None)
    if glb is None:
        raise InputError(f"There is no model.glb in {folder}.", "Try `python -m benchmarks.materials run OUT`.")
    model, frames, has_materials = read_glb(glb)
    made = folder / "materials"
    if (made / artifacts.ORM.files[0]).is_file():
        orm = _read_rgb(made / artifacts.ORM.files[0]) / np.float32(255)
        color = linear(_read_rgb(made / artifacts.MATERIAL_COLOR.files[0]))
        model = replace(model, base_color=color, roughness=orm[..., 1], metallic=orm[..., 2])
        has_materials = True
    texture = folder / "bake" / artifacts.BASE_COLOR.files[0]
    light = next((path for path in (made / "light.exr", folder / "light.exr") if path.is_file()), None)
    return Finished(
        model,
        has_materials,
        linear(_read_rgb(texture)) if texture.is_file() else None,
        None if light is None else z_up_light(read_exr(light), frames.rotation),
    )


@dataclass(frozen=True)
class Frames:
    """How a GLB's frame lies in that of the truth: x_truth = scale · rotation · x_glb + translation."""

    rotation: np.ndarray
    scale: float
    translation: np.ndarray


def read_glb(path: Path) -> tuple[Model, Frames, bool]:
    """A textured GLB with one mesh in the frame of the truth, and whether it has a texture of roughness."""
    import trimesh

    frames = _frames(path)
    (mesh,) = trimesh.load_scene(path, process=False).geometry.values()
    material = mesh.visual.material
    shiny = material.metallicRoughnessTexture
    roughness, metallic = (
        np.float32(1.0 if factor is None else factor) for factor in (material.roughnessFactor, material.metallicFactor)
    )
    orm = np.ones((1, 1, 3), np.float32) if shiny is None else np.asarray(shiny.convert("RGB"), np.float32) / 255
    model = Model(
        vertices=frames.scale * np.asarray(mesh.vertices) @ frames.rotation.T + frames.translation,
        normals=np.asarray(mesh.vertex_normals) @ frames.rotation.T,
        uvs=np.asarray(mesh.visual.uv) * [1, -1] + [0, 1],  # trimesh turns v
        faces=np.asarray(mesh.faces),
        base_color=linear(np.asarray(material.baseColorTexture.convert("RGB"))),
        roughness=orm[..., 1] * roughness,
        metallic=orm[..., 2] * metallic,
    )
    return model, frames, shiny is not None


def z_up_light(light: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """A light of `stages.light.environment` in a frame of which `rotation` leads to the truth's, as `Scene.sky`."""
    return environment.look_up(light, (sphere_directions(LIGHT_HEIGHT) @ rotation).astype(np.float32))


def linear(srgb: np.ndarray) -> np.ndarray:
    """Linear float32 of 8-bit sRGB."""
    return decoded(np.arange(256) / 255).astype(np.float32)[srgb]


def _frames(path: Path) -> Frames:
    data = path.read_bytes()
    tree = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    extras: dict[str, Any] = tree["asset"]["extras"]
    world_from_glb = np.array(extras["gltf_from_world_rotation"]).T
    model_from_world = np.linalg.inv(np.array(extras["world_from_model"]))
    turn = model_from_world[:3, :3] @ world_from_glb
    scale = float(np.cbrt(np.linalg.det(turn)))
    return Frames(turn / scale, scale, model_from_world[:3, 3])


def _read_rgb(path: Path) -> np.ndarray:
    from PIL import Image

    return np.asarray(Image.open(path).convert("RGB"))
