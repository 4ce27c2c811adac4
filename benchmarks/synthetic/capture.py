"""From radiance to files: what a camera does to a picture, and the folder of a scene.

A folder: `images/000.jpg` ..., `masks/000.png` ..., `gt_mesh.ply`, and, last, `transforms.json` as
`stages.evaluation.protocols.known_object` reads it. `made_with.json` says what is being made: photos of another
recipe are removed, finished ones are kept.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.synthetic import MADE_WITH, drone_gps
from benchmarks.synthetic.mitsuba_camera import Photographer
from benchmarks.synthetic.model import Scene
from benchmarks.synthetic.scenes import RECIPES, Recipe
from stages.evaluation.protocols.known_object import TRUTH_CAMERAS, TRUTH_MESH
from stages.light.srgb import as_bytes
from stages.scenes.photo_files import is_complete, photo_exif, write_truth

SUITE_VERSION = 1  # raise it when the same recipe would give other photos
IMAGES, MASKS = "images", "masks"

FOCAL_35MM = 40  # as EXIF says it
FOCAL_ERROR = 1.01  # true over stated: no lens is what it says
MASK_PATHS = 16  # a pixel
METER_PATHS = 16
WHITE_POINT = 0.55  # of the sensor, where the brightest tenth of the first photo begins
DRIFT = 0.06  # standard deviation of the exposure over the photos, relative
READ_NOISE = 0.002  # of full scale
SHOT_NOISE = 0.006  # of full scale at full scale; grows with the root of the light
JPEG_QUALITY = 95
GPS_STREAM = 0x475053  # sets the random numbers of its noise apart from those of photo 0, 1, ...


@dataclass(frozen=True)
class Order:
    """What is asked for.

    Attributes:
        scene: name in RECIPES.
        num_photos: how many.
        size: width and height in pixels.
        spp: paths a pixel.
        seed: of the scene, its cameras and its noise.
    """

    scene: str
    num_photos: int
    size: tuple[int, int]
    spp: int
    seed: int

    @property
    def focal(self) -> float:
        """Pixels."""
        return FOCAL_ERROR * FOCAL_35MM / 36 * self.size[0]

    def as_dict(self) -> dict[str, Any]:
        return {"suite_version": SUITE_VERSION, **asdict(self), "size": list(self.size)}


def make(
    order: Order,
    folder: Path,
    variant: str,
    progress: Callable[[int], None] = lambda done: None,
    recipes: Mapping[str, Recipe] = RECIPES,
) -> bool:
    """Make what is not there yet; whether there was anything to do."""
    recipe = recipes[order.scene]
    made_with = order.as_dict() | ({} if recipe.metres is None else {"gps": drone_gps.stated(recipe.metres)})
    if is_complete(folder, made_with):
        return False
    _begin(made_with, folder)
    rng = np.random.default_rng(order.seed)
    scene = recipe.make(rng, order.num_photos)
    positions = _positions(scene, recipe, order.seed)
    exposures = 1 + DRIFT * _drift(order.num_photos, rng)
    _write_mesh(scene, folder / TRUTH_MESH)
    camera = Photographer(scene, order.focal, order.size, variant)
    exposures *= _meter(scene, order, variant)
    for i, cam_from_world in enumerate(scene.cam_from_world):
        photo, mask = folder / IMAGES / f"{i:03d}.jpg", folder / MASKS / f"{i:03d}.png"
        if not photo.is_file():  # it is renamed into place, after its mask
            covered = camera.coverage(cam_from_world, MASK_PATHS, seed=_noise_seed(order, i, 1))
            _save(mask, _picture(np.where(covered >= 0.5, 255, 0).astype(np.uint8)))
            radiance = camera.radiance(cam_from_world, order.spp, seed=_noise_seed(order, i, 0))
            # rarely, a path is no number
            developed = develop(np.nan_to_num(radiance) * exposures[i], np.random.default_rng([order.seed, i]))
            picture = _picture(developed)
            exif = photo_exif(picture, i, "Synthetic camera", FOCAL_35MM, positions[i])
            _save(photo, picture, quality=JPEG_QUALITY, exif=exif)
        progress(i + 1)
    names = [f"{IMAGES}/{i:03d}.jpg" for i in range(order.num_photos)]
    notes = [{"exposure": round(float(exposure), 5)} for exposure in exposures]
    write_truth(folder, names, scene.cam_from_world, order.size, order.focal, made_with, notes)
    return True


def develop(light: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """8-bit sRGB [H, W, 3] of what falls on the sensor, 1 being its full scale; noise comes before the tone curve."""
    clipped = np.clip(light, 0, 1)
    sigma = np.sqrt(READ_NOISE**2 + SHOT_NOISE**2 * clipped)
    linear = np.clip(clipped + sigma * rng.standard_normal(clipped.shape), 0, 1)
    return as_bytes(linear)


def _drift(count: int, rng: np.random.Generator) -> np.ndarray:
    """[count] slow wandering around 0 with standard deviation 1."""
    walk = np.cumsum(rng.standard_normal(count))
    return (walk - walk.mean()) / walk.std()


def _meter(scene: Scene, order: Order, variant: str) -> float:
    """Exposure of the set, from a small first photo: from all of it, or from an object that stands on nothing."""
    small = (order.size[0] // 4, order.size[1] // 4)
    camera, pose = Photographer(scene, order.focal / 4, small, variant), scene.cam_from_world[0]
    first = camera.radiance(pose, METER_PATHS, seed=0)
    if scene.ground is None:
        first = first[camera.coverage(pose, METER_PATHS, seed=1) == 1]
    return float(WHITE_POINT / np.percentile(first, 90))


def _positions(scene: Scene, recipe: Recipe, seed: int) -> list[Any]:
    """What the camera's GPS says, photo by photo; None where it has none."""
    if recipe.metres is None:
        return [None] * len(scene.cam_from_world)
    rng = np.random.default_rng([seed, GPS_STREAM])  # its own: pictures are the same without GPS
    return drone_gps.drone_positions(scene.cam_from_world, recipe.metres, rng).tolist()


def _noise_seed(order: Order, index: int, purpose: int) -> int:
    return int(np.random.default_rng([order.seed, index, purpose]).integers(1 << 31))


# ---------------------------------------------------------------- files
def _begin(made_with: Mapping[str, Any], folder: Path) -> None:
    """Empty folders, or those of the same recipe."""
    note = folder / MADE_WITH
    if not note.is_file() or json.loads(note.read_text(encoding="utf-8")) != made_with:
        for name in (IMAGES, MASKS):
            shutil.rmtree(folder / name, ignore_errors=True)
    (folder / TRUTH_CAMERAS).unlink(missing_ok=True)
    for name in (IMAGES, MASKS):
        (folder / name).mkdir(parents=True, exist_ok=True)
    note.write_text(json.dumps(made_with, indent=1) + "\n", encoding="utf-8")


def _save(path: Path, picture: Any, **options: Any) -> None:
    """All of it or nothing."""
    partial = path.with_name(f"partial{path.suffix}")
    picture.save(partial, **options)
    os.replace(partial, path)


def _picture(pixels: np.ndarray) -> Any:
    from PIL import Image

    return Image.fromarray(pixels)


def _write_mesh(scene: Scene, path: Path) -> None:
    import trimesh

    trimesh.Trimesh(*scene.surface(), process=False).export(path)
