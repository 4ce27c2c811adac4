"""Photographs by Mitsuba 3 (the extra `bench`): a path tracer on the CPU. Pinhole, box filter: cameras are exact."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.synthetic.model import Ground, Part, Scene
from stages.drawing.path_tracing import EVERYWHERE as EVERYWHERE
from stages.drawing.path_tracing import FAST as FAST
from stages.drawing.path_tracing import choose_variant as choose_variant

MAX_BOUNCES = 4
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
            shapes = _shapes(mitsuba, scene.parts, Path(folder))
            self._objects = mitsuba.load_dict({"type": "scene", **shapes})
            self._whole = mitsuba.load_dict({"type": "scene", **shapes, **_surroundings(mitsuba, scene)})

    def radiance(self, cam_from_world: np.ndarray, spp: int, seed: int) -> np.ndarray:
        """Linear radiance [H, W, 3] with `spp` random paths a pixel."""
        path = self._mi.load_dict({"type": "path", "max_depth": MAX_BOUNCES + 1})
        return self._render(self._whole, path, cam_from_world, spp, seed, "rgb")

    def coverage(self, cam_from_world: np.ndarray, spp: int, seed: int) -> np.ndarray:
        """Share [H, W] of each pixel that the object covers."""
        # A scene without light: all that is asked is whether a ray met something.
        hit = self._mi.load_dict({"type": "direct", "emitter_samples": 0, "bsdf_samples": 1})
        return self._render(self._objects, hit, cam_from_world, spp, seed, "rgba")[..., 3]

    def _render(
        self, scene: Any, integrator: Any, cam_from_world: np.ndarray, spp: int, seed: int, pixels: str
    ) -> np.ndarray:  # fmt: skip
        mi = self._mi
        width, height = self.size
        world_from_cam = np.linalg.inv(cam_from_world) @ np.diag([-1.0, -1.0, 1.0, 1.0])  # x left, y up, z forward
        sensor = mi.load_dict(
            {
                "type": "perspective",
                "fov_axis": "x",
                "fov": float(2 * np.degrees(np.arctan(width / 2 / self.focal))),
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
        image = mi.render(scene, sensor=sensor, integrator=integrator, spp=spp, seed=seed)
        return np.array(image, dtype=np.float32)


# ---------------------------------------------------------------- scene
def _shapes(mi: Any, parts: tuple[Part, ...], folder: Path) -> dict[str, Any]:
    """One mesh a finish."""
    shapes = {}
    for finish in sorted({part.finish for part in parts}):
        meshes = [_painted(part) for part in parts if part.finish == finish]
        starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
        faces = np.concatenate([faces + start for (_, faces), start in zip(meshes, starts, strict=False)])
        path = folder / f"{finish}.ply"
        _write_ply(path, np.concatenate([vertices for vertices, _ in meshes]), faces)
        shapes[finish] = {"type": "ply", "filename": str(path), "bsdf": _surface(finish)}
    return shapes


def _painted(part: Part) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 9] float32 (position, normal, colour) and faces of a part, as they are rendered."""
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


def _write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    names = ("x", "y", "z", "nx", "ny", "nz", "r", "g", "b")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    header += [f"property float {name}" for name in names]
    header += [f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header\n"]
    rows = np.empty(len(faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, faces
    path.write_bytes("\n".join(header).encode() + vertices.astype("<f4").tobytes() + rows.tobytes())


def _surface(finish: str) -> dict[str, Any]:
    color = {"type": "mesh_attribute", "name": "vertex_color"}
    if finish == "matte":
        inner: dict[str, Any] = {"type": "diffuse", "reflectance": color}
    elif finish == "glossy":
        inner = {"type": "principled", "base_color": color, "roughness": ROUGHNESS["glossy"]}
    elif finish == "metal":
        inner = {"type": "roughconductor", "material": "Al", "alpha": ROUGHNESS["metal"]}
    else:
        inner = {"type": "conductor", "material": "Al"}
    return {"type": "twosided", "bsdf": inner}


def _surroundings(mi: Any, scene: Scene) -> dict[str, Any]:
    """The printed ground and plain floor around it, where there is one, and the sky."""
    flat = mi.ScalarTransform4f
    # Mitsuba's map has +y up and turns the other way round.
    turn = flat(np.array([[0, 0, -1.0, 0], [-1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1]]))
    sky = {
        "type": "envmap",
        "bitmap": mi.Bitmap(np.ascontiguousarray(scene.sky[:, ::-1])),
        "to_world": turn,
    }
    return {"sky": sky} | ({} if scene.ground is None else _ground(mi, scene.ground))


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
