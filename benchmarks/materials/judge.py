"""A model as Mitsuba sees it: under a light, and its maps without any."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.materials import unlit
from benchmarks.materials.glb_model import Model
from benchmarks.materials.held_out import MAP_PATHS, Views
from benchmarks.synthetic.mitsuba_camera import PATHS, pinhole, principled, sky, write_ply

ATTRIBUTES = ("x", "y", "z", "nx", "ny", "nz", "u", "v")


class Judge:
    """Draws the held-out views of one object."""

    def __init__(self, views: Views, variant: str) -> None:
        import mitsuba

        mitsuba.set_variant(variant)
        self._mi = mitsuba
        self.views = views

    def lit(self, model: Model, light: np.ndarray, spp: int) -> np.ndarray:
        """Radiance [N, H, W, 3] of all views under a light that is given as `Scene.sky` is."""
        mi, views = self._mi, self.views
        with tempfile.TemporaryDirectory() as folder:
            surface = principled(
                self._texture(model.base_color), self._texture(model.roughness), self._texture(model.metallic)
            )
            shape = {**_shape(model, Path(folder)), "bsdf": {"type": "twosided", "bsdf": surface}}
            scene = mi.load_dict({"type": "scene", "model": shape, "sky": sky(mi, light)})
        pictures = []
        for i, pose in enumerate(views.cam_from_world):
            sensor = pinhole(mi, pose, views.focal, views.size, spp)
            # other random paths than the truth's
            image = mi.render(scene, sensor=sensor, integrator=mi.load_dict(PATHS), spp=spp, seed=1000 + i)
            pictures.append(np.nan_to_num(np.array(image, dtype=np.float32)))  # rarely, a path is no number
        return np.stack(pictures)

    def maps(self, model: Model) -> list[dict[str, np.ndarray]]:
        """`base_color`, `roughness`, `metallic`, `coverage` of all views, as the truth has them."""
        rough, metal = np.broadcast_arrays(model.roughness, model.metallic)
        kinds = np.stack([rough, metal, np.ones_like(rough)], axis=2)
        colors, kinds = self._unlit(model, model.base_color), self._unlit(model, kinds)
        maps = []
        for color, kind in zip(colors, kinds, strict=True):
            coverage = kind[..., 2]
            roughness, metallic = np.moveaxis(unlit.of_covered(kind[..., :2], coverage), 2, 0)
            base_color = unlit.of_covered(color, coverage)
            maps.append({"base_color": base_color, "roughness": roughness, "metallic": metallic, "coverage": coverage})
        return maps

    def _unlit(self, model: Model, texture: np.ndarray) -> list[np.ndarray]:
        mi, views = self._mi, self.views
        with tempfile.TemporaryDirectory() as folder:
            shape = unlit.shining(_shape(model, Path(folder)), self._texture(texture))
            scene = mi.load_dict({"type": "scene", "model": shape})
        return [
            unlit.seen(mi, scene, pose, views.focal, views.size, MAP_PATHS) for pose in views.cam_from_world
        ]  # fmt: skip

    def _texture(self, values: np.ndarray) -> dict[str, Any]:
        """Linear numbers [H, W, 3] or [H, W]."""
        pixels = values if values.ndim == 3 else values[..., None]
        bitmap = self._mi.Bitmap(np.ascontiguousarray(pixels, dtype=np.float32))
        return {"type": "bitmap", "bitmap": bitmap, "raw": True, "wrap_mode": "clamp"}


def _shape(model: Model, folder: Path) -> dict[str, Any]:
    path = folder / "model.ply"
    rows = np.hstack([model.vertices, model.normals, model.uvs])
    write_ply(path, rows, model.faces, ATTRIBUTES)
    return {"type": "ply", "filename": str(path)}
