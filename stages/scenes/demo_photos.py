"""The demo's photographs: a procedural bird figurine on a printed cloth.

Nothing is downloaded: shape, paint, cloth and surroundings come from formulas and a seed.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from stages.evaluation.protocols.known_object import TRUTH_CAMERAS, TRUTH_MESH
from stages.light.srgb import coded
from stages.scenes.figurine import make_figurine
from stages.scenes.figurine_pictures import light_scene, render
from stages.scenes.photo_files import is_complete, photo_exif, write_truth
from stages.scenes.viewpoints import camera_ring

SCENE_VERSION = 1  # raise it when the same seed would give other photos
PHOTOS = "photos"

FOCAL_35MM = 50  # equivalent focal length written into EXIF and used exactly: f_px = 50 / 36 * width
NOISE_SIGMA = 1.0 / 255.0


def make_demo_photos(
    folder: Path,
    num_photos: int = 24,
    size: tuple[int, int] = (640, 480),
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Render the demo's photos and write the truth beside them.

    Writes `photos/000.jpg` ... (with EXIF), `gt_mesh.ply` (z up, rests on z = 0, largest extent 1) and, last,
    `transforms.json` (pinhole intrinsics; per frame `transform_matrix`: camera to world with OpenGL axes, and
    `w2c_opencv`: world to camera with OpenCV axes). Same arguments, same photos.
    """
    import trimesh
    from PIL import Image

    if num_photos < 6:
        raise ValueError(f"the demo needs at least 6 photos, got {num_photos}")
    (folder / PHOTOS).mkdir(parents=True, exist_ok=True)
    (folder / TRUTH_CAMERAS).unlink(missing_ok=True)
    for stale in (folder / PHOTOS).glob("[0-9][0-9][0-9].jpg"):
        stale.unlink()
    figurine = make_figurine()
    scene = light_scene(figurine, seed)
    trimesh.Trimesh(figurine.vertices, figurine.faces, process=False).export(folder / TRUTH_MESH)
    rng = np.random.default_rng(seed + 1)
    focal = FOCAL_35MM / 36 * size[0]
    poses = camera_ring(num_photos, rng)
    names = [f"{PHOTOS}/{i:03d}.jpg" for i in range(num_photos)]
    exposure = 0.0
    for i, cam_from_world in enumerate(poses):
        radiance = render(scene, cam_from_world, focal, size)
        if i == 0:  # one exposure for all, from the first photo
            exposure = float(0.5 / np.percentile(radiance, 90))
        picture = Image.fromarray(develop(radiance, rng, exposure))
        picture.save(folder / names[i], quality=95, exif=photo_exif(picture, i, "Demo camera", FOCAL_35MM))
        if progress is not None:
            progress(i + 1, num_photos)
    write_truth(folder, names, poses, size, focal, _recipe(num_photos, size, seed))


def photos_are_complete(folder: Path, num_photos: int, size: tuple[int, int], seed: int) -> bool:
    """Whether `make_demo_photos` with the same arguments has finished in `folder` before."""
    return is_complete(folder, _recipe(num_photos, size, seed))


def _recipe(num_photos: int, size: tuple[int, int], seed: int) -> dict[str, Any]:
    return {"scene_version": SCENE_VERSION, "num_photos": num_photos, "size": list(size), "seed": seed}


def develop(radiance: np.ndarray, rng: np.random.Generator, exposure: float) -> np.ndarray:
    """8-bit sRGB picture with sensor noise from linear radiance."""
    linear = np.clip(radiance * exposure, 0.0, 1.0)
    noisy = coded(linear) + rng.normal(0, NOISE_SIGMA, linear.shape)
    return (np.clip(noisy, 0, 1) * 255 + 0.5).astype(np.uint8)
