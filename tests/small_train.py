"""`hineus` whose stages before training write the photos of a ball, for tests of what processes do together.

Runs as a program: `python tests/small_train.py train --workspace W`.
"""

from __future__ import annotations

import os
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

sys.path += [str(Path(__file__).parent), str(Path(__file__).parents[1])]

from sphere_scene import ring_of_cameras, write_densified, write_undistorted

from hineus_cli.app import build_app
from stages import train
from stages.densify import DENSIFY
from stages.engine.stage import StageContext
from stages.train import TRAIN
from stages.undistort import UNDISTORT


def undistort(context: StageContext[Any]) -> dict[str, Any]:
    # Of masks there is no background, whose colours are drawn for some of the rays only.
    write_undistorted(context.out, ring_of_cameras(), masks=True)
    return {}


def densify(context: StageContext[Any]) -> dict[str, Any]:
    write_densified(context.out)
    return {}


PIPELINE = (
    replace(UNDISTORT, run=undistort, reads=(), continues=False),
    replace(DENSIFY, run=densify, reads=()),
    TRAIN,
)

if __name__ == "__main__":
    train.LOG_EVERY = int(os.environ.get("LOG_EVERY", train.LOG_EVERY))
    train.CHECKPOINT_EVERY = float(os.environ.get("CHECKPOINT_EVERY", train.CHECKPOINT_EVERY))
    build_app(PIPELINE)()
