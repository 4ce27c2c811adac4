"""The log file of a workspace: everything that is logged during a run, and the traceback of what ends it."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path

TRACEBACKS = "stages.tracebacks"  # the logger whose records go to the log file only


# File names may hold what a terminal obeys: it is shown, not sent.
_CONTROLS = {code: f"\\x{code:02x}" for code in (*range(0x20), *range(0x7F, 0xA0)) if chr(code) not in "\n\t"}


def plain(text: str) -> str:
    """A text as it may be printed: control characters, which a file's name may hold, as `\\x1b`."""
    return text.translate(_CONTROLS)


class _LogFile(logging.FileHandler):
    """A log that cannot be written (the disk is full) is no reason to hide the error that says so."""

    def format(self, record: logging.LogRecord) -> str:
        return plain(super().format(record))

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - the name is logging's
        """Go on without this record."""


@contextlib.contextmanager
def log_to_file(path: Path) -> Iterator[None]:
    """Everything that is logged inside goes to `path`, too, and the traceback of what is raised."""
    handler = _LogFile(path, encoding="utf-8", errors="backslashreplace")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    root = logging.getLogger()
    root.addHandler(handler)
    try:
        yield
    except KeyboardInterrupt as stop:
        logging.getLogger(TRACEBACKS).warning("stopped by %s", str(stop) or "Ctrl-C")
        raise
    except SystemExit:  # the console's answer to a pipe that is closed, as by `| head`
        logging.getLogger(TRACEBACKS).warning("stopped, since nobody reads what is printed any more")
        raise
    except Exception:
        logging.getLogger(TRACEBACKS).error("the run failed", exc_info=True)
        raise
    finally:
        root.removeHandler(handler)
        with contextlib.suppress(OSError):
            handler.close()
