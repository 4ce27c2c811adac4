"""A limit of memory: where a smaller block does, the work goes on with it."""

from __future__ import annotations

import resource
from pathlib import Path

import psutil
import pytest
from tiny import STAGES, Tiny

pytestmark = pytest.mark.slow

LEFT_BYTES = 420 << 20  # beside what is mapped when the command starts: enough for a quarter of the rays
TOO_MANY_RAYS = ["--set", "train.sampling.rays=8192", "--set", "train.steps=2"]


def limit_address_space() -> None:
    """As `ulimit -v` does."""
    limit = psutil.Process().memory_info().vms + LEFT_BYTES
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def test_training_renders_as_many_rays_at_once_as_fit(tiny: Tiny, tmp_path: Path):
    workspace = tiny.begun(tmp_path / "w", STAGES[: STAGES.index("train")])
    ended = tiny.run(workspace, "--until", "train", *TOO_MANY_RAYS, first=limit_address_space)
    assert ended.code == 0, ended.output
    assert "Memory ran out with 8192 at once (rays of a training step): it goes on with 4096." in ended.output
    assert (workspace / "train" / "manifest.json").exists()
