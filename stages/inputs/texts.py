"""Texts that other programs and people wrote: byte-order marks, names in them that are not UTF-8, JSON."""

from __future__ import annotations

import codecs
import json
import math
from pathlib import Path
from typing import Any

from stages.inputs.bounded import MOST_TEXT, read_bytes

# Windows' editors and shells begin files with these; UTF-16 is what PowerShell's `>` writes.
ENCODINGS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16", codecs.BOM_UTF16_BE: "utf-16"}
LONGEST_NUMBER = 40  # digits of a whole number; what is longer is taken as decimal, and mostly too large


def read_text(file: Path, most: int = MOST_TEXT) -> str:
    """The text of a file, without a byte-order mark and with "\\n" at the end of lines.

    Bytes that are not UTF-8 become lone surrogates, as in the names of files (see `readable`).

    Raises:
        OSError: it cannot be read.
        ValueError: it is no file or larger than `most` bytes, or its byte-order mark says UTF-16, which it is not.
    """
    data = read_bytes(file, most)
    encoding = next((name for mark, name in ENCODINGS.items() if data.startswith(mark)), "utf-8")
    errors = "strict" if encoding == "utf-16" else "surrogateescape"
    return data.decode(encoding, errors).replace("\r\n", "\n")


def read_json(file: Path) -> Any:
    """The JSON in a file; all its numbers are finite.

    Raises:
        OSError: it cannot be read.
        ValueError: it is no JSON, is nested too deeply, or has NaN, infinite or too large numbers.
    """
    return parse_json(read_text(file))


def parse_json(text: str) -> Any:
    """The same of a text."""
    try:
        return json.loads(text, parse_float=_finite, parse_int=_whole, parse_constant=_finite)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def _whole(digits: str) -> int | float:
    return int(digits) if len(digits) <= LONGEST_NUMBER else _finite(digits)


def _finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"{text[:LONGEST_NUMBER]} is no number that can be computed with")
    return value
