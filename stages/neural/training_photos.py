"""The photos as one flat tensor of pixels, and rays drawn from it without touching images one by one.

Shapes: I photos, T pixels of all photos together, R rays.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from stages.geometry.cameras import PinholeCameras
from stages.neural.acceleration import first_rows, fixed_shapes
from stages.neural.sampling import Rays, intersect_unit_sphere

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int, UInt8

# More rays are drawn than asked for, since some of a box's rays miss the sphere: a box is 4 / pi its ellipse.
_OVERDRAW = 1.5


@dataclass(frozen=True)
class RayBatch(Rays):
    """Rays and what the photos show there.

    Attributes:
        drawn: which of the rays asked for these are (those that miss the sphere are dropped).
        images: photo indices.
        colors: observed sRGB in [0, 1].
        masks: in [0, 1], or None when there are no masks.
    """

    drawn: Int[Tensor, " r"]
    images: Int[Tensor, " r"]
    colors: Float[Tensor, "r 3"]
    masks: Float[Tensor, " r"] | None

    def select(self, rows: slice) -> RayBatch:
        """Some of the rays."""

        def part(values: Any) -> Any:
            return None if values is None else values[rows]

        return RayBatch(*(part(getattr(self, each.name)) for each in fields(self)))


class Photos:
    """All pixels as uint8, all cameras as tensors.

    Attributes:
        training: the photos that rays are drawn from; the others are for judging what was learned.
    """

    def __init__(
        self,
        cameras: PinholeCameras,
        images: Iterable[UInt8[np.ndarray, "_ _ 3"]],
        masks: Iterable[UInt8[np.ndarray, "_ _"]] | None,
        device: torch.device | str,
        training: Bool[Tensor, " i"] | None = None,
    ) -> None:
        """images: of a shape [H, W, 3]; masks: [H, W]; training: None for all photos.

        Images and masks are taken one at a time, so that they need not all be held twice. Raises ValueError on sizes.
        """
        self.device = torch.device(device)
        self.pixels = _flat(cameras, images, (3,), self.device)
        self.masks = None if masks is None else _flat(cameras, masks, (), self.device)
        self.training = torch.ones(len(cameras), dtype=torch.bool) if training is None else training
        self.training = self.training.to(device)
        self._drawn = torch.nonzero(self.training).squeeze(1)
        counts = cameras.sizes.prod(1)
        self.first = torch.from_numpy(np.concatenate([[0], np.cumsum(counts)[:-1]])).to(device)
        self.sizes = torch.from_numpy(cameras.sizes).to(device)
        self.centers = torch.from_numpy(cameras.centers).float().to(device)
        inverse = np.linalg.inv(cameras.intrinsics)
        scene_from_pixel = np.einsum("nji,njk->nik", cameras.extrinsics[:, :, :3], inverse)
        self.scene_from_pixel = torch.from_numpy(scene_from_pixel).float().to(device)
        self.pixel_from_scene = torch.linalg.inv(self.scene_from_pixel)
        self.boxes = torch.from_numpy(_sphere_boxes(cameras)).float().to(device)

    def __len__(self) -> int:
        return len(self.first)

    def mask(self, index: int) -> UInt8[np.ndarray, "_ _"]:
        """The mask of a photo, where there are masks."""
        assert self.masks is not None
        width, height = self.sizes[index].tolist()
        first = int(self.first[index])
        return self.masks[first : first + width * height].view(height, width).cpu().numpy()

    def draw_pixels(
        self, num_rays: int, generator: torch.Generator
    ) -> tuple[Int[Tensor, " more"], Float[Tensor, "more 2"]]:
        """Photos and integer pixels in their boxes: so many that about `num_rays` of them cross the unit sphere."""
        count = int(num_rays * _OVERDRAW)
        images = self._drawn[torch.randint(len(self._drawn), (count,), generator=generator, device=self.device)]
        place = torch.rand(count, 2, generator=generator, device=self.device)
        low, high = self.boxes[images, :2], self.boxes[images, 2:]
        return images, (low + place * (high - low)).floor()

    def observe(self, points: Float[Tensor, "p 3"]) -> tuple[Float[Tensor, "p i 3"], Bool[Tensor, "p i"]]:
        """What every photo shows at scene points: colours in [0, 1] and whether it may show it.

        The nearest pixel. A photo cannot show a point that is out of frame, behind the camera or, where there are
        masks, off the photo's mask; the colour means nothing then.
        """
        in_pixels = torch.einsum("iab,pib->pia", self.pixel_from_scene, points[:, None] - self.centers)
        return self._shown(in_pixels, self.first, self.sizes)

    def colors_at(
        self, images: Int[Tensor, " r"], points: Float[Tensor, "r 3"]
    ) -> tuple[Float[Tensor, "r 3"], Bool[Tensor, " r"]]:
        """What one photo each shows at scene points, as `observe` does of all."""
        in_pixels = torch.bmm(self.pixel_from_scene[images], (points - self.centers[images]).unsqueeze(2)).squeeze(2)
        return self._shown(in_pixels, self.first[images], self.sizes[images])

    def _shown(
        self, in_pixels: Float[Tensor, "*any 3"], first: Int[Tensor, "*#any"], sizes: Int[Tensor, "*#any 2"]
    ) -> tuple[Float[Tensor, "*any 3"], Bool[Tensor, "*any"]]:
        """Colours at homogeneous pixels of photos with these first rows and sizes, and whether they may show them."""
        depth = in_pixels[..., 2]
        place = (in_pixels[..., :2] / depth.clamp(min=1e-6).unsqueeze(-1)).floor().long()
        inside = (depth > 0) & ((place >= 0) & (place < sizes)).all(-1)
        rows = (first + place[..., 1] * sizes[..., 0] + place[..., 0]).masked_fill(~inside, 0)
        if self.masks is not None:
            inside &= self.masks[rows] > 127
        return self.pixels[rows].float() / 255, inside

    def directions(self, images: Int[Tensor, " r"], pixels: Float[Tensor, "r 2"]) -> Float[Tensor, "r 3"]:
        """Unit directions of the rays through the centres of integer pixels (x, y) of photos."""
        homogeneous = torch.nn.functional.pad(pixels + 0.5, (0, 1), value=1.0)
        directions = torch.bmm(self.scene_from_pixel[images], homogeneous.unsqueeze(2)).squeeze(2)
        return torch.nn.functional.normalize(directions, dim=1)

    def rays(self, images: Int[Tensor, " r"], pixels: Float[Tensor, "r 2"], limit: int | None = None) -> RayBatch:
        """Rays through the centres of integer pixels (x, y) of photos; those that miss are dropped.

        With a limit the first that hit; on CUDA exactly as many: where fewer do, the first are taken again.
        """
        directions, origins = self.directions(images, pixels), self.centers[images]
        entry, leave, hit = intersect_unit_sphere(origins, directions)
        if limit is not None and fixed_shapes(self.device):
            kept = first_rows(hit, limit)
        else:
            kept = torch.nonzero(hit).squeeze(1)[:limit]
        images, pixels = images[kept], pixels[kept].long()
        rows = self.first[images] + pixels[:, 1] * self.sizes[images, 0] + pixels[:, 0]
        colors = self.pixels[rows].float() / 255
        masks = None if self.masks is None else self.masks[rows].float() / 255
        return RayBatch(origins[kept], directions[kept], entry[kept], leave[kept], kept, images, colors, masks)


def _flat(
    cameras: PinholeCameras, images: Iterable[np.ndarray], channels: tuple[int, ...], device: torch.device
) -> Tensor:
    """All images [H, W, *channels] uint8 as one tensor of pixels [T, *channels].

    Raises ValueError where one has not its camera's size.
    """
    pixels = torch.empty((int(cameras.sizes.prod(1).sum()), *channels), dtype=torch.uint8, device=device)
    first = 0
    for name, (width, height), image in zip(cameras.names, cameras.sizes, images, strict=True):
        if image.shape != (height, width, *channels):
            raise ValueError(f"{name}: got shape {image.shape}, expected {(int(height), int(width), *channels)}")
        count = height * width
        pixels[first : first + count] = torch.from_numpy(np.ascontiguousarray(image).reshape(count, *channels))
        first += count
    return pixels


def _sphere_boxes(cameras: PinholeCameras) -> Float[np.ndarray, "i 4"]:
    """x0, y0, x1, y1: the part of each photo that can show the unit sphere, in pixels."""
    longitude, latitude = np.meshgrid(np.linspace(0, 2 * np.pi, 64), np.linspace(-np.pi / 2, np.pi / 2, 33))
    # Slightly larger than the sphere, so that the polyhedron's faces do not cut it.
    ball = 1.01 * np.stack(
        [np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)], -1
    ).reshape(-1, 3)
    boxes = np.zeros((len(cameras), 4))
    for i in range(len(cameras)):
        width, height = cameras.sizes[i]
        pixels, depth = cameras.project(i, ball)
        if np.any(depth <= 0.01):  # the camera stands in the sphere or touches it: any pixel may show it
            boxes[i] = 0, 0, width, height
            continue
        low = np.clip(np.floor(pixels.min(0)), 0, [width - 1, height - 1])
        high = np.clip(np.ceil(pixels.max(0)), low + 1, [width, height])
        boxes[i] = *low, *high
    return boxes
