"""The scenes of `benchmarks.synthetic` as captures: their surfaces and cameras, with a guess at their texture."""

from __future__ import annotations

import numpy as np

from benchmarks.captures.model import Capture, Thing
from benchmarks.captures.shapes import flat
from benchmarks.synthetic.capture import Order
from benchmarks.synthetic.scenes import RECIPES

PHOTOS, SIZE = 40, (640, 480)  # as `python -m benchmarks.synthetic` has them
TEXTURES = {"textured": 0.9, "polished": 0.15, "plain": 0.06, "thin": 0.6, "mirror": 0.1, "city": 0.8}
GROUND_TEXTURE = 0.8


def make(name: str) -> Capture:
    """The scene of this name, as the suite makes it with its defaults."""
    order = Order(name, PHOTOS, SIZE, spp=1, seed=0)
    scene = RECIPES[name].make(np.random.default_rng(order.seed), order.num_photos)
    assert scene.ground is not None  # all of them stand on one
    side, z = scene.ground.side, scene.ground.height
    printed = flat((0, 0, z), side, side, GROUND_TEXTURE)
    return Capture((Thing(*scene.surface(), TEXTURES[name]),), (printed,), scene.cam_from_world, SIZE, order.focal)
