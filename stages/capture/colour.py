"""Colours as a photo's profile means them, in sRGB, which everything after ingest takes for granted."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from stages.light.srgb import decoded

INTEROPERABILITY_IFD, INTEROPERABILITY_INDEX = 0xA005, 1
DCF_OPTION = "R03"  # what cameras write into EXIF in place of a profile: Adobe RGB

# Of Pillow's modes. A profile for another space than the pixels' cannot be theirs.
SPACES = {"L": "GRAY", "RGB": "RGB", "CMYK": "CMYK", "LAB": "LAB"}
SAME_LEVELS = 2  # an RGB profile that moves no colour by more levels of 255 is sRGB, whoever wrote it
PROBES = 9  # levels a channel that are looked at for that

# Chromaticities of red, green and blue; the white of all three is D65.
SRGB = ((0.64, 0.33), (0.30, 0.60), (0.15, 0.06))
ADOBE_RGB = ((0.64, 0.33), (0.21, 0.71), (0.15, 0.06))
DISPLAY_P3 = ((0.68, 0.32), (0.265, 0.69), (0.15, 0.06))
REC_2020 = ((0.708, 0.292), (0.17, 0.797), (0.131, 0.046))
D65, D50_XYZ = (0.3127, 0.3290), np.array([0.9642, 1.0, 0.8249])
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
ADOBE_GAMMA = 563 / 256
# ITU-T H.273, as HEIF has them in place of a profile.
NCLX_PRIMARIES = {9: REC_2020, 11: DISPLAY_P3, 12: DISPLAY_P3}
NCLX_HDR = {16: "PQ", 18: "HLG"}

Primaries = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]


@dataclass(frozen=True)
class Colours:
    """What a photo's file says of its colours.

    Attributes:
        profile: ICC profile; empty for sRGB and for what says nothing.
        name: of the profile, for people; empty where there is none.
        problem: what is wrong with it, in words; then it is not used.
    """

    profile: bytes = b""
    name: str = ""
    problem: str = ""


def colours_of(info: Mapping[str, Any], exif: Any, mode: str) -> Colours:
    """By `info` and EXIF of a picture that Pillow opened, for pixels of one of the modes in `SPACES`."""
    nclx = info.get("nclx_profile") or {}
    found = bytes(info.get("icc_profile") or b"")
    if found:
        return _checked(found, mode)
    if nclx.get("transfer_characteristics") in NCLX_HDR:
        kind = NCLX_HDR[nclx["transfer_characteristics"]]
        return Colours(problem=f"an HDR picture ({kind}): its colours are taken as they are, which is pale")
    if mode != "RGB":
        return Colours()
    if nclx.get("color_primaries") in NCLX_PRIMARIES:
        return _checked(matrix_profile("nclx", NCLX_PRIMARIES[nclx["color_primaries"]], decoded), mode)
    if _interoperability(exif).startswith(DCF_OPTION):
        return Colours(matrix_profile("Adobe RGB", ADOBE_RGB, lambda v: v**ADOBE_GAMMA), "Adobe RGB (by EXIF)")
    return Colours()


def _interoperability(exif: Any) -> str:
    """What EXIF says of the file's kind; empty where it says nothing."""
    try:
        return str(exif.get_ifd(INTEROPERABILITY_IFD).get(INTEROPERABILITY_INDEX, ""))
    except KeyError:  # Pillow before 13, where there is no such directory
        return ""


def in_srgb(image: Any, colours: Colours) -> Any:
    """Pillow's `image`, of a mode in `SPACES`, as RGB in sRGB; the same object where nothing is to do."""
    from PIL import ImageCms

    if colours.profile:
        return ImageCms.applyTransform(image, _transform(colours.profile, image.mode))
    if image.mode == "LAB":
        lab = ImageCms.ImageCmsProfile(ImageCms.createProfile("LAB"))
        return ImageCms.applyTransform(image, _transform(lab.tobytes(), "LAB"))
    return image if image.mode == "RGB" else image.convert("RGB")


