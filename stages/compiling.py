"""Numba, with a cache of compiled code that can be written; all modules with kernels take it from here.

The folder of the package need not be writable. `NUMBA_CACHE_DIR` chooses another place.
"""

import numba

from stages.caches import compiler_folder

# Beside the variable, which numba reads again only when the environment changes.
numba.config.CACHE_DIR = str(compiler_folder("NUMBA_CACHE_DIR", "numba"))

njit, prange, uint32 = numba.njit, numba.prange, numba.uint32
