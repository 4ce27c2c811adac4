"""On Linux the command runs in a child of this process, so that somebody is left to tell how it ended.

Where memory runs out, the kernel kills without a word, and C and C++ libraries crash or leave in ways of their own.
This process holds next to nothing in memory, so that it is not the one that is chosen.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable
from contextlib import suppress

from hineus_cli.at_once import CRASHES, SIGNALS, signals_wait

PR_SET_PDEATHSIG = 1
LEFT = 1  # the exit code of a library that ends the process where it gets no memory, as OpenBLAS does
CRASH_EXIT_CODE = 6  # of a SystemRequirementError


def supervised(command: Callable[[], None]) -> None:
    """Call `command`, which ends with SystemExit, in a child, and end with its exit code."""
    if sys.platform != "linux":
        return command()
    us = os.getpid()
    told, tell = os.pipe()
    try:
        with signals_wait():  # until there is somebody to pass them on
            child = os.fork()
            if child:
                _pass_signals_on(child)
    except OSError:  # no more processes are allowed: without a second one it goes as well
        return command()
    if child:
        os.close(tell)
        os._exit(_await(child, told))
    os.close(told)
    _end_with(us)
    try:
        command()
    except SystemExit as end:
        os.write(tell, bytes([end.code if isinstance(end.code, int) else LEFT if end.code else 0]))
        raise


def _end_with(parent: int) -> None:
    """Let the kernel kill this process when its parent is killed, as if they were one."""
    import ctypes

    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(128 + signal.SIGKILL)


def _pass_signals_on(child: int) -> None:
    def pass_on(number: int, frame: object) -> None:
        with suppress(ProcessLookupError):
            os.kill(child, number)

    for number in SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, pass_on)


def _await(child: int, told: int) -> int:
    """The exit code of the child when it has ended, which it has `told` where it was not ended."""
    _, status, used = os.wait4(child, 0)
    if said := os.read(told, 1):
        return said[0]
    code = os.waitstatus_to_exitcode(status)
    if code in (LEFT, *(-number for number in (signal.SIGKILL, *CRASHES))):
        return _tell_of_crash(-code, 1024 * used.ru_maxrss)
    return 128 - code if code < 0 else code


def _tell_of_crash(number: int, peak: int) -> int:
    """Say how the child was ended and how much memory it had taken; the exit code."""
    from stages.engine.workspace import show_bytes
    from stages.limits import total_memory

    if number == signal.SIGKILL:
        how = "was killed (SIGKILL), most probably by the system as memory ran out"
    else:
        name = f" ({signal.Signals(number).name})" if number > 0 else ""
        how = f"was ended by a library that failed{name}, as they do when memory or threads run out"
    message = f"The command {how}: it had taken {show_bytes(peak)}, and {show_bytes(total_memory())} are there."
    hint = (
        "What was finished is kept: run the same command to go on from there, with more memory, or with less to do by "
        "`--workers 1`, `--preset tiny` or, of many photos, `--blocks auto`."
    )
    with suppress(OSError):
        os.write(2, f"Error: {message}\n{hint}\n".encode())
        if "--json" in sys.argv:
            import json

            error = {"type": "SystemRequirementError", "message": message, "hint": hint, "exit_code": CRASH_EXIT_CODE}
            os.write(1, f"{json.dumps({'ok': False, 'error': error})}\n".encode())
    return CRASH_EXIT_CODE
