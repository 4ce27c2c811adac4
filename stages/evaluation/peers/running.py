"""Other methods on the same photos and poses: built-in ones, and any command that writes a mesh.

A command gets `{photos}` (undistorted), `{model}` (a COLMAP model of pinhole cameras with points), `{masks}` (a folder,
which may be missing) and must write its mesh, in the frame of the model, to `{out}`, a PLY. Each runs in a process and
a folder of its own, and is timed.
"""

from __future__ import annotations

import contextlib
import shlex
import shutil
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil

from stages import artifacts, children
from stages.engine.resources import children_cpu_seconds
from stages.errors import ConfigError, ReconstructionError, did_you_mean
from stages.evaluation.machine import machine
from stages.evaluation.peers import builtin
from stages.posing.exporting import SPARSE

MESH, LOG = "mesh.ply", "output.log"
# Seconds between looks at its memory: many at first, for a command that soon ends.
FIRST_SAMPLE_S, SAMPLE_EVERY_S = 0.002, 0.1
TOLD = 400  # characters of a failed command's output that are repeated


@dataclass(frozen=True)
class Peer:
    """A method to compare with.

    Attributes:
        name: in tables and files.
        words: of its command, with placeholders.
        given: the command as it was given; empty for those that are built in.
    """

    name: str
    words: tuple[str, ...]
    given: tuple[str, ...] = ()


def parse_peer(text: str) -> Peer:
    """A built-in peer's name, or NAME=COMMAND.

    Raises:
        ConfigError: it is neither, or the command never says where to write.
    """
    name, equals, command = (part.strip() for part in text.partition("="))
    if not equals:
        if name not in builtin.PEERS:
            guess = did_you_mean(name, builtin.PEERS, "--peer {}")
            raise ConfigError(
                f"There is no built-in peer '{name}'.",
                f"{guess}Those are {', '.join(builtin.PEERS)}; others by command: `--peer 'NAME=COMMAND {{out}}'`.",
            )
        return Peer(name, tuple(children.module_command(builtin.__name__, name, "{photos}", "{model}", "{out}")))
    try:
        words = tuple(shlex.split(command))
    except ValueError as error:
        raise ConfigError(f"--peer {text}: {error}.", "Quote the command for the shell.") from error
    if not name.replace("-", "_").isidentifier() or "{out}" not in command:
        raise ConfigError(
            f"--peer {text} is not of the form NAME=COMMAND, with a plain name and {{out}} in the command.",
            "For example `--peer 'openmvs=./openmvs.sh {photos} {model} {out}'`.",
        )
    return Peer(name, words, words)


def run_peer(peer: Peer, given: Path, folder: Path) -> dict[str, Any]:
    """Run a peer on `given`, what `export-colmap` writes; its mesh is `folder/mesh.ply`.

    Returns:
        Wall and CPU seconds, peak memory in bytes, the machine, the command as it was given,
        and the number of photos.

    Raises:
        ReconstructionError: it failed, or wrote no mesh; its last words are included.
    """
    given, folder = given.resolve(), folder.resolve()  # the command runs elsewhere
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    places = {
        "photos": given / artifacts.IMAGES,
        "model": given / SPARSE,
        "masks": given / artifacts.MASKS,
        "out": folder / MESH,
    }
    words = [_filled(word, places) for word in peer.words]
    started, before = time.monotonic(), children_cpu_seconds()
    code, peak_rss = _call(words, folder, peer.name)
    wall_s, cpu_s = time.monotonic() - started, children_cpu_seconds() - before
    if code != 0 or not (folder / MESH).is_file():
        said = " ".join((folder / LOG).read_text(encoding="utf-8", errors="replace").split())[-TOLD:]
        what = f"ended with {code}" if code else f"wrote no {MESH}"
        raise ReconstructionError(f"Peer {peer.name} {what}: {said or 'it said nothing'}", f"See {folder / LOG}.")
    return {
        "wall_s": round(wall_s, 2),
        "cpu_s": round(cpu_s, 2),
        "peak_rss": peak_rss,
        "machine": machine(),
        "command": shlex.join(peer.given),
        "photos": sum(path.is_file() for path in places["photos"].rglob("*")),
    }


def _call(words: list[str], folder: Path, name: str) -> tuple[int, int]:
    """Exit code of a command, and the most memory in bytes that it and its children held at once, by samples.

    The command runs in `folder`, where it may leave other files; what it says goes to a file there.
    """
    with (folder / LOG).open("wb") as output:
        try:
            process = subprocess.Popen(words, cwd=folder, stdout=output, stderr=subprocess.STDOUT)
        except OSError as error:
            raise ReconstructionError(
                f"Peer {name} could not be started: {words[0]}: {error.strerror}.", "Name the program's full path."
            ) from error
        peak_rss, pause_s = 0, FIRST_SAMPLE_S
        try:
            while True:
                peak_rss = max(peak_rss, _held_by(process.pid))
                with contextlib.suppress(subprocess.TimeoutExpired):
                    return process.wait(pause_s), peak_rss
                pause_s = min(2 * pause_s, SAMPLE_EVERY_S)
        except BaseException:  # it is not to outlive us
            process.kill()
            process.wait()
            raise


def _held_by(pid: int) -> int:
    """Resident memory in bytes of a process and its children. The kernel's own peak would count ours: it was forked."""
    total = 0
    with contextlib.suppress(psutil.Error):  # it has ended
        process = psutil.Process(pid)
        for each in (process, *process.children(recursive=True)):
            with contextlib.suppress(psutil.Error):
                total += each.memory_info().rss
    return total


def _filled(word: str, places: dict[str, Path]) -> str:
    for name, place in places.items():
        word = word.replace(f"{{{name}}}", str(place))
    return word
