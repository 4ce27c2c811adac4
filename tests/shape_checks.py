"""`pytest --check-shapes`: every call of what has shapes in its types is checked against them (jaxtyping, beartype)."""

from __future__ import annotations

import builtins
import pkgutil
from pathlib import Path

import jaxtyping

STAGES = Path(__file__).parents[1] / "stages"
# numba and Triton compile these, and take no wrapped functions.
COMPILED = ("stages.neural.kernels", "stages.neural.encoding_cuda")
# The modules import these names for the type checker only. Annotations are strings, which find them here.
NAMES = ("Bool", "Float", "Float32", "Float64", "Int", "Int64", "Integer", "Shaped", "UInt8")
# With the numeric tower of PEP 484: an int may be given for a float.
CHECKER = "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))"


def checked_modules() -> list[str]:
    """Modules of geometry and neural; none is imported."""
    folders = [(str(STAGES / room), f"stages.{room}.") for room in ("geometry", "neural")]
    modules = [module.name for folder, prefix in folders for module in pkgutil.iter_modules([folder], prefix)]
    return [module for module in modules if module not in COMPILED]


def install() -> None:
    """From now on; what is imported already stays unchecked."""
    vars(builtins).update({name: getattr(jaxtyping, name) for name in NAMES})
    jaxtyping.install_import_hook(checked_modules(), CHECKER)
