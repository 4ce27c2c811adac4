"""What the 3D view needs to show the model in a light: lights as small maps, and the material's images."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from stages.errors import InputError
from stages.files.contents import ROUGHNESS
from stages.files.light_files import read_light
from stages.geometry.cameras import PosedScene
from stages.geometry.place import Place
from stages.geometry.up import gltf_from_scene, y_up_rotation
from stages.light.built_in import LIGHTS
from stages.light.environment import resized
from stages.reporting.pictures import data_uri, jpeg_uri, read_rgb, shrink
from stages.reporting.view3d import encode

ROWS = 32
MATERIAL_SIDE = 1024
# The largest number of 16 bits.
BRIGHTEST = 65504.0
LABELS = {"studio": "Studio: softboxes", "sun": "Sun: clear sky", "window": "Window: a room"}
LEARNED = "The light of the photos"


def pack_lights(learned: Path | None, scene: PosedScene, place: Place) -> list[dict[str, Any]]:
    """The learned light, where `learned` is a file that holds one, and the built-in ones; each a map as in
    `stages.light.environment` of 16-bit RGBA, row 0 below, and by how many degrees it is turned in the view."""
    lights = [_packed(name, LABELS[name], make(ROWS), 0.0) for name, make in LIGHTS.items()]
    if learned is None or not learned.exists():
        return lights
    try:
        radiance = read_light(learned)
    except InputError:  # damaged: the page can do without
        return lights
    return [_packed("learned", LEARNED, resized(radiance, ROWS), view_turn_deg(scene, place)), *lights]


def pack_material(color: Path, orm: Path) -> dict[str, Any] | None:
    """Base colour, and occlusion, roughness and metalness; None where there are none, or they are damaged."""
    try:
        return {
            "color": jpeg_uri(shrink(read_rgb(color), MATERIAL_SIDE), 88),
            "orm": data_uri(shrink(read_rgb(orm), MATERIAL_SIDE), ".png"),
        }
    except (OSError, ValueError):
        return None


def describe_lights(learned: Path | None, color: Path, orm: Path, scene: PosedScene, place: Place) -> dict[str, Any]:
    """All of it, for `stages.report.describe_view`; without materials the learned light is left out."""
    material = pack_material(color, orm)
    return {
        "lights": pack_lights(learned if material else None, scene, place),
        "material": material,
        "roughness": ROUGHNESS,
    }


def view_turn_deg(scene: PosedScene, place: Place) -> float:
    """By how much the view is turned about the vertical from the frame of the GLB, as `environment.turned` counts."""
    view_from_scene = y_up_rotation(scene.up_in(place))
    ahead = view_from_scene @ gltf_from_scene(scene, place).rotation.T @ np.array([1.0, 0, 0])
    return float(np.degrees(np.arctan2(ahead[2], ahead[0])))


def _packed(key: str, label: str, radiance: np.ndarray, turn_deg: float) -> dict[str, Any]:
    height, width = radiance.shape[:2]
    pixels = np.ones((height, width, 4), dtype=np.float16)
    pixels[..., :3] = np.minimum(radiance[::-1], BRIGHTEST)
    return {"key": key, "label": label, "turn": round(turn_deg, 3), "width": width, "pixels": encode(pixels)}
