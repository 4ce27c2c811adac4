"""Numba, with a cache of compiled code that can be written; all modules with kernels take it from here.

The folder of the package need not be writable. `NUMBA_CACHE_DIR` chooses another place.
"""

from pathlib import Path

from stages.errors import InputError

# Numba would take settings from there, and the current folder may be somebody else's.
SETTINGS = Path(".numba_config.yaml")
if SETTINGS.exists():
    raise InputError(
        f"Numba would take its settings from {SETTINGS.absolute()}, which may be somebody else's.",
        "Go to another folder, or remove that file and set NUMBA_... variables instead.",
    )

import numba
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

from stages.caches import compiler_folder

# Beside the variable, which numba reads again only when the environment changes.
numba.config.CACHE_DIR = str(compiler_folder("NUMBA_CACHE_DIR", "numba"))

# What LLVM's prefetch is told: the line is to be read (that of what is written comes as fast), kept, and no code.
_READ, _KEEP, _DATA = 0, 3, 1

njit, prange, uint32 = numba.njit, numba.prange, numba.uint32


@intrinsic
def prefetch_row(_, array, row):
    """Ask for the cache line where `array[row]` begins, and go on: memory answers while other rows are worked on.

    row: uint32. Nothing is read, so that a row outside the array does no harm.
    """

    def generate(context, builder, signature, arguments):
        view = context.make_array(signature.args[0])(context, builder, arguments[0])
        stride = builder.extract_value(view.strides, 0)
        place = builder.mul(builder.zext(arguments[1], ir.IntType(64)), stride)
        byte = ir.IntType(8).as_pointer()
        address = builder.gep(builder.bitcast(view.data, byte), [place])
        flag = ir.IntType(32)
        signature_of_prefetch = ir.FunctionType(ir.VoidType(), [byte, flag, flag, flag])
        prefetch = builder.module.declare_intrinsic("llvm.prefetch", [byte], signature_of_prefetch)
        builder.call(prefetch, [address, flag(_READ), flag(_KEEP), flag(_DATA)])

    return types.void(array, row), generate
