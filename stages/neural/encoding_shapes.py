"""What an encoding of positions looks like: levels, channels, rows, voxels. `encodings` computes them.

L levels. All lengths are in scene units.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import torch

if TYPE_CHECKING:
    from jaxtyping import Bool, Float32, Int64

# A table starts as small noise: features begin near zero, so the geometric initialisation is what is rendered.
INITIAL_AMPLITUDE = 1e-4


@dataclass(frozen=True)
class HashGrid:
    """The shape of a hash encoding over the cube [-1, 1]^3.

    Attributes:
        levels: number of lattices, geometrically spaced from `coarsest` to `finest` cells along a side.
        features: channels per level (the CPU kernels are written for 4, those for CUDA for powers of two).
        log2_rows: a level holds at most 2**log2_rows rows.
        coarsest, finest: cells along a side of the first and last level.
    """

    levels: int = 8
    features: int = 4
    log2_rows: int = 17
    coarsest: int = 16
    finest: int = 512

    @property
    def channels(self) -> int:
        return self.levels * self.features

    @cached_property
    def resolutions(self) -> Int64[np.ndarray, " levels"]:
        """Cells along a side per level."""
        if self.levels == 1:
            return np.array([self.coarsest], dtype=np.int64)
        growth = np.exp(np.log(self.finest / self.coarsest) / (self.levels - 1))
        return np.round(self.coarsest * growth ** np.arange(self.levels)).astype(np.int64)

    @cached_property
    def dense(self) -> Bool[np.ndarray, " levels"]:
        """Whether the level's (res + 1)^3 lattice fits its rows without hashing."""
        return (self.resolutions + 1) ** 3 <= 2**self.log2_rows

    @cached_property
    def offsets(self) -> Int64[np.ndarray, " offsets"]:
        """First row of each level; the last entry is the number of rows."""
        rows = np.where(self.dense, (self.resolutions + 1) ** 3, 2**self.log2_rows)
        return np.concatenate([[0], np.cumsum(rows)]).astype(np.int64)

    @property
    def num_rows(self) -> int:
        return int(self.offsets[-1])

    def voxel_size(self, active_levels: int | None = None) -> float:
        """Side of a cell of the finest active level, in scene units."""
        return 2.0 / float(self.resolutions[(active_levels or self.levels) - 1])

    def initial_table(self, generator: torch.Generator) -> Float32[torch.Tensor, "{self.num_rows} {self.features}"]:
        """Uniform noise of amplitude `INITIAL_AMPLITUDE`."""
        noise = torch.rand(self.num_rows, self.features, generator=generator)
        return (noise * 2 - 1) * INITIAL_AMPLITUDE


@dataclass(frozen=True)
class Frequencies:
    """NeRF's positional encoding: level k holds sin(2^k pi x) and cos(2^k pi x) of the three coordinates.

    It has no table. Channels of a level: three sines, then three cosines.

    Attributes:
        levels: number of octaves.
    """

    levels: int = 8

    @property
    def channels(self) -> int:
        return 6 * self.levels

    def voxel_size(self, active_levels: int | None = None) -> float:
        """Half a wavelength of the highest active frequency, in scene units."""
        return 0.5 ** ((active_levels or self.levels) - 1)


Encoding = HashGrid | Frequencies
