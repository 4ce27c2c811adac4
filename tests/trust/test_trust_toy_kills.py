"""A toy run, killed before each of its calls to the file system: run again, it ends as if it had not been."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from moments import listen
from tiny import files_of
from toy_pipeline import TOY

from configs.load import load_config
from stages.engine.manifest import ManifestDamaged, load_manifest
from stages.engine.runner import run_pipeline
from stages.engine.workspace import Workspace

PIPELINE = TOY[:2]
BEFORE, NOW = (load_config(sets=(f"sfm.max_features={count}00",)) for count in (2, 3))

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not hasattr(os, "fork"), reason="processes are killed as copies of this one"),
]


def run(root: Path, photos: Path) -> set[str]:
    """The stages that ran."""
    outcomes = run_pipeline(PIPELINE, Workspace.open(root, create=True), NOW, {"photos": photos, "masks": None})
    return {outcome.name for outcome in outcomes if outcome.action == "ran"}


def in_child(work: Callable[[], object]) -> int:
    """The exit code of a copy of this process that does this work."""
    child = os.fork()
    if child == 0:
        try:
            work()
            os._exit(0)
        finally:
            os._exit(1)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def killed_at(call: int, torn: bool, root: Path, photos: Path) -> None:
    """A run that ends before this call; `torn`: which opens a file, and that is left half written."""
    heard = iter(range(1 << 30))

    def each(name: str) -> None:
        if next(heard) == call:
            if torn:
                (root / name.removeprefix("open ")).write_text('{"for')
            os._exit(9)

    listen(root, each)
    run(root, photos)


def calls_of(root: Path, photos: Path, notes: Path) -> list[str]:
    with notes.open("w", buffering=1) as file:

        def listening() -> None:
            listen(root, lambda name: print(name, file=file))
            run(root, photos)

        assert in_child(listening) == 0
    return notes.read_text().splitlines()


def write_photo(path: Path, text: str) -> None:
    path.write_text(text)
    os.utime(path, (0, 0))  # else whether its hash is kept depends on the clock


@pytest.fixture(params=["first", "again"])
def start(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """Photos, and a workspace that is absent, or of other photos and settings."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)  # the machine stays up
    photos, base = tmp_path / "photos", tmp_path / "base"
    photos.mkdir()
    write_photo(photos / "0.jpg", "apple")
    if request.param == "again":
        run_pipeline(PIPELINE, Workspace.open(base, create=True), BEFORE, {"photos": photos, "masks": None})
        write_photo(photos / "1.jpg", "banana")
    return photos, base


def test_a_run_killed_anywhere_ends_as_the_unbroken_one(start: tuple[Path, Path], tmp_path: Path) -> None:
    photos, base = start

    def copy(name: str) -> Path:
        return shutil.copytree(base, tmp_path / name) if base.exists() else tmp_path / name

    unbroken = tmp_path / "unbroken"
    calls = calls_of(copy("unbroken"), photos, tmp_path / "calls")
    prints = {stage.name: load_manifest(unbroken / stage.name).identity.fingerprint for stage in PIPELINE}
    assert len(calls) > 20
    for i, call in enumerate(calls):
        for torn in (False, True)[: 1 + call.startswith("open")]:
            where = f"{'in' if torn else 'before'} call {i}, {call}"
            root = copy("killed")
            assert in_child(partial(killed_at, i, torn, root, photos)) == 9, where
            done = {name for name, value in prints.items() if fingerprint(root / name) == value}
            assert run(root, photos).isdisjoint(done), where
            for name in prints:
                assert files_of(root / name) == files_of(unbroken / name), where
            left = [path.name for path in root.rglob("*") if path.suffix == ".tmp" or path.name in ("out", "old")]
            assert left == [], where
            assert not list((root / ".work").glob("*/scratch*")), where
            shutil.rmtree(root)


def fingerprint(folder: Path) -> str:
    try:
        manifest = load_manifest(folder)
    except ManifestDamaged:
        return ""
    return manifest.identity.fingerprint if manifest else ""
