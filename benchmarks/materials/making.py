"""The folder of an object: photos as a camera takes them, and the truth of held-out views."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from benchmarks.materials.held_out import FOLDER, VIEWS, Views, write_held_out
from benchmarks.materials.scenes import HELD_OUT_VIEWS, RECIPES, SUBJECTS, around, make_scene
from benchmarks.materials.true_model import write_true_model
from benchmarks.synthetic.capture import Order, make
from benchmarks.synthetic.check import check
from benchmarks.synthetic.model import Scene

PHOTOS, SIZE, SPP = 40, (640, 480), 25
HELD_OUT_SIZE, HELD_OUT_SPP = (320, 240), 144
SEED = 21


def make_object(name: str, folder: Path, variant: str) -> None:
    """Make what is not there yet.

    Raises:
        ValueError: photos, cameras and surface do not belong together.
    """
    order = Order(name, PHOTOS, SIZE, SPP, SEED)

    def progress(done: int) -> None:
        print(f"\r{name}: {done} of {PHOTOS}", end="", file=sys.stderr, flush=True)

    if make(order, folder, variant, progress, RECIPES):
        (folder / FOLDER / VIEWS).unlink(missing_ok=True)
    found = check(folder)
    if not found.is_exact:
        raise ValueError(f"expected masks that the cast surface covers, got {found}")
    if not (folder / FOLDER / VIEWS).is_file():
        scene = _scene(name)
        middle = np.array([0, 0, scene.surface()[0][:, 2].max() / 2])
        poses = around(middle, HELD_OUT_VIEWS, np.random.default_rng(SEED + 1))
        views = Views(poses, order.focal * HELD_OUT_SIZE[0] / SIZE[0], HELD_OUT_SIZE)
        write_held_out(scene, views, folder, HELD_OUT_SPP, variant)


def write_true_object(name: str, folder: Path) -> None:
    """The truth as files of a run."""
    write_true_model(name, _scene(name), folder)


def _scene(name: str) -> Scene:
    return make_scene(SUBJECTS[name], np.random.default_rng(SEED), PHOTOS)
