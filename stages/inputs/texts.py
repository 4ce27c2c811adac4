"""Texts that other programs and people wrote: byte-order marks, and names in them that are not UTF-8."""

from __future__ import annotations

import codecs
from pathlib import Path

# Windows' editors and shells begin files with these; UTF-16 is what PowerShell's `>` writes.
ENCODINGS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}


def read_text(file: Path) -> str:
    """The text of a file, without a byte-order mark and with "\\n" at the end of lines.

    Bytes that are not UTF-8 become lone surrogates, as in the names of files (see `readable`).

    Raises:
        OSError: it cannot be read.
        UnicodeDecodeError: its byte-order mark says UTF-16, which it is not.
    """
    data = file.read_bytes()
    encoding = next((name for mark, name in ENCODINGS.items() if data.startswith(mark)), "utf-8")
    errors = "strict" if encoding == "utf-16" else "surrogateescape"
    return data.decode(encoding, errors).replace("\r\n", "\n")
