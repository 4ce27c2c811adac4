"""Every way in which a stranger's file or words come into the program: what is wrong with it, and the commands.

An entry point draws a wrong input, lays it into an empty folder and says the commands that are to be tried on it.
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hypothesis import strategies as st
from hypothesis.strategies import DrawFn, SearchStrategy
from mutations import NUMBERS, WORDS, encoded, wrong_bytes, wrong_text, wrong_tree
from tiny import RELIGHTABLE, RUN, STAGES, WITHIN_S, Tiny, make_up_materials
from trust_runs import SECONDS

from stages.engine.manifest import describe_outputs, load_manifest

Commands = Sequence[Sequence[str]]
TAKING_IN = ("-w", "w", "--until", "ingest", *RUN)


@dataclass(frozen=True)
class EntryPoint:
    """One kind of input.

    Attributes:
        share: its part of all inputs, relative to the others'.
        lay: draws an input into a folder, and gives the commands to try there.
        seconds: that a command may take.
        first: called in the command's process before it.
    """

    name: str
    share: int
    lay: Callable[[DrawFn, Tiny, Path], Commands]
    seconds: float = SECONDS
    first: Callable[[], None] | None = None


def wrong_file(draw: DrawFn, valid: Path, place: Path) -> None:
    """A file made wrong in the way of its kind: JSON as a tree or as text, tables as text, all else as bytes."""
    if valid.suffix == ".json" and draw(st.booleans()):
        place.write_bytes(encoded(draw(wrong_tree(json.loads(valid.read_text())))))
    elif valid.suffix in (".json", ".txt", ".csv", ".yaml", ".obj", ".off", ".xyz") and draw(st.integers(0, 4)):
        place.write_bytes(encoded(draw(wrong_text(valid.read_text()))))
    else:
        place.write_bytes(draw(wrong_bytes(valid.read_bytes())))


def some_photos(tiny: Tiny, folder: Path, count: int = 4) -> None:
    """Good photos in `folder`/p."""
    (folder / "p").mkdir()
    for photo in sorted(tiny.photos.iterdir())[:count]:
        os.link(photo, folder / "p" / photo.name)


# ---------------------------------------------------------------- settings and words
def _config(draw: DrawFn, tiny: Tiny, folder: Path) -> Commands:
    wrong_file(draw, tiny.input("config.yaml"), folder / "c.yaml")
    return [["config", "--config", "c.yaml"]]


def _setting(draw: DrawFn, tiny: Tiny, folder: Path) -> Commands:
    import yaml

    sections = yaml.safe_load(tiny.input("config.yaml").read_text())
    name, value = [], sections
    while isinstance(value, dict) and value and draw(st.integers(0, 9)):
        name.append(draw(st.sampled_from(sorted(value))))
        value = value[name[-1]]
    return [["config", "--set", f"{'.'.join(name)}={draw(_word)}".replace("\x00", "")]]


def _words(draw: DrawFn, tiny: Tiny, folder: Path) -> Commands:
    some_photos(tiny, folder)
    options = ("--region", "--time", "--hold-out", "--preset", "--device", "--workers", "--up", "--masks", "--poses",
               "--control", "--light", "--from", "--until", "--force", "-w", "--config")  # fmt: skip
    command = draw(st.sampled_from(("run", "check", "status", "config", "view", "evaluate", "no\x1b[31mne")))
    words = [command, *(("p", *TAKING_IN) if command == "run" else ())]
    for _ in range(draw(st.integers(1, 2))):
        words += [draw(st.sampled_from(options)), draw(_word)]
    return [[word.replace("\x00", "") for word in words]]


# ---------------------------------------------------------------- what cameras and people make
def _photo(draw: DrawFn, tiny: Tiny, folder: Path) -> Commands:
    some_photos(tiny, folder)
    valid = tiny.input(f"photo.{draw(st.sampled_from(('jpg', 'png', 'tif', 'webp', 'bmp', 'heic', 'avif')))}")
    wrong_file(draw, valid, folder / "p" / f"wrong.{draw(st.sampled_from((valid.suffix[1:], 'jpg')))}")
    return [["check", "p"], ["run", "p", *TAKING_IN]]


def _odd_file(draw: DrawFn, tiny: Tiny, folder: Path) -> Commands:
    some_photos(tiny, folder)
    name = (
        draw(_word)
        .replace("/", "_")
        .replace("\x00", "")
        .encode("utf-8", "surrogatepass")[:200]
        .decode("utf-8", "surrogateescape")
    )
    place = os.fsencode(folder / "p") + b"/" + os.fsencode(f"{name}.jpg" if name not in (".", "..") else "x.jpg")
    kind = draw(st.sampled_from(("photo", "empty", "fifo", "dangling", "loop", "folder", "device", "text")))
    if kind == "photo":
        shutil.copy(os.fsencode(tiny.input("photo.jpg")), place)
    elif kind in ("empty", "text"):
        with open(place, "wb") as stream:
            stream.write(b"" if kind == "empty" else b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 9 9\n")
    elif kind == "fifo":
        os.mkfifo(place)
    elif kind == "folder":
        os.mkdir(place)
    else:
        targets = {"dangling": b"/nonexistent", "loop": place, "device": b"/dev/zero"}
        os.symlink(targets[kind], place)
    return [["check", "p"], ["run", "p", *TAKING_IN]]


def _masks(draw: DrawFn, tiny: Tiny, folder: Path) -> Commands:
    some_photos(tiny, folder)
    (folder / "m").mkdir()
    for photo in sorted((folder / "p").iterdir()):
        if draw(st.integers(0, 3)):
            shutil.copy(tiny.input("mask.png"), folder / "m" / f"{photo.stem}.png")
        else:
            wrong_file(draw, tiny.input("mask.png"), folder / "m" / f"{photo.stem}.png")
    return [["run", "p", "--masks", "m", *TAKING_IN]]


def _video(draw: DrawFn, tiny: Tiny, folder: Path) -> Commands:
    name = f"v.{draw(st.sampled_from(('mp4', 'mov', 'mkv', 'avi')))}"
    if draw(st.integers(0, 9)):
        wrong_file(draw, tiny.input("video.mp4"), folder / name)
    else:
        (folder / name).write_text(
            draw(st.sampled_from(("#EXTM3U\n#EXTINF:1,\n/etc/passwd\n", "ffconcat version 1.0\nfile /etc/passwd\n")))
        )
    return [["run", name, *TAKING_IN]]


def _poses(draw: DrawFn, tiny: Tiny, folder: Path) -> Commands:
    kind = draw(st.sampled_from(("transforms.json", "transforms.json", "cameras_sphere.npz", "text", "binary")))
    if not tiny.input(kind).is_dir():
        wrong_file(draw, tiny.input(kind), folder / kind)
    else:
        shutil.copytree(tiny.input(kind), folder / kind)
        wrong = draw(st.sampled_from(sorted(file.name for file in (folder / kind).iterdir())))
        wrong_file(draw, tiny.input(kind) / wrong, folder / kind / wrong)
    return [["run", str(tiny.photos), "--poses", kind, *TAKING_IN]]


def _control(draw: DrawFn, tiny: Tiny, folder: Path) -> Commands:
    name = draw(st.sampled_from(("control.csv", "gcp_list.txt")))
    wrong_file(draw, tiny.input(name), folder / name)
    return [["run", str(tiny.photos), "--control", name, *TAKING_IN]]


def _mesh(draw: DrawFn, tiny: Tiny, folder: Path) -> Commands:
    name = draw(
        st.sampled_from(
            ("mesh.ply", "ascii.ply", "cloud.ply", "mesh.stl", "mesh.obj", "mesh.glb", "mesh.off", "cloud.xyz")
        )
    )
    wrong_file(draw, tiny.input(name), folder / name)
    few = ("--samples", "2000")
    return [
        ["evaluate", "mesh", name, str(tiny.input("mesh.ply")), *few],
        ["evaluate", "mesh", str(tiny.input("mesh.ply")), name, *few],
    ]


def _matrix(draw: DrawFn, tiny: Tiny, folder: Path) -> Commands:
    wrong_file(draw, tiny.input("matrix.txt"), folder / "m.txt")
    mesh = str(tiny.input("mesh.ply"))
    return [["evaluate", "mesh", mesh, mesh, "--matrix", "m.txt", "--samples", "2000"]]


def _light(draw: DrawFn, tiny: Tiny, folder: Path) -> Commands:
    name = draw(st.sampled_from(("flat.hdr", "runs.hdr", "light.exr")))
    wrong_file(draw, tiny.input(name), folder / name)
    return [["relight", str(tiny.workspace), "--light", name, "--out", "a.png", "--size", "32x32"]]


def _path(draw: DrawFn, tiny: Tiny, folder: Path) -> Commands:
    wrong_file(draw, tiny.input("transforms.json"), folder / "path.json")
    return [["render", str(tiny.workspace), "--path", "path.json", "--out", "a.png", "--size", "32x32"]]


# ---------------------------------------------------------------- a workspace of someone else, or damaged
def _record(draw: DrawFn, tiny: Tiny, folder: Path) -> Commands:
    shutil.copytree(tiny.workspace, folder / "w")
    records = ["workspace.json", "config.yaml", *(f"{stage}/manifest.json" for stage in STAGES)]
    name = draw(st.sampled_from(records))
    (folder / "w" / name).unlink()
    wrong_file(draw, tiny.workspace / name, folder / "w" / name)
    return [["status", "-w", "w"], ["run", "-w", "w", "--until", "ingest", *RUN]]


def _artifact(draw: DrawFn, tiny: Tiny, folder: Path) -> Commands:
    """A stage runs on what another one left, which is damaged: at equal size half of the time, which is not seen."""
    shutil.copytree(tiny.workspace, folder / "w")
    left = [
        [file for file in sorted((tiny.workspace / name).rglob("*")) if file.is_file() and file.name != "manifest.json"]
        for name in STAGES[:-1]
    ]
    i = draw(st.sampled_from([i for i, files in enumerate(left) if files]))  # not all leave something
    valid = draw(st.sampled_from(left[i]))
    place = folder / "w" / valid.relative_to(tiny.workspace)
    place.unlink()
    wrong_file(draw, valid, place)
    if draw(st.booleans()):
        size = valid.stat().st_size
        place.write_bytes(place.read_bytes()[:size].ljust(size, b"\0"))
    after = STAGES[draw(st.integers(i + 1, len(STAGES) - 1))]
    return [["run", str(tiny.photos), "-w", "w", "--from", after, "--until", after, *RUN]]


def _materials(draw: DrawFn, tiny: Tiny, folder: Path) -> Commands:
    """What is drawn, exported and shown; half of the time it says itself that it is as it was published."""
    shutil.copytree(tiny.relightable, folder / "w")
    stage = folder / "w" / "materials"
    name = draw(st.sampled_from(("base_color.png", "orm.png", "known.png", "light.exr", "light.hdr", "light.json")))
    (stage / name).unlink()
    wrong_file(draw, tiny.relightable / "materials" / name, stage / name)
    if draw(st.booleans()):
        manifest = load_manifest(stage)
        (stage / "manifest.json").unlink()
        outputs = {**manifest.outputs, **describe_outputs(stage)}
        (stage / "manifest.json").write_text(replace(manifest, outputs=outputs).to_json(sealed=True))
    run = ("run", str(tiny.photos), "-w", "w", *RUN, *RELIGHTABLE)
    return [
        ["relight", "w", "--light", "learned", "--out", "a.png", "--size", "32x32"],
        [*run, "--from", "export", "--until", draw(st.sampled_from(("export", "report")))],
    ]


_word: SearchStrategy[Any] = st.sampled_from((*NUMBERS, *WORDS, "[1, 2", "{a: 1}", "- 1", "1, 2, 3", "0.0"))

ENTRY_POINTS = (
    EntryPoint("settings file", 12, _config),
    EntryPoint("--set", 10, _setting),
    EntryPoint("options", 10, _words),
    EntryPoint("photo", 14, _photo),
    EntryPoint("file among photos", 6, _odd_file),
    EntryPoint("masks", 6, _masks),
    EntryPoint("video", 6, _video),
    EntryPoint("poses", 14, _poses),
    EntryPoint("control points", 6, _control),
    EntryPoint("mesh", 12, _mesh),
    EntryPoint("matrix", 3, _matrix),
    EntryPoint("light", 6, _light),
    EntryPoint("path of a film", 6, _path),
    EntryPoint("record of a workspace", 8, _record),
    EntryPoint("artifact of a stage", 6, _artifact, WITHIN_S),
    EntryPoint("materials of a workspace", 2, _materials, first=make_up_materials),
)


def wrong_inputs(entry: EntryPoint, tiny: Tiny, folder: Callable[[], Path]) -> SearchStrategy[tuple[Path, Commands]]:
    """Folders, each with one wrong input, and the commands to try there."""

    @st.composite
    def laid(draw: DrawFn) -> tuple[Path, Commands]:
        place = folder()
        return place, entry.lay(draw, tiny, place)

    return laid()