@lru_cache(maxsize=32)
def _checked(profile: bytes, mode: str) -> Colours:
    """The photos of one camera have one profile."""
    from PIL import Image, ImageCms

    try:
        opened = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        name = " ".join(ImageCms.getProfileDescription(opened).split()) or "without a name"
        space = opened.profile.xcolor_space.strip().upper()
        if space != SPACES[mode]:
            return Colours(problem=f"its colour profile is for {space}, its pixels are {SPACES[mode]}: not used")
        transform = _transform(profile, mode)
        if mode == "RGB":
            levels = np.linspace(0, 255, PROBES).round().astype(np.uint8)
            grid = np.stack(np.meshgrid(levels, levels, levels), -1).reshape(1, -1, 3)
            moved = np.asarray(ImageCms.applyTransform(Image.fromarray(grid), transform)).astype(int) - grid
            if np.abs(moved).max() <= SAME_LEVELS:
                return Colours()
    except (ImageCms.PyCMSError, OSError, ValueError, TypeError, AttributeError):
        return Colours(problem="its colour profile is broken: taken for sRGB")
    return Colours(profile, name)


def _transform(profile: bytes, mode: str) -> Any:
    """To sRGB: relative colorimetric, black on black."""
    from PIL import ImageCms

    return ImageCms.buildTransform(
        ImageCms.ImageCmsProfile(io.BytesIO(profile)),
        ImageCms.createProfile("sRGB"),
        mode,
        "RGB",
        renderingIntent=ImageCms.Intent.RELATIVE_COLORIMETRIC,
        flags=ImageCms.Flags.BLACKPOINTCOMPENSATION,
    )


def matrix_profile(
    name: str, primaries: Primaries, decode: Callable[[np.ndarray], np.ndarray], white: tuple[float, float] = D65
) -> bytes:
    """An ICC profile, version 2.1, of an RGB space.

    Args:
        primaries: chromaticities (x, y) of red, green and blue. white: that of white.
        decode: linear light of values from 0 to 1.
    """
    to_xyz = np.array([[x / y, 1.0, (1 - x - y) / y] for x, y in (*primaries, white)]).T
    colorants = to_xyz[:, :3] * np.linalg.solve(to_xyz[:, :3], to_xyz[:, 3])
    cones = (BRADFORD @ D50_XYZ) / (BRADFORD @ to_xyz[:, 3])
    colorants = np.linalg.solve(BRADFORD, cones[:, None] * (BRADFORD @ colorants))  # as they look under D50

    def xyz(values: np.ndarray) -> bytes:
        return struct.pack(">4sI3i", b"XYZ ", 0, *(round(value * 65536) for value in values.tolist()))

    text = name.encode("ascii") + b"\0"
    curve = (decode(np.linspace(0, 1, 1024)) * 65535).round().astype(">u2")
    shared = struct.pack(">4sII", b"curv", 0, len(curve)) + curve.tobytes()
    tags = {
        b"desc": struct.pack(">4sII", b"desc", 0, len(text)) + text + bytes(78),
        b"wtpt": xyz(D50_XYZ),
        **{tag: xyz(column) for tag, column in zip((b"rXYZ", b"gXYZ", b"bXYZ"), colorants.T, strict=True)},
        **{tag: shared for tag in (b"rTRC", b"gTRC", b"bTRC")},
    }
    table, body = struct.pack(">I", len(tags)), b""
    start = 128 + 4 + 12 * len(tags)
    for tag, data in tags.items():
        table += struct.pack(">4sII", tag, start + len(body), len(data))
        body += data + bytes(-len(data) % 4)
    head = struct.pack(">I4sI4s4s4s", start + len(body), b"none", 0x02100000, b"mntr", b"RGB ", b"XYZ ")
    head += bytes(12) + b"acsp" + bytes(28) + xyz(D50_XYZ)[8:]
    return head.ljust(128, b"\0") + table + body
