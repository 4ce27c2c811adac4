"""The trained field as cameras see it: whole photos, rendered as in training."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from configs.training import TrainParams
from stages.geometry.cameras import PinholeCameras
from stages.neural.fields import Fields, points_at_a_time
from stages.neural.renderer import Renderer
from stages.neural.sampling import SdfCache, intersect_unit_sphere
from stages.neural.terms import Terms
from stages.neural.training_photos import RayBatch

_RAYS = 4096  # rendered at a time


@dataclass(frozen=True)
class FieldDrawing:
    """What one camera sees of the field.

    Attributes:
        colors: [H, W, 3] uint8 sRGB. Without a background network black shines through where nothing is opaque.
        opacity: [H, W] float32 of the surface, 0 where a ray misses the region of interest.
        crossing: [H, W] bool, the ray crosses the region of interest.
        background: whether there is a background network: without one the field says nothing where rays miss.
    """

    colors: np.ndarray
    opacity: np.ndarray
    crossing: np.ndarray
    background: bool

    @property
    def drawn(self) -> np.ndarray:
        """[H, W] bool, where the field says something."""
        return self.crossing | self.background


class FieldDrawer:
    """Draws a trained field at the end of its schedules; the same camera always gives the same picture.

    Exposure gains of single photos are left out: photos that were held back have none.
    """

    def __init__(self, fields: Fields, params: TrainParams, device: torch.device | str) -> None:
        self.device = torch.device(device)
        fields = fields.to(device).eval().requires_grad_(False)
        cache = SdfCache(params.sampling.cache_resolution, device)
        self.renderer = Renderer(fields, cache, params, Terms(fields, cache, params))
        self.moment = self.renderer.moment(1.0)
        cache.refresh(lambda p: fields.sdf.sdf(p, self.moment.levels), None, points_at_a_time(self.device))

    @torch.no_grad()
    def draw(self, cameras: PinholeCameras, index: int) -> FieldDrawing:
        """The field as camera `index` sees it."""
        width, height = (int(side) for side in cameras.sizes[index])
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        rays = cameras.rays(index, np.stack([x.ravel(), y.ravel()], 1))
        origins, directions = (torch.from_numpy(each).float().to(self.device) for each in rays)
        parts = [self._rays(*each) for each in zip(origins.split(_RAYS), directions.split(_RAYS), strict=True)]
        colors, opacity, crossing = (torch.cat(each).cpu().numpy() for each in zip(*parts, strict=True))
        return FieldDrawing(
            (255 * colors.clip(0, 1) + 0.5).astype(np.uint8).reshape(height, width, 3),
            opacity.reshape(height, width),
            crossing.reshape(height, width),
            self.renderer.fields.background is not None,
        )

    def _rays(self, origins: torch.Tensor, directions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Colours [R, 3], opacity [R], and whether they cross the region [R] bool, of rays [R, 3]."""
        count, background = len(origins), self.renderer.fields.background
        colors, opacity = (torch.zeros(count, n, device=self.device) for n in (3, 1))
        entry, leave, hit = intersect_unit_sphere(origins, directions)
        crossing = torch.nonzero(hit).squeeze(1)
        if len(crossing):
            batch = RayBatch(
                crossing, torch.zeros_like(crossing), origins[crossing], directions[crossing], entry[crossing],
                leave[crossing], colors[crossing], None,
            )  # fmt: skip
            rendered = self.renderer.render(batch, self.moment, torch.zeros(0, 3, device=self.device), None)
            colors[crossing], opacity[crossing, 0] = rendered.colors, rendered.opacity
        missing = torch.nonzero(~hit).squeeze(1)
        if background is not None and len(missing):
            colors[missing] = self.renderer.background_color(background, origins[missing], directions[missing], None)
        return colors, opacity.squeeze(1), hit
