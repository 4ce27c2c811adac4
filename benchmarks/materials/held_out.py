"""The truth of a suite's object: held-out views under all lights, and what its surface is made of.

`held_out/000.npz` ...: float32 `base_color` [H, W, 3] (linear), `roughness`, `metallic`, `coverage` [H, W], and for
each light `radiance_LIGHT` [H, W, 3], linear, of object and background. `held_out/views.json`: focal length and size in
pixels and the poses, in the frame of `gt_mesh.ply`. `lights/LIGHT.exr`: as `stages.light.environment` has them, in that
frame turned Y up: (x, z, -y).
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.materials import unlit
from benchmarks.materials.lights import LIGHTS
from benchmarks.synthetic.mitsuba_camera import Photographer, painted_mesh, write_ply
from benchmarks.synthetic.model import Part, Scene
from stages import artifacts

FOLDER, VIEWS, LIGHT_MAPS = "held_out", "views.json", "lights"
MAP_PATHS = 36  # a pixel
# From the axes of the truth, z up, to those of a GLB, Y up.
Y_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


@dataclass(frozen=True)
class Views:
    """Held-out cameras.

    Attributes:
        cam_from_world: [N, 4, 4], OpenCV axes.
        focal: pixels.
        size: width and height in pixels.
    """

    cam_from_world: np.ndarray
    focal: float
    size: tuple[int, int]

    def save(self, folder: Path) -> None:
        views = {"focal": self.focal, "size": list(self.size), "cam_from_world": self.cam_from_world.tolist()}
        artifacts.write_json(folder / FOLDER / VIEWS, views)

    @classmethod
    def load(cls, folder: Path) -> Views:
        views = artifacts.read_json(folder / FOLDER / VIEWS)
        return cls(np.array(views["cam_from_world"]), views["focal"], tuple(views["size"]))


def write_held_out(scene: Scene, views: Views, folder: Path, spp: int, variant: str) -> None:
    """Render the views of a scene, whose own sky does not count, under all lights."""
    (folder / FOLDER).mkdir(parents=True, exist_ok=True)
    (folder / LIGHT_MAPS).mkdir(exist_ok=True)
    truths = surface_maps(scene.parts, views, variant)
    for name, light in LIGHTS.items():
        write_exr(folder / LIGHT_MAPS / f"{name}.exr", y_up_map(light()))
        camera = Photographer(replace(scene, sky=light()), views.focal, views.size, variant)
        for i, (pose, truth) in enumerate(zip(views.cam_from_world, truths, strict=True)):
            truth[f"radiance_{name}"] = camera.radiance(pose, spp, seed=i)
    for i, truth in enumerate(truths):
        np.savez_compressed(folder / FOLDER / f"{i:03d}.npz", **truth)
    views.save(folder)


def read_truth(folder: Path, index: int) -> dict[str, np.ndarray]:
    """What is known of a held-out view."""
    with np.load(folder / FOLDER / f"{index:03d}.npz") as stored:
        return dict(stored)


def surface_maps(parts: tuple[Part, ...], views: Views, variant: str) -> list[dict[str, np.ndarray]]:
    """`base_color`, `roughness`, `metallic`, `coverage` of each view."""
    import mitsuba as mi

    mi.set_variant(variant)
    colors, kinds = {}, {}
    with tempfile.TemporaryDirectory() as scratch:
        for k, part in enumerate(parts):
            path = Path(scratch) / f"{k}.ply"
            write_ply(path, *painted_mesh([part]))
            shape: dict[str, Any] = {"type": "ply", "filename": str(path)}
            colors[str(k)] = unlit.shining(shape, {"type": "mesh_attribute", "name": "vertex_color"})
            kinds[str(k)] = unlit.shining(shape, unlit.numbers(part.finish.roughness, part.finish.metallic, 1.0))
        color_scene, kind_scene = (mi.load_dict({"type": "scene", **shapes}) for shapes in (colors, kinds))
    maps = []
    for pose in views.cam_from_world:
        color, kind = (
            unlit.seen(mi, scene, pose, views.focal, views.size, MAP_PATHS) for scene in (color_scene, kind_scene)
        )
        coverage = kind[..., 2]
        roughness, metallic = np.moveaxis(unlit.of_covered(kind[..., :2], coverage), 2, 0)
        maps.append(
            {
                "base_color": unlit.of_covered(color, coverage),
                "roughness": roughness,
                "metallic": metallic,
                "coverage": coverage,
            }
        )
    return maps


# ---------------------------------------------------------------- lights
def y_up_map(sky: np.ndarray) -> np.ndarray:
    """A map as `Scene.sky` is one, as `stages.light.environment` has it, in the frame turned by `Y_UP`."""
    width = sky.shape[1]
    return np.ascontiguousarray(sky[:, (width // 2 - 1 - np.arange(width)) % width])


def z_up_map(light: np.ndarray) -> np.ndarray:
    """The other way round; it is the same exchange of columns."""
    return y_up_map(light)


def write_exr(path: Path, radiance: np.ndarray) -> None:
    import OpenEXR

    channels = {"RGB": np.ascontiguousarray(radiance, dtype=np.float32)}
    OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels).write(str(path))


def read_exr(path: Path) -> np.ndarray:
    """Radiance [H, W, 3] float32."""
    import OpenEXR

    channels = OpenEXR.File(str(path)).channels()
    if "RGB" in channels:
        return np.asarray(channels["RGB"].pixels, dtype=np.float32)
    return np.stack([np.asarray(channels[name].pixels, dtype=np.float32) for name in "RGB"], axis=2)
