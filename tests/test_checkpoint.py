"""Checkpoints: what was written is read, and what was damaged is neither read nor run."""

from __future__ import annotations

import os
import pickle
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from stages.engine.checkpoint import CheckpointDamaged, read_checkpoint, set_aside, write_checkpoint

STATE = {"weights": torch.arange(300.0), "groups": [{"lr": 0.1}], "step": 3, "region": None, "metrics": "a line\n"}


class Calls:
    """A pickle that makes a file where it is loaded."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> tuple[Any, ...]:
        return Path.touch, (self.file,)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "checkpoint.pt"
    write_checkpoint(path, STATE)
    return path


def same(found: Any) -> bool:
    return torch.equal(found["weights"], STATE["weights"]) and all(
        found[key] == STATE[key] for key in ("step", "groups")
    )


def test_what_was_written_is_read(path: Path) -> None:
    found = read_checkpoint(path)
    assert found.keys() == STATE.keys()
    assert same(found)
    assert os.listdir(path.parent) == [path.name]
    assert read_checkpoint(path.with_name("none")) is None


def test_no_flipped_byte_changes_what_is_read(path: Path) -> None:
    content = path.read_bytes()
    noticed = 0
    for i in range(0, len(content), 23):
        path.write_bytes(content[:i] + bytes([content[i] ^ 1 << i % 8]) + content[i + 1 :])
        try:
            assert same(read_checkpoint(path))  # padding, times
        except CheckpointDamaged:
            noticed += 1
    assert noticed > len(content) / 23 / 2


def packed(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", bytes(1 << 20))


def instead(make: Callable[[Path], Any]) -> Callable[[Path], Any]:
    def damage(path: Path) -> None:
        path.unlink()
        make(path)

    return damage


DAMAGES: dict[str, Callable[[Path], Any]] = {
    "cut at its end": lambda path: os.truncate(path, path.stat().st_size - 1),
    "half": lambda path: os.truncate(path, path.stat().st_size // 2),
    "empty": lambda path: os.truncate(path, 0),
    "noise": lambda path: path.write_bytes(bytes(range(256)) * 9),
    "pickle": lambda path: path.write_bytes(pickle.dumps({})),
    "code": lambda path: torch.save(Calls(path.with_name("run")), path),
    "code of old": lambda path: torch.save(Calls(path.with_name("run")), path, _use_new_zipfile_serialization=False),
    "compressed": packed,
    "folder": instead(Path.mkdir),
    "link": instead(lambda path: path.symlink_to("/dev/zero")),
    "dangling link": instead(lambda path: path.symlink_to("nowhere")),
    "pipe": instead(lambda path: os.mkfifo(path)),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_is_told_set_aside_and_replaced(
    path: Path, damage: str, caplog: pytest.LogCaptureFixture
) -> None:
    DAMAGES[damage](path)
    with pytest.raises(CheckpointDamaged) as caught:
        read_checkpoint(path)
    assert "\n" not in str(caught.value)
    assert not path.with_name("run").exists()
    aside = path.with_name("checkpoint.pt.damaged")
    aside.mkdir()  # of the last time
    (aside / "file").touch()
    set_aside(path, str(caught.value))
    assert caplog.messages == [
        f"the checkpoint is damaged ({caught.value}): its stage starts over; it is kept as {aside}"
    ]
    assert os.path.lexists(aside)
    assert read_checkpoint(path) is None
    path.with_name("checkpoint.pt.tmp").mkdir()  # in the way of the next one
    write_checkpoint(path, STATE)
    assert same(read_checkpoint(path))
