"""Memory, threads and open files that run out are told in one sentence, whichever library says so."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest
from toy_pipeline import with_stage

from configs.params import Config
from stages.engine import shortage as shortage_module
from stages.engine.runner import run_pipeline
from stages.engine.shortage import shortage
from stages.engine.stage import StageContext
from stages.engine.workspace import Workspace
from stages.errors import SystemRequirementError
from stages.limits import MemoryBound

BOUNDS = [MemoryBound("this machine", 8_000, 1_000), MemoryBound("`ulimit -v`", 4_000, 3_000, "ulimit -v unlimited")]
ALLOCATION = "an allocation failed"


@pytest.fixture(autouse=True)
def bounds(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shortage_module, "memory_bounds", lambda: iter(BOUNDS))


@pytest.mark.parametrize(
    ("error", "needed"),
    [
        (MemoryError(), ALLOCATION),
        (MemoryError("std::bad_alloc"), ALLOCATION),
        (MemoryError("Unable to allocate 2.00 KiB for an array with shape (256,) and data type float64"), "2.05 KB"),
        (RuntimeError("bad allocation"), ALLOCATION),
        (
            RuntimeError(
                "[enforce fail at alloc_cpu.cpp:118] err == 0. DefaultCPUAllocator: can't allocate memory: you tried "
                "to allocate 5000 bytes. Error code 12 (Cannot allocate memory)"
            ),
            "5 KB",
        ),
        (
            RuntimeError("OpenCV(4.9.0) alloc.cpp:73: error: (-4:Insufficient memory) Failed to allocate 7000 bytes"),
            "7 KB",
        ),
        (OSError(errno.ENOMEM, "Cannot allocate memory"), ALLOCATION),
        (ImportError("libtorch_cpu.so: failed to map segment from shared object"), ALLOCATION),
        (SystemError("error return without exception set"), ALLOCATION),
    ],
)
def test_memory(error: Exception, needed: str) -> None:
    told = shortage(error, "Stage sfm")
    assert told is not None
    assert told.message.startswith(f"Stage sfm ran out of memory: {needed}")
    assert told.message.endswith("and 1 KB of the 4 KB of `ulimit -v` are left.")
    assert "`ulimit -v unlimited`" in told.hint
    assert "--workers 1" in told.hint


def test_the_gpus_memory_is_another() -> None:
    told = shortage(RuntimeError("CUDA out of memory. Tried to allocate 2.00 GiB. GPU 0 has"), "Stage train")
    assert told is not None
    assert told.message == "Stage train ran out of the GPU's memory: 2.15 GB more were needed."
    assert "--device cpu" in told.hint


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (RuntimeError("can't start new thread"), "cannot start another thread"),
        (RuntimeError("Resource temporarily unavailable"), "cannot start another thread"),
        (BlockingIOError(errno.EAGAIN, "Resource temporarily unavailable"), "cannot start another thread"),
        (OSError(errno.EMFILE, "Too many open files", "photo.jpg"), "cannot open another file"),
    ],
)
def test_threads_and_files(error: Exception, said: str) -> None:
    told = shortage(error, "Stage sfm")
    assert told is not None
    assert said in told.message


def test_it_is_found_in_what_caused_the_error() -> None:
    error = RuntimeError("Cannot import the C++ backend.")
    error.__cause__ = ImportError("_core.so: failed to map segment from shared object")
    assert shortage(error, "Stage sfm") is not None
    assert shortage(RuntimeError("no file of this name"), "Stage sfm") is None


# ---------------------------------------------------------------- with less
class Scarce:
    """A stage for which there is memory for one thread only, or for none."""

    def __init__(self, enough_for: int) -> None:
        self.enough_for = enough_for
        self.asked: list[int] = []

    def __call__(self, context: StageContext) -> dict[str, int]:
        self.asked.append(context.workers)
        (context.out / "left").write_text("of the first attempt")
        if context.workers > self.enough_for:
            raise MemoryError
        (context.out / "left").unlink()
        (context.out / "model").mkdir()
        (context.out / "model/poses.txt").write_text("0")
        return {}


def run(folder: Path, stage: Scarce) -> None:
    (folder / "photos").mkdir()
    (folder / "photos/0.jpg").write_text("0")
    workspace = Workspace.open(folder / "w", create=True)
    run_pipeline(
        with_stage("sfm", run=stage), workspace, Config(), {"photos": folder / "photos"}, workers=8, until="sfm"
    )


def test_a_stage_goes_on_with_one_thread(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    stage = Scarce(enough_for=1)
    run(tmp_path, stage)
    assert stage.asked == [8, 1]
    assert "tried once more with one thread in place of 8" in caplog.text
    assert (tmp_path / "w/sfm/model/poses.txt").exists()
    assert not (tmp_path / "w/sfm/left").exists()


def test_where_one_thread_is_too_much_it_is_told(tmp_path: Path) -> None:
    stage = Scarce(enough_for=0)
    with pytest.raises(SystemRequirementError, match="Stage sfm ran out of memory"):
        run(tmp_path, stage)
    assert stage.asked == [8, 1]
