"""The trained field as cameras see it: whole photos, rendered as in training."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from configs.training import TrainParams
from stages.blocks import in_blocks
from stages.geometry.cameras import PinholeCameras
from stages.neural.acceleration import RAYS_AT_ONCE, RENDERED
from stages.neural.fields import Fields
from stages.neural.renderer import Renderer
from stages.neural.sampling import SdfCache, intersect_unit_sphere
from stages.neural.terms import Terms
from stages.neural.training_photos import RayBatch

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Float32, UInt8


@dataclass(frozen=True)
class FieldDrawing:
    """What one camera sees of the field.

    Attributes:
        colors: sRGB. Without a background network black shines through where nothing is opaque.
        opacity: of the surface, 0 where a ray misses the region of interest.
        crossing: whether the ray crosses the region of interest.
        background: whether there is a background network: without one the field says nothing where rays miss.
    """

    colors: UInt8[np.ndarray, "h w 3"]
    opacity: Float32[np.ndarray, "h w"]
    crossing: Bool[np.ndarray, "h w"]
    background: bool

    @property
    def drawn(self) -> Bool[np.ndarray, "h w"]:
        """Where the field says something."""
        return self.crossing | self.background


class FieldDrawer:
    """Draws a trained field at the end of its schedules; the same camera always gives the same picture.

    Exposure gains of single photos are left out: held-out photos have none.
    """

    def __init__(self, fields: Fields, params: TrainParams, device: torch.device | str) -> None:
        self.device = torch.device(device)
        fields = fields.to(device).eval().requires_grad_(False)
        cache = SdfCache(params.sampling.cache_resolution, device)
        self.renderer = Renderer(fields, cache, params, Terms(fields, cache, params))
        self.moment = self.renderer.moment(1.0)
        cache.refresh(lambda p: fields.sdf.sdf(p, self.moment.levels))

    @torch.no_grad()
    def draw(self, cameras: PinholeCameras, index: int) -> FieldDrawing:
        """The field as camera `index` sees it."""
        width, height = (int(side) for side in cameras.sizes[index])
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        rays = cameras.rays(index, np.stack([x.ravel(), y.ravel()], 1))
        origins, directions = (torch.from_numpy(each).float().to(self.device) for each in rays)
        parts = in_blocks(
            lambda part: self._rays(origins[part], directions[part]), len(origins), RAYS_AT_ONCE, RENDERED
        )
        colors, opacity, crossing = (torch.cat(each).cpu().numpy() for each in zip(*parts, strict=True))
        return FieldDrawing(
            (255 * colors.clip(0, 1) + 0.5).astype(np.uint8).reshape(height, width, 3),
            opacity.reshape(height, width),
            crossing.reshape(height, width),
            self.renderer.fields.background is not None,
        )

    def _rays(
        self, origins: Float[Tensor, "r 3"], directions: Float[Tensor, "r 3"]
    ) -> tuple[Float[Tensor, "r 3"], Float[Tensor, " r"], Bool[Tensor, " r"]]:
        """Colours and opacity of rays, and whether they cross the region."""
        background = self.renderer.fields.background
        colors, opacity = torch.zeros_like(origins), torch.zeros_like(origins[:, 0])
        entry, leave, hit = intersect_unit_sphere(origins, directions)
        crossing = torch.nonzero(hit).squeeze(1)
        if len(crossing):
            batch = RayBatch(
                origins[crossing], directions[crossing], entry[crossing], leave[crossing],
                crossing, torch.zeros_like(crossing), colors[crossing], None,
            )  # fmt: skip
            rendered = self.renderer.render(batch, self.moment)
            colors[crossing], opacity[crossing] = rendered.colors, rendered.opacity
        missing = torch.nonzero(~hit).squeeze(1)
        if background is not None and len(missing):
            colors[missing] = self.renderer.background_color(background, origins[missing], directions[missing], None)
        return colors, opacity, hit
