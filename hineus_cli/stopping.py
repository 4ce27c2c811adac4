"""SIGTERM and SIGHUP end a run as Ctrl-C does: with a sentence, a line in the log, and no child left behind.

Python runs its signal handlers between two steps of its main thread, which may be minutes deep in a C++ library. A
thread of ours therefore waits for the same signals and ends the process where that takes too long, or at a second
signal. Nothing is lost by that: stages are published whole, and a run goes on from them.
"""

from __future__ import annotations

import importlib
import logging
import os
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib.machinery import ModuleSpec, PathFinder
from types import FrameType, ModuleType
from typing import Any

from hineus_cli.at_once import CRASHES, SIGNALS, Stopped, signals_wait
from stages.engine.run_log import TRACEBACKS

TAKES_SIGTERM = "pycolmap"  # its import installs a handler that prints a C++ stack
GRACE_S = 5.0  # for the main thread to end by itself; half of what `docker stop` and others give before they kill
ECHO_S = 0.1  # a terminal's signal comes twice, from our parent, too
TELLING_S = 2.0  # the most that telling of it may take, in a terminal that may be gone
GOES_ON = "What was finished is kept: run the same command to go on from there."


@contextmanager
def stopped_by_signals() -> Iterator[None]:
    """Inside, the signals raise `Stopped` in the main thread. Those that are ignored, as with `nohup`, stay so."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    heard, told = socket.socketpair()
    told.setblocking(False)
    stopping = threading.Event()
    waiting: list[int] = []

    def stop(number: int, frame: FrameType | None) -> None:
        if imports.under_way:
            waiting.append(number)
        elif not stopping.is_set():
            stopping.set()
            raise Stopped(number)

    def imported() -> None:
        if waiting:
            stop(waiting[0], None)

    before = {number: signal.getsignal(number) for number in SIGNALS}
    ours = [number for number, handler in before.items() if handler != signal.SIG_IGN]

    def take() -> None:
        if threading.current_thread() is threading.main_thread():
            for number in ours:
                signal.signal(number, stop)

    def take_back() -> None:
        take()
        if threading.current_thread() is threading.main_thread():
            for number in CRASHES:  # the handler prints a C++ stack
                signal.signal(number, signal.SIG_DFL)

    imports = _Imports(take_back, imported)
    unraisable = sys.unraisablehook

    def tell_unraisable(what: sys.UnraisableHookArgs) -> None:
        if what.exc_type is not Stopped:  # else it was raised where nothing can be, and the watch ends the process
            unraisable(what)

    take()
    sys.unraisablehook = tell_unraisable
    former = signal.set_wakeup_fd(told.fileno(), warn_on_full_buffer=False)
    sys.meta_path.insert(sys.meta_path.index(PathFinder) if PathFinder in sys.meta_path else 0, imports)
    threading.Thread(target=_watch, args=(heard, told), name="signals", daemon=True).start()
    try:
        yield
    finally:
        with suppress(ValueError):
            sys.meta_path.remove(imports)
        if not stopping.is_set():  # else the watch goes on: what is left to do at the end may take too long, too
            sys.unraisablehook = unraisable
            signal.set_wakeup_fd(former)
            for number in ours:
                signal.signal(number, before[number])
            told.close()


def import_what_takes_signals() -> None:
    """Import it while there is no thread but ours, none of which can get a signal before it is taken back."""
    with suppress(ImportError):  # which the stage that needs it tells
        importlib.import_module(TAKES_SIGTERM)


class _Imports:
    """Finds modules as `PathFinder` does, and lets signals wait while one is imported in the main thread.

    Some modules catch whatever is raised while they are imported, and go on without a part of theirs.

    Attributes:
        under_way: how many modules are being imported, each by the one before.
    """

    def __init__(self, take_back: Callable[[], None], done: Callable[[], None]) -> None:
        self._take_back, self._done = take_back, done
        self.under_way = 0

    def find_spec(self, name: str, path: Any = None, target: ModuleType | None = None) -> ModuleSpec | None:
        if threading.current_thread() is not threading.main_thread():
            return None
        spec = PathFinder.find_spec(name, path, target)
        if spec is not None and spec.loader is not None and spec.has_location:
            execute = spec.loader.exec_module

            def exec_module(module: ModuleType) -> None:
                self.under_way += 1
                try:
                    self._execute(name, execute, module)
                finally:
                    self.under_way -= 1
                if not self.under_way:
                    self._done()

            spec.loader.exec_module = exec_module  # type: ignore[method-assign]
        return spec

    def _execute(self, name: str, execute: Callable[[ModuleType], None], module: ModuleType) -> None:
        if name != TAKES_SIGTERM:
            execute(module)
            return
        with signals_wait():
            execute(module)
            self._take_back()


def _watch(heard: socket.socket, told: socket.socket) -> None:
    """Wait for a first signal; then for the end of the process, a second signal or the end of patience.

    `told` is held so that it is closed by nobody else than the end of `stopped_by_signals`.
    """
    with heard, signals_wait():
        first = heard.recv(1)
        if not first:
            return
        time.sleep(ECHO_S)
        heard.settimeout(0)
        with suppress(BlockingIOError):
            heard.recv(1)
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
