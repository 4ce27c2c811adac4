"""Shared by all tests: `--check-shapes`, and where development data may lie. Nothing fails where it is absent."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import settings

# The same examples every time, and no test fails for being slow on a busy machine.
settings.register_profile("project", deadline=None, derandomize=True)
settings.load_profile("project")

DATA = Path(__file__).parents[2] / "shared" / "data"
CASES = DATA.with_name("cases")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--check-shapes", action="store_true", help="check types and shapes of geometry and neural")
    parser.addoption("--whole", action="store_true", help="all of tests/trust, not the share of it that CI runs")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """`tests/trust` forks, so it has a process of its own: see `test_trust.py`."""
    alone = any("trust" in argument for argument in config.args)
    return True if collection_path.name == "trust" and collection_path.is_dir() and not alone else None


def pytest_configure(config: pytest.Config) -> None:
    """Before any test imports what is checked."""
    if config.getoption("--check-shapes"):
        from shape_checks import install

        install()


@pytest.fixture(scope="session")
def data_dir() -> Path:
    if not DATA.is_dir():
        pytest.skip("development photo sets are not on this machine")
    return DATA


@pytest.fixture(scope="session")
def cases_dir() -> Path:
    """Small inputs that other programs' users stumbled over."""
    if not CASES.is_dir():
        pytest.skip("the cases are not on this machine")
    return CASES
