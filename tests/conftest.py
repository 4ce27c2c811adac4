"""Shared by all tests: where development data may lie. Nothing fails where it is absent."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import settings

# The same examples every time, and no test fails for being slow on a busy machine.
settings.register_profile("project", deadline=None, derandomize=True)
settings.load_profile("project")

DATA = Path(__file__).parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def data_dir() -> Path:
    if not DATA.is_dir():
        pytest.skip("development photo sets are not on this machine")
    return DATA
