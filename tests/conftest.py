"""Shared by all tests: `--check-shapes`, and where development data may lie. Nothing fails where it is absent."""

from __future__ import annotations

import builtins
from pathlib import Path

import pytest
from hypothesis import settings

# The same examples every time, and no test fails for being slow on a busy machine.
settings.register_profile("project", deadline=None, derandomize=True)
settings.load_profile("project")

ROOT = Path(__file__).parents[1]
DATA = ROOT.parent / "shared" / "data"

# numba and Triton compile these, and take no wrapped functions.
COMPILED = ("kernels", "encoding_cuda")
NEURAL = sorted(path.stem for path in (ROOT / "stages" / "neural").glob("*.py") if path.stem not in COMPILED)
SHAPED = ("stages.geometry", *(f"stages.neural.{module}" for module in NEURAL))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--check-shapes", action="store_true", help="check types and shapes of geometry and neural")


def pytest_configure(config: pytest.Config) -> None:
    """Install the checks before any test imports what they check."""
    if not config.getoption("--check-shapes"):
        return
    import jaxtyping

    # The modules import these names for the type checker only: annotations, which are strings, find them here.
    names = ("Bool", "Float", "Float32", "Float64", "Int", "Integer", "Shaped", "UInt8")
    vars(builtins).update({name: getattr(jaxtyping, name) for name in names})
    # With the numeric tower of PEP 484: an int may be given for a float.
    jaxtyping.install_import_hook(SHAPED, "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    if not DATA.is_dir():
        pytest.skip("development photo sets are not on this machine")
    return DATA
