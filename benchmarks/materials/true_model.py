"""The truth as a file that a run could have left: what the judge must find nearly perfect."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.materials.held_out import Y_UP, write_exr, y_up_map
from benchmarks.materials.lights import LIGHTS
from benchmarks.materials.scenes import SUBJECTS
from benchmarks.synthetic.mitsuba_camera import painted_mesh
from benchmarks.synthetic.model import Scene
from stages.light.srgb import coded


def write_true_model(name: str, scene: Scene, folder: Path) -> None:
    """`model.glb` with a texel for each face's colour, roughness and metalness, and `light.exr`."""
    folder.mkdir(parents=True, exist_ok=True)
    corners, normals, colors, kinds = [], [], [], []
    for part in scene.parts:
        vertices, faces = painted_mesh([part])
        corners.append(vertices[faces, :3])
        normals.append(vertices[faces, 3:6])
        colors.append(vertices[faces, 6:].mean(1))
        kinds.append(np.broadcast_to([1.0, part.finish.roughness, part.finish.metallic], (len(faces), 3)))
    vertices, normals = (np.concatenate(each).reshape(-1, 3) @ Y_UP.T for each in (corners, normals))
    count = len(vertices) // 3
    side = int(np.ceil(np.sqrt(count)))
    row, column = np.divmod(np.arange(count), side)
    uvs = np.repeat((np.stack([column, row], 1) + 0.5) / side, 3, axis=0)
    textures = [_palette(np.concatenate(values), side) for values in ([coded(c) for c in colors], kinds)]
    (folder / "model.glb").write_bytes(_glb(vertices, normals, uvs, textures))
    write_exr(folder / "light.exr", y_up_map(LIGHTS[SUBJECTS[name].light]()))


def _palette(values: np.ndarray, side: int) -> np.ndarray:
    pixels = np.zeros((side * side, 3), np.uint8)
    pixels[: len(values)] = values * 255 + 0.5
    return pixels.reshape(side, side, 3)


def _glb(vertices: np.ndarray, normals: np.ndarray, uvs: np.ndarray, textures: list[np.ndarray]) -> bytes:
    """By trimesh's writer: what is judged is read back by rules that are not ours."""
    import trimesh
    from PIL import Image
    from trimesh.visual.material import PBRMaterial

    base, orm = (Image.fromarray(texture) for texture in textures)
    material = PBRMaterial(baseColorTexture=base, metallicRoughnessTexture=orm, metallicFactor=1.0, roughnessFactor=1.0)
    mesh = trimesh.Trimesh(
        vertices, np.arange(len(vertices)).reshape(-1, 3), vertex_normals=normals, process=False,
        visual=trimesh.visual.TextureVisuals(uv=uvs * [1, -1] + [0, 1], material=material),
    )  # fmt: skip
    extras = {"gltf_from_world_rotation": Y_UP.tolist(), "world_from_model": np.eye(4).tolist()}

    def note(tree: dict) -> None:
        tree["asset"]["extras"] = extras

    return trimesh.exchange.gltf.export_glb(trimesh.Scene(mesh), include_normals=True, tree_postprocessor=note)
