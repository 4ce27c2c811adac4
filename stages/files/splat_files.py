"""Gaussians for programs that show them: PLY as 3DGS writes it, SPZ, and glTF. Gaussians in, bytes out."""

from __future__ import annotations

import gzip
import struct
from typing import Any

import numpy as np

from stages.files.glb import NAME, GlbBuffer
from stages.gaussians.gaussians import Gaussians
from stages.gaussians.harmonics import C0
from stages.light.srgb import decoded

# SPZ: the bits of a coordinate, its sign among them; what a colour's coefficient and a logarithm are multiplied by.
_COORDINATE_BITS, _MOST_FRACTION = 24, 24
_COLOR_STEPS, _HARMONIC_STEPS = 0.15 * 255, 128
_LEAST_LOG_SCALE, _SCALE_STEPS = -10.0, 16


def checked_gaussians(gaussians: Gaussians) -> Gaussians:
    """
    Raises:
        ValueError: there are none, or a number is not finite.
    """
    if not len(gaussians):
        raise ValueError("expected at least one Gaussian, got none")
    for name in ("centers", "rotations", "log_scales", "opacity_logits", "harmonics"):
        if not np.isfinite(getattr(gaussians, name)).all():
            raise ValueError(f"expected finite {name} of the Gaussians")
    return gaussians


# ---------------------------------------------------------------- PLY
def splat_ply_bytes(gaussians: Gaussians, comment: str = "") -> bytes:
    """The binary PLY that the code of Kerbl et al. 2023 writes: float32 each, coefficients of a channel together.

    Args:
        comment: one line of ASCII for the header.

    Raises:
        ValueError: see `checked_gaussians`.
    """
    gaussians = checked_gaussians(gaussians)
    count, rest = len(gaussians), 3 * (gaussians.harmonics.shape[1] - 1)
    columns = {
        "x y z": gaussians.centers,
        "nx ny nz": np.zeros((count, 3)),  # which readers expect, and do not use
        "f_dc_0 f_dc_1 f_dc_2": gaussians.harmonics[:, 0],
        " ".join(f"f_rest_{k}" for k in range(rest)): gaussians.harmonics[:, 1:]
        .transpose(0, 2, 1)
        .reshape(count, rest),
        "opacity": gaussians.opacity_logits[:, None],
        "scale_0 scale_1 scale_2": gaussians.log_scales,
        "rot_0 rot_1 rot_2 rot_3": gaussians.rotations,
    }
    names = " ".join(columns).split()
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *([f"comment {comment}"] if comment else []),
        f"element vertex {count}",
        *(f"property float {name}" for name in names),
        "end_header\n",
    ]
    rows = np.concatenate(list(columns.values()), axis=1).astype("<f4")
    return "\n".join(header).encode("ascii", "replace") + rows.tobytes()


# ---------------------------------------------------------------- SPZ
def spz_bytes(gaussians: Gaussians) -> bytes:
    """SPZ version 3 (github.com/nianticlabs/spz): a quarter of the PLY or less, all in whole numbers, gzipped.

    Coordinates have as many bits of a fraction as their size leaves: 2^-23 of the largest or finer. Scales are from
    e^-10 to e^5.9 in steps of 6 %, what is thinner is at e^-10; harmonics beyond degree 0 from -1 to 1.

    Args:
        gaussians: Y up, which is what the format says of its frame.

    Raises:
        ValueError: see `checked_gaussians`.
    """
    gaussians = checked_gaussians(gaussians)
    fraction = fraction_bits(gaussians.centers)
    sections = [
        _fixed_point(gaussians.centers, fraction),
        _in_a_byte(255 * gaussians.opacities),
        _in_a_byte(_COLOR_STEPS * gaussians.harmonics[:, 0] + 127.5),
        _in_a_byte(_SCALE_STEPS * (gaussians.log_scales - _LEAST_LOG_SCALE)),
        _smallest_three(gaussians.rotations),
        _in_a_byte(_HARMONIC_STEPS * gaussians.harmonics[:, 1:] + 128),
    ]
    header = struct.pack("<4sIIBBBB", b"NGSP", 3, len(gaussians), gaussians.degree, fraction, 0, 0)
    # no time in it: the same Gaussians give the same bytes
    return gzip.compress(header + b"".join(section.tobytes() for section in sections), compresslevel=6, mtime=0)


