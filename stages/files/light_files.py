"""Lights as files: OpenEXR and Radiance HDR maps, and spherical harmonics as JSON; and reading what others wrote.

All hold what `stages.light.environment` says: linear radiance, equirectangular, in the frame of the exported GLB.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from stages.errors import InputError
from stages.inputs.bounded import reason
from stages.inputs.light_maps import EXPONENT, read_light_map
from stages.light.harmonics import project

GIVEN_LIGHT = "light"  # what a run calls this input
HARMONICS = "real spherical harmonics"
CONVENTION = {
    "frame": "that of the exported GLB: right-handed, +Y up",
    "basis": "real, orthonormal over the sphere, without the Condon-Shortley phase (Ramamoorthi & Hanrahan 2001); "
    "their z is +Y here, their x is +Z, their y is +X",
    "order": "(l, m) = (0, 0), (1, -1), (1, 0), (1, 1), (2, -2), ... (l, l)",
    "values": "integral over the sphere of linear RGB radiance times the harmonic; a light of radiance 1 all around "
    "has 3.545 as its first value",
    "irradiance": "sum of A_l times value times harmonic at the normal, A = pi, 2 pi / 3, pi / 4, 0",
}
# Degrees whose coefficients are written, by how many these are.
DEGREES = {9: 2, 16: 3}


def write_exr(file: Path, radiance: np.ndarray) -> None:
    """A map [H, 2 H, 3] as float32, without loss."""
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "envmap": OpenEXR.ENVMAP_LATLONG}
    OpenEXR.File(header, {"RGB": np.ascontiguousarray(radiance, dtype=np.float32)}).write(str(file))


def write_hdr(file: Path, radiance: np.ndarray) -> None:
    """A map [H, 2 H, 3] as RGBE in plain rows, which every reader takes: to a 256th of the brightest channel."""
    head = f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y {radiance.shape[0]} +X {radiance.shape[1]}\n"
    file.write_bytes(head.encode() + rgbe(radiance).tobytes())


def rgbe(radiance: np.ndarray) -> np.ndarray:
    """Pixels [..., 3] as mantissas that share an exponent [..., 4] uint8, rounded to the nearest; Ward 1991."""
    values = np.maximum(np.asarray(radiance, dtype=np.float64), 0)
    brightest = values.max(-1)
    exponent = np.frexp(brightest)[1]
    exponent += np.rint(np.ldexp(brightest, 8 - exponent)) > 255  # rounding fills the mantissa
    stored = np.clip(exponent + 128, 0, 255)[..., None]
    mantissa = np.minimum(np.rint(np.ldexp(values, EXPONENT - stored)), 255)
    return np.where(stored > 0, np.concatenate([mantissa, stored], axis=-1), 0).astype(np.uint8)


def harmonics_json(radiance: np.ndarray) -> dict[str, Any]:
    """Spherical harmonics of a map [H, 2 H, 3] up to degree 2 (9 RGB values) and 3 (16), and what they mean."""
    values = {str(count): np.round(project(radiance, degree), 7).tolist() for count, degree in DEGREES.items()}
    return {"light": HARMONICS, "convention": CONVENTION, "coefficients": values}


def read_light(file: Path) -> np.ndarray:
    """Radiance [H, 2 H, 3] float32 of an environment map, Radiance HDR or OpenEXR.

    Raises:
        InputError: it is none.
    """
    try:
        return read_light_map(file)
    except Exception as error:  # damaged files raise nearly anything
        raise InputError(
            f"{file} cannot be read as a light: {reason(error)}.",
            "Name an equirectangular HDR or EXR file, twice as wide as high, as polyhaven.com/hdris has them.",
        ) from error
