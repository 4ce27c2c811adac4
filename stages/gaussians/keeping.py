"""Gaussians in a workspace: the arrays by their names, as an .npz file."""

from __future__ import annotations

from dataclasses import asdict, fields
from pathlib import Path

import numpy as np

from stages.gaussians.gaussians import Gaussians


def write_gaussians(file: Path, gaussians: Gaussians) -> None:
    np.savez(file, **asdict(gaussians))


def read_gaussians(file: Path) -> Gaussians:
    """
    Raises:
        OSError, ValueError, KeyError: it cannot be read, or its arrays are not those of Gaussians.
    """
    with np.load(file) as arrays:
        read = Gaussians(**{field.name: arrays[field.name] for field in fields(Gaussians)})
    count, terms = read.harmonics.shape[:2]
    expected = [(count, 3), (count, 4), (count, 3), (count,), (count, terms, 3), (count,)]
    found = [getattr(read, field.name).shape for field in fields(Gaussians)]
    if found != expected or terms not in (1, 4, 9, 16):
        raise ValueError(f"expected the arrays of Gaussians, got shapes {found}")
    return read
