"""A disk that is full at any moment: a sentence, what was published stays, and with room the run goes on."""

from __future__ import annotations

import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from tiny import STAGES, Tiny, files_of

from stages.errors import WorkspaceError

pytestmark = pytest.mark.slow

LEVELS = 30
POSED = STAGES[: STAGES.index("extract")]  # are there when a run of the share begins


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of its own, of 64 KB until `grow` makes it larger."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(place)], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip("a file system can only be mounted by root")
    yield place
    subprocess.run(["umount", "-l", str(place)], check=True)


def grow(place: Path, size: int) -> None:
    subprocess.run(["mount", "-o", f"remount,size={size}", str(place)], check=True)


def size_of(folder: Path) -> int:
    """Bytes of all files."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def test_a_disk_that_fills_at_any_level(tiny: Tiny, whole: bool, small_disk: Path):
    """One workspace on a disk that grows level by level: each run goes as far as it comes, and loses nothing."""
    workspace = small_disk / "w"
    needed, there = size_of(tiny.workspace), 0
    if not whole:
        grow(small_disk, 4 * needed)
        tiny.begun(workspace, POSED)
        there = shutil.disk_usage(small_disk).used
        needed -= sum(size_of(workspace / stage) for stage in POSED)
    levels = [64_000 + there + int(1.2 * needed * (i / LEVELS) ** 2) for i in range(LEVELS)]
    finished: set[str] = set()
    for size in levels if whole else levels[2::9]:
        grow(small_disk, size)
        ended = tiny.run(workspace, environment={"TMPDIR": str(small_disk)})
        if ended.code == 0:
            break
        where = f"{size} bytes: {ended.output}"
        assert not ended.fault(), where
        assert ended.code == WorkspaceError.exit_code, where
        assert "full" in ended.output, where
        published = {name for name in STAGES if (workspace / name / "manifest.json").exists()}
        assert finished <= published, where
        finished = published
    grow(small_disk, there + 20 * needed)
    ended = tiny.run(workspace)
    assert not ended.fault(), ended.output
    for name in STAGES:
        assert files_of(workspace / name) == files_of(tiny.workspace / name), name
