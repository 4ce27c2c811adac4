"""A run in blocks that is killed again and again, against one that nobody disturbs: are the results the same?

python -m benchmarks.synthetic DATA --scenes city --photos 24 --size 160x120 --spp 4
python -m benchmarks.kills DATA/city/images --poses DATA/city/transforms.json [--blocks 2] [--kills 10] [--set ...]

PHOTOS_undisturbed is run once. PHOTOS_killed is begun `--kills` times, each time killed with all below it (SIGKILL)
after a part of the undisturbed run's time that is drawn at random, and then run to its end. What is told: at which
stage each kill struck, and which of the blocks' meshes, textures and models are the same byte for byte. One thread.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import psutil

COMPARED = ("cleanup/mesh.ply", "bake/base_color.png", "export/model.glb")
# Of the time that is left at most, so that kills are spread over the run, and at least, so that it gets anywhere.
SHARES = (0.05, 0.2)


def command(
    photos: Path, workspace: Path, poses: Path | None, blocks: int, jobs: int, sets: Sequence[str]
) -> list[str]:
    words = [sys.executable, "-m", "hineus_cli", "run", str(photos), "--workspace", str(workspace)]
    words += [] if poses is None else ["--poses", str(poses)]
    words += ["--blocks", str(blocks), "--jobs", str(jobs), "--workers", "1", "--device", "cpu"]
    return [*words, *(word for each in sets for word in ("--set", each))]


def run(words: Sequence[str], log: Path, seconds: float | None = None) -> float:
    """Seconds it took; killed with all that it has begun after `seconds`.

    Raises:
        RuntimeError: it failed by itself.
    """
    began = time.monotonic()
    with log.open("ab") as said:
        process = subprocess.Popen(words, stdout=said, stderr=said, stdin=subprocess.DEVNULL, start_new_session=True)
        try:
            if process.wait(seconds):
                raise RuntimeError(f"exit code {process.returncode}: see {log}")
        except subprocess.TimeoutExpired:
            below = psutil.Process(process.pid).children(recursive=True)
            for each in (process.pid, *(child.pid for child in below)):
                try:
                    os.kill(each, signal.SIGKILL)
                except ProcessLookupError:
                    continue
            process.wait()
    return time.monotonic() - began


def at_work(workspace: Path) -> str:
    """What the last line of the run's log, or of a block's, is about."""
    logs = sorted(workspace.rglob("*.log"), key=lambda path: path.stat().st_mtime)
    lines = logs[-1].read_text(errors="replace").splitlines() if logs else []
    return f"{logs[-1].relative_to(workspace)}: {lines[-1][:100]}" if lines else "before anything was said"


def hashes(workspace: Path) -> dict[str, str]:
    """Of what is compared in each block."""
    return {
        str(path.relative_to(workspace)): hashlib.sha256(path.read_bytes()).hexdigest()[:12]
        for block in sorted((workspace / "blocks").glob("b*"))
        for name in COMPARED
        if (path := block / name).exists()
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", type=Path)
    parser.add_argument(
        "--poses", type=Path, help="as of hineus run: else most kills strike while poses are searched for"
    )
    parser.add_argument("--blocks", type=int, default=2)
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--set", action="append", default=[], dest="sets", help="as of hineus run")
    wanted = parser.parse_args()
    os.environ.update(OMP_NUM_THREADS="1", NUMBA_NUM_THREADS="1")
    places = [wanted.photos.with_name(f"{wanted.photos.name}_{name}") for name in ("undisturbed", "killed")]
    for place in places:
        shutil.rmtree(place, ignore_errors=True)
    words = [command(wanted.photos, place, wanted.poses, wanted.blocks, wanted.jobs, wanted.sets) for place in places]
    logs = [place.with_name(f"{place.name}.log") for place in places]
    whole = run(words[0], logs[0])
    print(f"undisturbed: {whole:.0f} s", flush=True)
    draw = random.Random(wanted.seed)
    for number in range(wanted.kills):
        took = run(words[1], logs[1], draw.uniform(*SHARES) * whole)
        print(f"kill {number + 1} after {took:.0f} s, at {at_work(places[1])}", flush=True)
    print(f"to the end: {run(words[1], logs[1]):.0f} s", flush=True)
    true, found = (hashes(place) for place in places)
    for name, value in true.items():
        print(f"{name}: {'the same' if found.get(name) == value else 'OTHER'}")
    return 0 if true and true == found else 1


if __name__ == "__main__":
    sys.exit(main())
