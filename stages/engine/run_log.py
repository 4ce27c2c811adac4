"""The log file of a workspace: everything that is logged during a run, and the traceback of what ends it."""

from __future__ import annotations

import contextlib
import logging
import re
import tempfile
import traceback
import unicodedata
from collections.abc import Iterator
from io import TextIOWrapper
from pathlib import Path

from stages.artifacts.own_files import open_own, read_tail
from stages.engine.workspace import storage_errors

TRACEBACKS = "stages.tracebacks"  # the logger whose records go to the log file only
TRACEBACK_IS = "The full traceback is"
FAILED = "the run failed"

SHOWN = {"Cc", "Cf", "Cs", "Zl", "Zp"}  # categories of characters that are no text but act on it
JOINERS = "\u200c\u200d"  # parts of words in some scripts, and of emoji


def plain(text: str, kept: str = "\n\t") -> str:
    """A text as it may be printed: what a terminal obeys, or reorders text by, is shown as `\\x1b` and not sent.

    Names of files may hold such characters, and what is printed may hold names. Control characters but those of `kept`
    are among them, marks of direction and other invisible ones, and bytes that are no UTF-8.
    """
    if text.isprintable():
        return text
    return "".join(c if c in kept or c in JOINERS or unicodedata.category(c) not in SHOWN else _shown(c) for c in text)


def _shown(character: str) -> str:
    code = ord(character)
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}" if code < 0x10000 else f"\\U{code:08x}"


def where_traceback_is(error: Exception) -> str:
    """A sentence: the log file of a run that the error ended, or else a new file among the temporary ones."""
    for note in getattr(error, "__notes__", ()):
        if note.startswith(TRACEBACK_IS):
            return str(note)
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="hineus-", suffix=".log", delete=False, encoding="utf-8", errors="backslashreplace"
        ) as file:
            file.write(plain("".join(traceback.format_exception(error))))
    except OSError:
        return "Its traceback could not be written."
    return f"{TRACEBACK_IS} in {file.name}."


def failure_told(log: Path) -> str | None:
    """What the error said that ended the last run that is in a log; None where that did not fail, or goes on.

    Raises:
        WorkspaceError: the log is a link, or no file.
    """
    records = re.split(r"^(?=\d{4}-\d\d-\d\d )", read_tail(log).decode(errors="replace"), flags=re.MULTILINE)
    if f" ERROR {TRACEBACKS}: {FAILED}" not in records[-1].partition("\n")[0]:
        return None
    told = re.findall(r"^    ([\w.]+)(?:: (.*))?$", records[-1], re.MULTILINE)
    name, message = told[-1] if told else ("", "")
    return message or name or "It failed."


class _LogFile(logging.FileHandler):
    """A log that cannot be written (the disk is full) is no reason to hide the error that says so."""

    def _open(self) -> TextIOWrapper:
        return open(self.baseFilename, "a", encoding=self.encoding, errors=self.errors, opener=open_own)

    def format(self, record: logging.LogRecord) -> str:
        return plain(super().format(record)).replace("\n", "\n    ")  # what starts a line is ours

    def handleError(self, record: logging.LogRecord) -> None:  # noqa: N802 - the name is logging's
        """Go on without this record."""


@contextlib.contextmanager
def log_to_file(path: Path) -> Iterator[None]:
    """Everything that is logged inside goes to `path`, too, and the traceback of what is raised.

    Raises:
        WorkspaceError: it cannot be written.
    """
    with storage_errors(path.parent, "opening its log"):
        handler = _LogFile(path, encoding="utf-8", errors="backslashreplace")
    handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)s %(name)s: %(message)s"))
    root = logging.getLogger()
    root.addHandler(handler)
    try:
        yield
    except SystemExit:  # the console's answer to a pipe that is closed, as by `| head`
        logging.getLogger(TRACEBACKS).warning("stopped, since nobody reads what is printed any more")
        raise
    except Exception as error:
        logging.getLogger(TRACEBACKS).error(FAILED, exc_info=True)
        error.add_note(f"{TRACEBACK_IS} at the end of {path}.")
        raise
    except BaseException as stop:  # Ctrl-C, or another signal
        logging.getLogger(TRACEBACKS).warning("stopped by %s", str(stop) or "Ctrl-C")
        raise
    finally:
        root.removeHandler(handler)
        with contextlib.suppress(OSError):
            handler.close()
