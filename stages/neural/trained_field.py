"""The trained field as the rest of the pipeline uses it: NumPy in, NumPy out, in chunks."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from stages.blocks import in_blocks
from stages.neural.acceleration import points_at_a_time
from stages.neural.encoding_shapes import Encoding, Frequencies, HashGrid
from stages.neural.fields import Fields, FieldShape
from stages.neural.sampling import beyond_too

if TYPE_CHECKING:
    from jaxtyping import Float, Float32


class TrainedField:
    """A frozen signed distance and colour field in the scene frame."""

    def __init__(self, fields: Fields, device: torch.device | str) -> None:
        self.fields = fields.to(device).eval().requires_grad_(False)
        self.device = torch.device(device)
        self.levels = fields.shape.sdf_grid.levels

    @property
    def voxel_size(self) -> float:
        """Side of the finest encoding cell, scene units: the SDF has no detail below it."""
        return self.fields.shape.sdf_grid.voxel_size()

    def sdf(self, points: Float[np.ndarray, "n 3"]) -> Float32[np.ndarray, " n"]:
        """Signed distance at points: positive outside, negative inside the object."""
        return self._chunked(lambda p: self.fields.sdf.sdf(p, self.levels), points)

    def normals(self, points: Float[np.ndarray, "n 3"]) -> Float32[np.ndarray, "n 3"]:
        """Unit normals, pointing outwards."""
        return self._chunked(lambda p: torch.nn.functional.normalize(self.fields.sdf(p, self.levels)[2], dim=1), points)

    def color(
        self,
        points: Float[np.ndarray, "n 3"],
        normals: Float[np.ndarray, "n 3"],
        view_dirs: Float[np.ndarray, "n 3"],
    ) -> Float32[np.ndarray, "n 3"]:
        """sRGB colour in [0, 1] of surface points seen along unit view_dirs (camera to point)."""

        def surroundings(p: Tensor) -> Tensor:
            return beyond_too(lambda q: self.fields.sdf.sdf(q, self.levels), p)

        def evaluate(p: Tensor, n: Tensor, v: Tensor) -> Tensor:
            _, features, _ = self.fields.sdf(p, self.levels)
            return self.fields.radiance(p, n, v, features, surroundings).colors.clamp(max=1)

        return self._chunked(evaluate, points, normals, view_dirs)

    @torch.no_grad()
    def _chunked(self, function, *arrays: np.ndarray) -> np.ndarray:
        def evaluate(rows: slice) -> np.ndarray:
            chunk = [torch.from_numpy(np.ascontiguousarray(a[rows], dtype=np.float32)) for a in arrays]
            return function(*(c.to(self.device) for c in chunk)).cpu().numpy()

        at_once = points_at_a_time(self.device)
        return np.concatenate(in_blocks(evaluate, max(len(arrays[0]), 1), at_once, "points of the field"))


def field_state(fields: Fields) -> dict[str, Any]:
    """What `load_field` needs, as tensors and plain values."""
    return {"shape": asdict(fields.shape), "weights": fields.state_dict()}


def _encoding(values: dict[str, int]) -> Encoding:
    """An encoding from its attributes, as `asdict` wrote them."""
    return Frequencies(**values) if set(values) == {"levels"} else HashGrid(**values)


def load_field(path: Path, device: torch.device | str = "cpu") -> TrainedField:
    """Read a field that was saved with `torch.save(field_state(fields), path)`.

    Raises ValueError when the file is not such a field.
    """
    state = torch.load(path, map_location="cpu", weights_only=True)
    if not isinstance(state, dict) or "shape" not in state:
        raise ValueError(f"{path}: got {type(state).__name__}, expected a trained field")
    shape = state["shape"]
    for key in ("sdf_grid", "background_grid"):
        shape[key] = _encoding(shape[key]) if shape[key] else None
    fields = Fields(FieldShape(**shape))
    fields.load_state_dict(state["weights"])
    return TrainedField(fields, device)
