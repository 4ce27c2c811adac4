"""Photographs by Mitsuba 3 (the extra `bench`): a path tracer on the CPU. Pinhole, box filter: cameras are exact."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.synthetic.model import Ground, Part, Principled, Scene
from stages.drawing.path_tracing import EVERYWHERE as EVERYWHERE
from stages.drawing.path_tracing import FAST as FAST
from stages.drawing.path_tracing import choose_variant as choose_variant

PAINTED = ("x", "y", "z", "nx", "ny", "nz", "r", "g", "b")  # of `painted_mesh`
MAX_BOUNCES = 4
PATHS = {"type": "path", "max_depth": MAX_BOUNCES + 1}
FLOOR_SIDE = 200.0  # around the printed ground, to the horizon
FLOOR_DROP = 2e-3
# Of Disney's principled surface, and alpha of the metal's microfacets (Walter et al. 2007). Metals are aluminium.
ROUGHNESS = {"glossy": 0.4, "metal": 0.12}


class Photographer:
    """Takes photos of one scene.

    Attributes:
        focal: pixels.
        size: width and height in pixels.
    """

    def __init__(self, scene: Scene, focal: float, size: tuple[int, int], variant: str) -> None:
        import mitsuba

        mitsuba.set_variant(variant)
        self._mi = mitsuba
        self.focal, self.size = focal, size
        with tempfile.TemporaryDirectory() as folder:  # Mitsuba takes vertex colours from PLY files
            shapes = _shapes(scene.parts, Path(folder))
            self._objects = mitsuba.load_dict({"type": "scene", **shapes})
            self._whole = mitsuba.load_dict({"type": "scene", **shapes, **_surroundings(mitsuba, scene)})

    def radiance(self, cam_from_world: np.ndarray, spp: int, seed: int) -> np.ndarray:
        """Linear radiance [H, W, 3] with `spp` random paths a pixel."""
        return self._render(self._whole, PATHS, cam_from_world, spp, seed, "rgb")

    def coverage(self, cam_from_world: np.ndarray, spp: int, seed: int) -> np.ndarray:
        """Share [H, W] of each pixel that the object covers."""
        # A scene without light: all that is asked is whether a ray met something.
        hit = {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1}
        return self._render(self._objects, hit, cam_from_world, spp, seed, "rgba")[..., 3]

    def _render(
        self, scene: Any, integrator: dict[str, Any], cam_from_world: np.ndarray, spp: int, seed: int, pixels: str
    ) -> np.ndarray:
        mi = self._mi
        sensor = pinhole(mi, cam_from_world, self.focal, self.size, spp, pixels)
        image = mi.render(scene, sensor=sensor, integrator=mi.load_dict(integrator), spp=spp, seed=seed)
        return np.array(image, dtype=np.float32)


def pinhole(
    mi: Any, cam_from_world: np.ndarray, focal: float, size: tuple[int, int], spp: int, pixels: str = "rgb"
) -> Any:
    """Mitsuba's camera at a pose with OpenCV axes, the principal point in the middle; `pixels`: format of its film."""
    width, height = size
    world_from_cam = np.linalg.inv(cam_from_world) @ np.diag([-1.0, -1.0, 1.0, 1.0])  # x left, y up, z forward
    return mi.load_dict(
        {
            "type": "perspective",
            "fov_axis": "x",
            "fov": float(2 * np.degrees(np.arctan(width / 2 / focal))),
            "near_clip": 0.01,
            "far_clip": 100.0,
            "to_world": mi.ScalarTransform4f(world_from_cam),
            "sampler": {"type": "multijitter", "sample_count": spp},
            "film": {
                "type": "hdrfilm",
                "width": width,
                "height": height,
                "pixel_format": pixels,
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
        }
    )


# ---------------------------------------------------------------- scene
def _shapes(parts: tuple[Part, ...], folder: Path) -> dict[str, Any]:
    """One mesh a finish."""
    shapes = {}
    for k, finish in enumerate(dict.fromkeys(sorted((part.finish for part in parts), key=str))):
        path = folder / f"{k}.ply"
        write_ply(path, *painted_mesh([part for part in parts if part.finish == finish]))
        shapes[f"finish{k}"] = {"type": "ply", "filename": str(path), "bsdf": _surface(finish)}
    return shapes


def painted_mesh(parts: Sequence[Part]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 9] float32 (position, normal, colour) and faces [F, 3] of parts together, as they are rendered."""
    meshes = [_painted(part) for part in parts]
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    faces = [faces + start for (_, faces), start in zip(meshes, starts, strict=False)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(faces)


def _painted(part: Part) -> tuple[np.ndarray, np.ndarray]:
    """`painted_mesh` of one part."""
    import trimesh

    vertices, faces, normals = part.vertices, part.faces, part.normals
    if normals is None:
        corners = vertices[faces]
        flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-20)
        rows = np.hstack([corners.reshape(-1, 3), np.repeat(flat, 3, axis=0)])
        faces = np.arange(len(rows)).reshape(-1, 3)
        if part.grain is not None:  # normals are the same at a face's corners, so they add nothing to its edges' length
            rows, faces = trimesh.remesh.subdivide_to_size(rows, faces, part.grain, max_iter=20)
        vertices, normals = rows[:, :3], rows[:, 3:]
    colors = part.paint(vertices, normals)
    return np.hstack([vertices, normals, colors]).astype(np.float32), faces


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray, names: Sequence[str] = PAINTED) -> None:
    """A mesh as Mitsuba reads it; `names` of the columns of `vertices`."""
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name in names]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n"]
    rows = np.empty(len(faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    path.write_bytes("\n".join(header).encode() + vertices.astype("<f4").tobytes() + rows.tobytes())


def _surface(finish: str | Principled) -> dict[str, Any]:
    color = {"type": "mesh_attribute", "name": "vertex_color"}
    if isinstance(finish, Principled):
        inner = principled(color, finish.roughness, finish.metallic)
    elif finish == "matte":
        inner = {"type": "diffuse", "reflectance": color}
    elif finish == "glossy":
        inner = {"type": "principled", "base_color": color, "roughness": ROUGHNESS["glossy"]}
    elif finish == "metal":
        inner = {"type": "roughconductor", "material": "Al", "alpha": ROUGHNESS["metal"]}
    else:
        inner = {"type": "conductor", "material": "Al"}
    return {"type": "twosided", "bsdf": inner}


def principled(color: dict[str, Any], roughness: Any, metallic: Any) -> dict[str, Any]:
    """Mitsuba's surface whose parameters mean what glTF's mean (an index of refraction of 1.5 where it is no metal);
    each a number or a texture."""
    return {"type": "principled", "base_color": color, "roughness": roughness, "metallic": metallic, "specular": 0.5}


def _surroundings(mi: Any, scene: Scene) -> dict[str, Any]:
    """The printed ground and plain floor around it, where there is one, and the sky."""
    return {"sky": sky(mi, scene.sky)} | ({} if scene.ground is None else _ground(mi, scene.ground))


def sky(mi: Any, radiance: np.ndarray) -> dict[str, Any]:
    """Mitsuba's light from all around, of a map as `Scene.sky` is one."""
    # Mitsuba's map has +y up and turns the other way round.
    turn = mi.ScalarTransform4f(np.array([[0, 0, -1.0, 0], [-1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1]]))
    return {"type": "envmap", "bitmap": mi.Bitmap(np.ascontiguousarray(radiance[:, ::-1])), "to_world": turn}


def _ground(mi: Any, ground: Ground) -> dict[str, Any]:
    flat = mi.ScalarTransform4f
    print_ = {"type": "bitmap", "bitmap": mi.Bitmap(ground.image.astype(np.float32)), "raw": True}
    mean = [float(value) for value in ground.image.reshape(-1, 3).mean(0)]
    return {
        "ground": {
            "type": "rectangle",
            "to_world": flat().translate([0, 0, ground.height]).scale(ground.side / 2),
            "bsdf": {"type": "diffuse", "reflectance": print_},
        },
        "floor": {
            "type": "rectangle",
            "to_world": flat().translate([0, 0, ground.height - FLOOR_DROP]).scale(FLOOR_SIDE / 2),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": mean}},
        },
    }
