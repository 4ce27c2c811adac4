"""SIGTERM and SIGHUP end a run as Ctrl-C does: with a sentence, a line in the log, and no child left behind.

Python runs its signal handlers between two steps of its main thread, which may be minutes deep in a C++ library. A
thread of ours therefore waits for the same signals and ends the process where that takes too long, or at a second
signal. Nothing is lost by that: stages are published whole, and a run goes on from them.
"""

from __future__ import annotations

import importlib.util
import logging
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib.machinery import ModuleSpec
from types import FrameType, ModuleType
from typing import Any

from stages.engine.run_log import TRACEBACKS

SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
TAKES_SIGTERM = "pycolmap"  # its import installs a handler that prints a C++ stack
GRACE_S = 5.0  # for the main thread to end by itself; half of what `docker stop` and others give before they kill
TELLING_S = 2.0  # the most that telling of it may take, in a terminal that may be gone
GOES_ON = "What was finished is kept: run the same command to go on from there."


class Stopped(KeyboardInterrupt):
    """A signal asked the program to end."""

    def __init__(self, number: int) -> None:
        self.by_ctrl_c = number == signal.SIGINT
        self.exit_code = 128 + number
        super().__init__("Ctrl-C" if self.by_ctrl_c else signal.Signals(number).name)

    @property
    def message(self) -> str:
        return "Stopped." if self.by_ctrl_c else f"Stopped by {self}."


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Inside, the signals raise `Stopped` in the main thread. Those that are ignored, as with `nohup`, stay so."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    heard, told = socket.socketpair()
    told.setblocking(False)
    stopping = threading.Event()

    def stop(number: int, frame: FrameType | None) -> None:
        if not stopping.is_set():
            stopping.set()
            raise Stopped(number)

    before = {number: signal.getsignal(number) for number in SIGNALS}
    ours = [number for number, handler in before.items() if handler != signal.SIG_IGN]

    def take() -> None:
        if threading.current_thread() is threading.main_thread():
            for number in ours:
                signal.signal(number, stop)

    take()
    former = signal.set_wakeup_fd(told.fileno(), warn_on_full_buffer=False)
    finder = _TakingBack(take)
    sys.meta_path.insert(0, finder)
    threading.Thread(target=_watch, args=(heard, told), name="signals", daemon=True).start()
    try:
        yield
    finally:
        with suppress(ValueError):
            sys.meta_path.remove(finder)
        if not stopping.is_set():  # else the watch goes on: what is left to do at the end may take too long, too
            signal.set_wakeup_fd(former)
            for number in ours:
                signal.signal(number, before[number])
            told.close()


class _TakingBack:
    """Calls `take` once the module that takes a signal for itself was imported."""

    def __init__(self, take: Callable[[], None]) -> None:
        self._take = take

    def find_spec(self, name: str, path: Any = None, target: ModuleType | None = None) -> ModuleSpec | None:
        if name != TAKES_SIGTERM:
            return None
        sys.meta_path.remove(self)
        spec = importlib.util.find_spec(name)
        if spec is not None and spec.loader is not None:
            execute = spec.loader.exec_module

            def exec_module(module: ModuleType) -> None:
                execute(module)
                self._take()

            spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec


def _watch(heard: socket.socket, told: socket.socket) -> None:
    """Wait for a first signal; then for the end of the process, a second signal or the end of patience.

    `told` is held so that it is closed by nobody else than the end of `stopped_by_signals`.
    """
    with heard:
        first = heard.recv(1)
        if not first:
            return
        heard.settimeout(GRACE_S)
        with suppress(TimeoutError):
            heard.recv(1)
    _end(Stopped(first[0]))


def _end(stop: Stopped) -> None:
    """End this process at once, and its children."""
    telling = threading.Thread(target=_tell, args=(stop,), daemon=True)
    telling.start()
    telling.join(TELLING_S)
    end_children()
    os._exit(stop.exit_code)


def _tell(stop: Stopped) -> None:
    from hineus_cli.console import show_error

    logging.getLogger(TRACEBACKS).warning("stopped by %s, in the middle of a step", stop)
    show_error(stop.message, GOES_ON)


def end_children() -> None:
    """Kill the processes that were started from here and have not ended."""
    import psutil

    with suppress(psutil.Error):
        for child in psutil.Process().children(recursive=True):
            with suppress(psutil.Error):
                child.kill()
