"""How well a textured mesh, drawn from where a photo was taken, meets that photo.

Shapes: H x W pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from stages.artifacts import AtlasMesh
from stages.drawing.rasterizing import NO_FACE, depth_map
from stages.drawing.rendering import render_textured
from stages.geometry.cameras import PinholeCameras

# Samples along a pixel's side: textures are finer than the photos.
SUPERSAMPLE = 4
# A photo met exactly has 100 dB.
SMALLEST_ERROR = 1e-10
SSIM_SIGMA = 1.5  # Wang et al. 2004, pixels


@dataclass(frozen=True)
class ScoredView:
    """A drawing against its photo.

    Attributes:
        name: of the photo.
        photo, drawing: [H, W, 3] uint8.
        counted: [H, W] bool, the pixels that count.
        psnr: dB.
        ssim: mean structural similarity.
    """

    name: str
    photo: np.ndarray
    drawing: np.ndarray
    counted: np.ndarray
    psnr: float
    ssim: float


def psnr(image: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB of [H, W, 3] uint8 images over the pixels of `mask` [H, W] bool.

    Raises:
        ValueError: the mask is empty.
    """
    if not mask.any():
        raise ValueError("expected a mask with pixels, got an empty one")
    error = (image[mask].astype(np.float64) - truth[mask]) / 255.0
    return float(-10 * np.log10(max((error**2).mean(), SMALLEST_ERROR)))


def ssim(image: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    """Mean structural similarity (Wang et al. 2004, Gaussian windows) of [H, W, 3] uint8 images over `mask` [H, W].

    Windows reach beyond the mask; both images are black there, so that what lies around the object says nothing.

    Raises:
        ValueError: the mask is empty, or an image is smaller than a window.
    """
    from skimage.metrics import structural_similarity

    if not mask.any():
        raise ValueError("expected a mask with pixels, got an empty one")
    _, similarity = structural_similarity(
        image * mask[..., None], truth * mask[..., None], channel_axis=2, full=True, gaussian_weights=True,
        sigma=SSIM_SIGMA, use_sample_covariance=False, data_range=255,
    )  # fmt: skip
    return float(similarity[mask].mean())


def silhouette(vertices: np.ndarray, faces: np.ndarray, cameras: PinholeCameras, index: int) -> np.ndarray:
    """Pixels [H, W] bool of a camera that the mesh covers."""
    face_map, _ = depth_map(cameras, index, vertices, faces)
    return face_map != NO_FACE


def draw_view(atlas: AtlasMesh, texture: np.ndarray, cameras: PinholeCameras, index: int) -> np.ndarray:
    """The textured mesh as a camera sees it: [H, W, 3] uint8, white where there is none.

    Args:
        texture: [S, S, 3] uint8 sRGB, row 0 at v = 1.
    """
    camera = cameras.select([index])
    return render_textured(atlas, texture, camera, supersample=SUPERSAMPLE)


def score_views(
    atlas: AtlasMesh,
    texture: np.ndarray,
    cameras: PinholeCameras,
    load_photo: Callable[[int], tuple[np.ndarray, np.ndarray | None]],
    names: Iterable[str],
) -> Iterator[ScoredView]:
    """The textured mesh against photos, inside the object's mask, or the mesh's silhouette where there is no mask.

    Args:
        texture: [S, S, 3] uint8 sRGB, row 0 at v = 1.
        load_photo: camera -> photo [H, W, 3] uint8 and mask [H, W] bool or None.
        names: of the photos to score; those with no pixel that counts are left out.
    """
    for name in names:
        index = cameras.names.index(name)
        photo, mask = load_photo(index)
        counted = silhouette(atlas.vertices, atlas.faces, cameras, index) if mask is None else mask
        if counted.any():
            drawing = draw_view(atlas, texture, cameras, index)
            scores = psnr(drawing, photo, counted), ssim(drawing, photo, counted)
            yield ScoredView(name, photo, drawing, counted, *scores)
