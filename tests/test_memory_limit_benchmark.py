"""Which photos the benchmark of a limit of memory takes, and where it sets the limit."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from benchmarks import memory_limit
from benchmarks.memory_limit import memory_group, nadir_photos, peaks


def frame(x: float, y: float, looks_down: bool) -> dict[str, Any]:
    """OpenGL axes, z of the world up: a camera as it is looks along -z, which is down."""
    turn = [[1, 0, 0], [0, 1, 0], [0, 0, 1]] if looks_down else [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    rows = [[*row, place] for row, place in zip(turn, (x, y, 1.0), strict=True)]
    return {"file_path": f"{x} {y}", "transform_matrix": [*rows, [0, 0, 0, 1]]}


def test_photos_that_look_down_are_taken_from_the_middle():
    frames = [frame(x, y, x != 2) for x in range(5) for y in range(5)]
    assert [each["file_path"] for each in nadir_photos(frames, 6)] == ["1 1", "1 2", "1 3", "3 1", "3 2", "3 3"]
    with pytest.raises(ValueError, match="20 photos look down, 21 are asked for"):
        nadir_photos(frames, 21)


@pytest.mark.parametrize(("version", "name"), [(1, "memory.limit_in_bytes"), (2, "memory.max")])
def test_the_limit_is_set_in_either_version_of_control_groups(
    version: int, name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    top = tmp_path / "memory" if version == 1 else tmp_path
    top.mkdir(exist_ok=True)
    monkeypatch.setattr(memory_limit, "CONTROL_GROUPS", tmp_path)
    with memory_group(3 << 30) as group:
        assert group.parent == top
        assert (group / name).read_text() == str(3 << 30)
        for file in group.iterdir():  # the kernel's go with the folder
            file.unlink()
    assert not group.exists()


def test_peaks_are_the_highest_of_all_workspaces(tmp_path: Path):
    for place, gib in (("train", 2), ("blocks/b00/train", 1), ("blocks/b01/train", 3)):
        (tmp_path / place).mkdir(parents=True)
        (tmp_path / place / "manifest.json").write_text(json.dumps({"peak_rss": gib << 30}))
    assert peaks(tmp_path, "blocks") == {"train": 2.0}
    assert peaks(tmp_path / "blocks") == {"train": 3.0}
