"""The log file of a workspace: everything that is logged during a run, and the traceback of what ends it."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator
from pathlib import Path

TRACEBACKS = "stages.tracebacks"  # the logger whose records go to the log file only


class _LogFile(logging.FileHandler):
    """A log that cannot be written (the disk is full) is no reason to hide the error that says so."""

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - the name is logging's
        """Go on without this record."""


@contextlib.contextmanager
def log_to_file(path: Path) -> Iterator[None]:
    """Everything that is logged inside goes to `path`, too, and the traceback of what is raised."""
    handler = _LogFile(path, encoding="utf-8")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    root = logging.getLogger()
    root.addHandler(handler)
    try:
        yield
    except KeyboardInterrupt as stop:
        logging.getLogger(TRACEBACKS).warning("stopped by %s", str(stop) or "Ctrl-C")
        raise
    except Exception:
        logging.getLogger(TRACEBACKS).error("the run failed", exc_info=True)
        raise
    finally:
        root.removeHandler(handler)
        with contextlib.suppress(OSError):
            handler.close()