def fraction_bits(centers: np.ndarray) -> int:
    """Of coordinates of 24 bits: as many as leave room for the largest."""
    whole = int(np.ceil(np.log2(max(float(np.abs(centers).max()), 1e-6) * (1 + 1e-6))))
    return int(np.clip(_COORDINATE_BITS - 1 - whole, 1, _MOST_FRACTION))


def _fixed_point(centers: np.ndarray, fraction: int) -> np.ndarray:
    """[N, 3, 3] uint8: whole numbers of 24 bits, little endian."""
    most = 2 ** (_COORDINATE_BITS - 1) - 1
    whole = np.clip(np.rint(centers.astype(np.float64) * 2.0**fraction), -most, most).astype("<i4")
    return np.ascontiguousarray(whole[..., None]).view(np.uint8)[..., :3]


def _in_a_byte(values: np.ndarray) -> np.ndarray:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)


def _smallest_three(quaternions: np.ndarray) -> np.ndarray:
    """[N] uint32 of quaternions [N, 4] (w, x, y, z): the largest component's number in x, y, z, w, then the others as a
    sign and 9 bits of up to √½, first to last; the largest is made positive, and follows from the others."""
    xyzw = np.roll(quaternions.astype(np.float64), -1, axis=1)
    xyzw /= np.maximum(np.linalg.norm(xyzw, axis=1, keepdims=True), 1e-12)
    largest = np.abs(xyzw).argmax(1)
    rows = np.arange(len(xyzw))
    xyzw *= np.where(xyzw[rows, largest] < 0, -1, 1)[:, None]
    packed = largest.astype(np.uint32)
    for axis in range(4):
        size = np.rint(np.minimum(np.abs(xyzw[:, axis]) * np.sqrt(2), 1) * 511).astype(np.uint32)
        sign = (xyzw[:, axis] < 0).astype(np.uint32)
        packed = np.where(largest == axis, packed, packed << 10 | sign << 9 | size)
    return packed.astype("<u4")


# ---------------------------------------------------------------- glTF
def splat_glb_bytes(gaussians: Gaussians, generator: str = "hineus", extras: dict[str, Any] | None = None) -> bytes:
    """A binary glTF 2.0 file with KHR_gaussian_splatting: points with what makes them Gaussians, as sRGB colours.

    Programs without the extension show coloured points.

    Args:
        gaussians: Y up.
        extras: JSON-able, kept in the asset's extras.

    Raises:
        ValueError: see `checked_gaussians`.
    """
    gaussians = checked_gaussians(gaussians)
    extension, buffer = "KHR_gaussian_splatting", GlbBuffer()
    centers = np.ascontiguousarray(gaussians.centers, np.float32)
    attributes = {
        "POSITION": buffer.add_numbers(centers, "VEC3", min=centers.min(0).tolist(), max=centers.max(0).tolist()),
        "COLOR_0": buffer.add_numbers(_point_colors(gaussians), "VEC4"),
    }
    own = {
        "ROTATION": (np.roll(gaussians.rotations, -1, axis=1), "VEC4"),
        "SCALE": (np.exp(gaussians.log_scales), "VEC3"),
        "OPACITY": (gaussians.opacities, "SCALAR"),
    }
    orders = [(l, n) for l in range(gaussians.degree + 1) for n in range(2 * l + 1)]
    for k, (l, n) in enumerate(orders):
        own[f"SH_DEGREE_{l}_COEF_{n}"] = gaussians.harmonics[:, k], "VEC3"
    for name, (values, kind) in own.items():
        attributes[f"{extension}:{name}"] = buffer.add_numbers(np.ascontiguousarray(values, np.float32), kind)
    how = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    primitive = {"mode": 0, "attributes": attributes, "extensions": {extension: how}}
    return buffer.file([{"name": NAME, "primitives": [primitive]}], generator, extras, extensionsUsed=[extension])


def _point_colors(gaussians: Gaussians) -> np.ndarray:
    """[N, 4] float32: linear colours from all sides, and opacities, for programs that show points."""
    colors = decoded(np.clip(0.5 + C0 * gaussians.harmonics[:, 0], 0, 1))
    return np.concatenate([colors, gaussians.opacities[:, None]], axis=1).astype(np.float32)
