"""Make the synthetic suite: photos of made-up objects, with masks, exact cameras and the known surface.

python -m benchmarks.synthetic OUT                          all scenes but towns
python -m benchmarks.synthetic OUT --scenes thin,city       these
python -m benchmarks.synthetic OUT --check                  only compare what is there with its cameras

It needs Mitsuba 3: `pip install -e '.[bench]'`. Shapes, prints and lights come from formulas and a seed, so the photos
are nobody's but yours. A finished photo is not rendered again. `python -m benchmarks.run_sets OUT` runs `hineus run` on
what came out. Each scene is checked when it is done: surface and stated cameras against the renderer's own masks.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from benchmarks.synthetic.capture import Order, make
from benchmarks.synthetic.check import check
from benchmarks.synthetic.mitsuba_camera import EVERYWHERE, choose_variant
from benchmarks.synthetic.scenes import RECIPES, TOWNS
from stages.errors import HineusError


def main() -> int:
    scenes = "\n".join(f"  {name:9} {recipe.shows}" for name, recipe in (RECIPES | TOWNS).items())
    parser = argparse.ArgumentParser(
        description=f"{__doc__}\nscenes:\n{scenes}", formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, help="gets a folder for each scene")
    parser.add_argument("--scenes", default=",".join(RECIPES), help="names, with commas between; default: no towns")
    parser.add_argument("--photos", type=int, default=40, help="of each scene")
    parser.add_argument("--size", default="640x480", help="WIDTHxHEIGHT in pixels")
    parser.add_argument("--spp", type=int, default=16, help="paths a pixel; 4 times as many halve the noise")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--scalar", action="store_true", help="without LLVM: slower, the same everywhere")
    parser.add_argument("--check", action="store_true", help="render nothing")
    arguments = parser.parse_args()
    names = arguments.scenes.split(",")
    unknown = [name for name in names if name not in RECIPES | TOWNS]
    if unknown:
        parser.error(f"no scene is called {', '.join(unknown)}; there are {', '.join(RECIPES | TOWNS)}")
    width, _, height = arguments.size.partition("x")
    orders = [Order(name, arguments.photos, (int(width), int(height)), arguments.spp, arguments.seed) for name in names]
    try:
        variant = EVERYWHERE
        if not (arguments.check or arguments.scalar):
            variant, reason = choose_variant()
            _say(f"Mitsuba's variant: {variant}, {reason}")
        inexact = [order.scene for order in orders if not _made_and_exact(order, arguments, variant)]
    except HineusError as error:
        _say(f"{error.message}\n{error.hint}")
        return error.exit_code
    return 1 if inexact else 0


def _made_and_exact(order: Order, arguments: argparse.Namespace, variant: str) -> bool:
    folder = arguments.out / order.scene
    started = time.monotonic()

    def progress(done: int) -> None:
        print(f"\r{order.scene}: {done} of {order.num_photos}", end="", file=sys.stderr, flush=True)

    if not arguments.check and make(order, folder, variant, progress, RECIPES | TOWNS):
        _say(f", {time.monotonic() - started:.0f} s")
    found = check(folder)
    _say(
        f"{order.scene}: {'exact' if found.is_exact else 'NOT EXACT'}: masks and cast surface are {found.shift:.3f} "
        f"pixels apart, overlap by {100 * found.overlap:.2f} %, {100 * found.inside:.2f} % of the vertices inside"
    )
    return found.is_exact


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
