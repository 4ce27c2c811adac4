"""Small photos of a made-up capture by Mitsuba (the extra `bench`), to run the whole pipeline on: a folder as those of
`benchmarks.synthetic`, with the subject as its known surface."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from benchmarks.captures.model import FOCAL, Capture, Thing, joined
from benchmarks.synthetic.capture import JPEG_QUALITY, WHITE_POINT, develop
from benchmarks.synthetic.mitsuba_camera import Photographer, choose_variant
from benchmarks.synthetic.model import Paint, Part, Scene
from stages.evaluation.protocols.known_object import TRUTH_MESH
from stages.scenes.noise import ValueNoise
from stages.scenes.photo_files import is_complete, photo_exif, write_truth
from stages.surface.triangle_mesh import face_areas

LONG_SIDE, PATHS = 480, 32
FINEST, PAINTED = 0.012, 400  # metres: longest painted edge; and that many of them along the side of a large thing
SPOTS, OCTAVES = 18.0, 4  # of the print: a metre, and how often each is made half as large
CONTRAST = 6.0  # of a print with texture 1
CELLS = 128  # of the noise before it comes again: seven metres, for no two places may look the same
SKY = 1.0  # radiance: an overcast day


def render(capture: Capture, name: str, folder: Path) -> None:
    """Write `images/`, `gt_mesh.ply` and, last, `transforms.json`; what is complete stays as it is."""
    import trimesh
    from PIL import Image

    scale = LONG_SIDE / max(capture.size)
    size, focal = (round(capture.size[0] * scale), round(capture.size[1] * scale)), capture.focal * scale
    made_with = {"capture": name, "size": list(size), "paths": PATHS}
    if is_complete(folder, made_with):
        return
    (folder / "images").mkdir(parents=True, exist_ok=True)
    subject = joined(capture.subject)
    trimesh.Trimesh(subject.vertices, subject.faces, process=False).export(folder / TRUTH_MESH)
    camera = Photographer(_scene(capture), focal, size, choose_variant()[0])
    names, exposure = [], 0.0
    for i, cam_from_world in enumerate(capture.cam_from_world):
        radiance = camera.radiance(cam_from_world, PATHS, seed=i)
        exposure = exposure or WHITE_POINT / float(np.percentile(radiance, 90))  # metered on the first
        picture = Image.fromarray(develop(radiance * exposure, np.random.default_rng(i)))
        names.append(f"images/{i:03d}.jpg")
        exif = photo_exif(picture, i, "Synthetic camera", round(36 * FOCAL))
        picture.save(folder / names[-1], quality=JPEG_QUALITY, exif=exif)
    write_truth(folder, names, capture.cam_from_world, size, focal, made_with)


def _scene(capture: Capture) -> Scene:
    rng = np.random.default_rng(0)
    noise = ValueNoise(rng, CELLS)
    parts = tuple(_part(thing, noise, rng.uniform(0, 100, 3)) for thing in capture.subject + capture.surroundings)
    return Scene(parts, None, np.full((32, 64, 3), SKY, np.float32), capture.cam_from_world)


def _part(thing: Thing, noise: ValueNoise, origin: np.ndarray) -> Part:
    side = float(np.sqrt(face_areas(thing.vertices, thing.faces).sum()))
    return Part(thing.vertices, thing.faces, "matte", _print(thing, noise, origin), grain=max(FINEST, side / PAINTED))


def _print(thing: Thing, noise: ValueNoise, origin: np.ndarray) -> Paint:
    """Spots around the thing's colour, as strong as its texture says; `origin` [3] is the noise's."""

    def paint(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        spots = CONTRAST * thing.texture * (noise.fractal(points + origin, SPOTS, OCTAVES) - 0.5)
        return np.clip(np.array(thing.color) * np.exp(spots)[:, None], 0.02, 0.9)

    return paint
