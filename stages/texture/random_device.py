"""C++ libraries that seed themselves from `std::random_device` made to give the same result twice."""

from __future__ import annotations

import ctypes
import mmap
import platform
import sys

# `return 1`, as the processors read it: mov eax, 1; ret and mov w0, 1; ret.
RETURN_ONE = {"x86_64": b"\xb8\x01\x00\x00\x00\xc3", "aarch64": b"\x20\x00\x80\x52\xc0\x03\x5f\xd6"}
# std::random_device::_M_getval() of GNU's C++ library, which all libraries of a process share.
SYMBOL = "_ZNSt13random_device9_M_getvalEv"


def answer_always_one() -> bool:
    """Let `std::random_device` say 1 for the rest of this process; False where that is not known how to do.

    The function's first bytes are overwritten, for there is no other way in: what seeds itself from it takes no seed.
    Only for a process whose one job that is, never for one that keeps secrets.
    """
    code = RETURN_ONE.get(platform.machine())
    if code is None or not sys.platform.startswith("linux"):
        return False
    try:
        function = getattr(ctypes.CDLL("libstdc++.so.6"), SYMBOL)
        protect = ctypes.CDLL(None, use_errno=True).mprotect
    except (OSError, AttributeError):
        return False
    address = ctypes.cast(function, ctypes.c_void_p).value or 0
    start = address - address % mmap.PAGESIZE
    place = ctypes.c_void_p(start), ctypes.c_size_t(address + len(code) - start)
    if protect(*place, mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC) != 0:
        return False  # a hardened system
    ctypes.memmove(address, code, len(code))
    return protect(*place, mmap.PROT_READ | mmap.PROT_EXEC) == 0
