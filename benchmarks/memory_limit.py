"""A limit of memory in which one process cannot hold all photos: does it fail with a word, and do blocks finish?

python -m benchmarks.synthetic DATA --scenes town16 --photos 640 --size 320x240 --spp 4
python -m benchmarks.memory_limit DATA/town16 OUT --photos 100 --side 3800 --gib 3.4 --set densify.method=off \\
    --set train.steps=200 --set sfm.max_image_size=320 --set sfm.max_features=1024

In training 100 photos of 3800 x 2850 are 3.0 GiB; all else took 0.76 GiB with the preset tiny beside smaller ones, so
that one process should not have room for them. Dense stereo is off, so that it is photos that count.

Of the photos that look straight down those nearest to the middle are taken, enlarged, with their known poses:
interpolation adds no detail, but memory does not mind. The limit is that of a control group of Linux, as containers and
Slurm set it, which needs root; nothing of it is left. In it `hineus check`, then `hineus run` in one process, then
`hineus run --blocks auto` in the same workspace, which keeps the poses. What is told of each: its exit code, the peak
of its largest process, seconds, and what it said of memory.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from stages.limits import CONTROL_GROUPS

GIB = 1 << 30
DOWN = 0.98  # cosine of the angle to straight down, at least
SCALED = ("w", "h", "fl_x", "fl_y", "cx", "cy")
# Files of both versions of control groups: the limit, and with swap.
LIMITS = (("memory.limit_in_bytes", "memory.memsw.limit_in_bytes"), ("memory.max", "memory.swap.max"))
OF_MEMORY = re.compile(r"memory|Error|blocks of|--blocks", re.IGNORECASE)


def nadir_photos(frames: Sequence[dict[str, Any]], count: int) -> list[dict[str, Any]]:
    """Of the frames (z of the world is up) those that look straight down, nearest to their middle along either axis.

    Raises:
        ValueError: fewer look down.
    """
    poses = np.array([frame["transform_matrix"] for frame in frames])
    down = np.flatnonzero(poses[:, 2, 2] > DOWN)  # OpenGL's cameras look along -z
    if len(down) < count:
        raise ValueError(f"{len(down)} photos look down, {count} are asked for")
    plan = poses[down, :2, 3]
    away = np.abs(plan - (plan.min(0) + plan.max(0)) / 2).max(1)
    return [frames[i] for i in sorted(down[np.argsort(away, kind="stable")[:count]])]


def enlarge(scene: Path, out: Path, count: int, side: int) -> None:
    """Write photos with `side` pixels along their longer side, and their poses, to `out`."""
    import cv2

    record = json.loads((scene / "transforms.json").read_text())
    record["frames"] = nadir_photos(record["frames"], count)
    factor = side / max(record["w"], record["h"])
    record |= {key: record[key] * factor for key in SCALED} | {"w": side, "h": round(record["h"] * factor)}
    (out / "images").mkdir(parents=True, exist_ok=True)
    for frame in record["frames"]:
        photo = cv2.imread(str(scene / frame["file_path"]))
        large = cv2.resize(photo, (record["w"], record["h"]), interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(str(out / frame["file_path"]), large, [cv2.IMWRITE_JPEG_QUALITY, 90])
    (out / "transforms.json").write_text(json.dumps(record))


@contextmanager
def memory_group(limit: int) -> Iterator[Path]:
    """A control group whose processes may take `limit` bytes together.

    Raises:
        OSError: none can be made.
    """
    first = CONTROL_GROUPS / "memory"
    (limit_file, swap_file), top = (LIMITS[0], first) if first.is_dir() else (LIMITS[1], CONTROL_GROUPS)
    group = top / f"hineus_{os.getpid()}"
    group.mkdir()
    try:
        (group / limit_file).write_text(str(limit))
        with suppress(OSError):  # a system without swap
            (group / swap_file).write_text(str(limit) if first.is_dir() else "0")
        yield group
    finally:
        group.rmdir()


def run_in(group: Path, words: Sequence[str], log: Path) -> dict[str, object]:
    """What became of a command in the group."""

    def join() -> None:
        (group / "cgroup.procs").write_text(str(os.getpid()))

    start = time.monotonic()
    with log.open("wb") as said:
        process = subprocess.Popen(words, stdout=said, stderr=said, stdin=subprocess.DEVNULL, preexec_fn=join)
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    return {
        "exit code": process.returncode,
        "peak of a process, GiB": round(1024 * used.ru_maxrss / GIB, 2),
        "CPU s": round(used.ru_utime + used.ru_stime),
        "wall s": round(time.monotonic() - start),
        "said": [line for line in log.read_text(errors="replace").splitlines() if OF_MEMORY.search(line)],
    }


def peaks(folder: Path, without: str = "") -> dict[str, float]:
    """GiB by stage: the highest of all workspaces in a folder, but for those in a folder `without`."""
    found: dict[str, float] = {}
    for path in folder.rglob("manifest.json"):
        if without not in path.relative_to(folder).parts:
            peak = json.loads(path.read_text())["peak_rss"] / GIB
            found[path.parent.name] = max(found.get(path.parent.name, 0.0), round(peak, 2))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path, help="folder with images/ and transforms.json")
    parser.add_argument(
        "out", type=Path, help="folder for enlarged photos and the workspace, which goes on where it is"
    )
    parser.add_argument("--photos", type=int, default=100)
    parser.add_argument("--side", type=int, default=3800, help="longer side of a photo, pixels, that is kept")
    parser.add_argument("--gib", type=float, default=3.4, help="the limit")
    parser.add_argument("--preset", default="tiny")
    parser.add_argument("--set", action="append", default=[], dest="sets", help="as of hineus run")
    wanted = parser.parse_args()
    enlarge(wanted.scene, wanted.out, wanted.photos, wanted.side)
    photos = [str(wanted.out / "images"), "--poses", str(wanted.out / "transforms.json"), "--preset", wanted.preset]
    photos += ["--workers", "1", "--device", "cpu"]
    photos += [f"--set={stage}.max_side={wanted.side}" for stage in ("ingest", "undistort")]
    photos += [word for each in wanted.sets for word in ("--set", each)]
    hineus = [sys.executable, "-m", "hineus_cli"]
    workspace = wanted.out / "workspace"
    run = ["run", *photos, "--workspace", str(workspace)]
    with memory_group(int(wanted.gib * GIB)) as group:
        for name, words in (("check", ["check", *run[1:]]), ("one", run), ("blocks", [*run, "--blocks", "auto"])):
            print(f"\n{name}", flush=True)
            for what, value in run_in(group, [*hineus, *words], wanted.out / f"{name}.log").items():
                print(f"{what}: {value}", flush=True)
    print(f"\npeak of each stage, GiB, in one: {peaks(workspace, 'blocks')}")
    print(f"the same in blocks: {peaks(workspace / 'blocks')}")
    plan = json.loads((workspace / "blocks" / "plan.json").read_text())
    print(f"photos of each block: {[len(block['photos']) for block in plan['blocks']]}")
    print(f"tiles: {len(list((workspace / 'blocks').glob('*/export/model.glb')))}")


if __name__ == "__main__":
    main()
