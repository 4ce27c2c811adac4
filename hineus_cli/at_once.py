"""A signal while nothing is under way, before a command starts and after its end: a sentence, and the process ends.

It imports next to nothing, so that it is there from the first moment on; and nothing of ours, as what is called so
may be another package then.
"""

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager

SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

CRASHES = tuple(
    getattr(signal, name) for name in ("SIGABRT", "SIGSEGV", "SIGBUS", "SIGFPE", "SIGILL") if hasattr(signal, name)
)


class Stopped(BaseException):
    """A signal asked the program to end. No KeyboardInterrupt, which the parser of arguments answers by itself."""

    def __init__(self, number: int) -> None:
        self.by_ctrl_c = number == signal.SIGINT
        self.exit_code = 128 + number
        super().__init__("Ctrl-C" if self.by_ctrl_c else signal.Signals(number).name)

    @property
    def message(self) -> str:
        return "Stopped." if self.by_ctrl_c else f"Stopped by {self}."


def end_at_once_by_signals() -> None:
    """Those that are ignored, as with `nohup`, stay so."""
    for number in SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _end)


@contextmanager
def signals_wait() -> Iterator[None]:
    """What this thread is sent inside comes after it. To threads that are started inside it never comes."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS) if os.name == "posix" else None
    try:
        yield
    finally:
        if before is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def sent_by_ourselves() -> bool:
    """Whether a library in this process asked for its end while `signals_wait`; what others sent goes on waiting."""
    waiting = signal.sigtimedwait(SIGNALS, 0) if sys.platform == "linux" else None
    if waiting is not None and waiting.si_pid != os.getpid():
        signal.raise_signal(waiting.si_signo)
        return False
    return waiting is not None


def _end(number: int, frame: object) -> None:
    stop = Stopped(number)
    try:
        os.write(2, f"Error: {stop.message}\n".encode())
    finally:
        os._exit(stop.exit_code)
