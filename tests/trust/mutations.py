"""Valid input made wrong: strategies of hypothesis over bytes, lines of text and trees of JSON."""

from __future__ import annotations

import copy
import json
from typing import Any

from hypothesis import strategies as st
from hypothesis.strategies import DrawFn

COUNTS = (0, 1, 0x7F, 0xFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 1 << 40, (1 << 62) + 3, (1 << 64) - 1)
NUMBERS = (
    "nan", "inf", "-inf", "0", "-1", "1e308", "-1e38", "1e-320", "99999999999999999999", "0x10", "1e5", "4294967296",
    "", "1,5", "9" * 5000, "2020-13-45", "true",
)  # fmt: skip
WORDS = (
    "", " ", "..", "/", "../../etc/passwd", "/dev/zero", "\x00", "\x1b]0;pwned\x07", "[/]", "\u202e", "\udcff",
    "a" * 300, "http://127.0.0.1:9/x", "file:///etc/passwd", "%s%n", "{0}", "!!python/object/apply:os.system", "*a",
    "[bold]",
)  # fmt: skip
VALUES: tuple[Any, ...] = (
    None, True, False, [], {}, "", 0, -1, 1, 1e308, -1e308, float("nan"), float("inf"), 10**25, 10**400, "x", "nan",
    [[]], {"a": []}, [1, 2], "..", "/etc/passwd", "\x1b[31m", "\ud800", "a" * 300, 1e-320, 0.5,
)  # fmt: skip


@st.composite
def wrong_bytes(draw: DrawFn, valid: bytes) -> bytes:
    """Bits turned over, counts that lie, pieces cut out, doubled or filled with zeros, the end missing."""
    data = bytearray(valid)
    for _ in range(draw(st.sampled_from((1, 1, 1, 2, 3)))):
        way = draw(st.sampled_from(("flip", "flip", "count", "count", "cut", "double", "zeros", "end", "splice")))
        at = draw(st.integers(0, max(0, min(len(data), draw(st.sampled_from((64, 600, 1 << 30)))) - 1)))
        length = draw(st.sampled_from((1, 4, 17, 300)))
        if way == "flip" and data:
            data[at] ^= 1 << draw(st.integers(0, 7))
        elif way == "count":
            width = draw(st.sampled_from((1, 2, 4, 8)))
            value = draw(st.sampled_from(COUNTS)) % (1 << 8 * width)
            data[at : at + width] = value.to_bytes(width, draw(st.sampled_from(("little", "big"))))
        elif way == "cut":
            del data[at : at + length]
        elif way == "double":
            data[at:at] = data[at : at + length]
        elif way == "zeros":
            data[at : at + length] = bytes(length)
        elif way == "end":
            del data[at:]
        elif way == "splice":
            data[at:at] = draw(st.binary(max_size=40))
    return bytes(data)


@st.composite
def wrong_text(draw: DrawFn, valid: str) -> str:
    """Numbers and words put in place of others, lines doubled, swapped, cut and endless."""
    lines = valid.split("\n")
    for _ in range(draw(st.sampled_from((1, 1, 1, 2, 3)))):
        i = draw(st.integers(0, len(lines) - 1))
        words = lines[i].split(" ")
        way = draw(st.sampled_from(("number", "number", "word", "double", "swap", "drop", "cut", "long", "join")))
        if way in ("number", "word"):
            words[draw(st.integers(0, len(words) - 1))] = draw(st.sampled_from(NUMBERS if way == "number" else WORDS))
            lines[i] = " ".join(words)
        elif way == "double":
            lines[i:i] = [lines[i]] * draw(st.sampled_from((1, 3000)))
        elif way == "swap":
            j = draw(st.integers(0, len(lines) - 1))
            lines[i], lines[j] = lines[j], lines[i]
        elif way == "drop" and len(lines) > 1:
            del lines[i]
        elif way == "cut":
            lines[i] = lines[i][: draw(st.integers(0, len(lines[i])))]
        elif way == "long":
            lines[i] += draw(st.sampled_from((" 1", "[", "{a: ", "- ", "x"))) * 20000
        elif way == "join" and i + 1 < len(lines):
            lines[i : i + 2] = [lines[i] + lines[i + 1]]
    return "\n".join(lines)


@st.composite
def wrong_tree(draw: DrawFn, valid: Any) -> str:
    """JSON with values of other types and sizes, missing and further keys, and depth without end."""
    root = {"root": copy.deepcopy(valid)}
    for _ in range(draw(st.sampled_from((1, 1, 2)))):
        holder: Any = root
        key: Any = "root"
        while isinstance(holder[key], (dict, list)) and holder[key] and draw(st.integers(0, 5)):
            holder = holder[key]
            key = draw(st.sampled_from(sorted(holder) if isinstance(holder, dict) else range(len(holder))))
        if isinstance(holder, dict) and holder is not root and not draw(st.integers(0, 4)):
            del holder[key]
        else:
            holder[key] = copy.deepcopy(draw(st.sampled_from(VALUES)))
    text = json.dumps(root["root"])
    if not draw(st.integers(0, 15)):
        at = draw(st.integers(0, len(text)))
        text = text[:at] + draw(st.sampled_from(("[", '{"a":'))) * 50_000 + text[at:]
    return text


def encoded(text: str) -> bytes:
    """The bytes of a file with this text, lone surrogates as the bytes that they stand for where they do."""
    return text.encode("utf-8", "surrogatepass")
