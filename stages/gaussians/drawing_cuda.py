"""What `drawing` does, by gsplat on a GPU (extra `splats`). The refining takes either.

gsplat knows no skew; the pipeline's cameras have none.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

from stages.gaussians.drawing import WHITE, Camera, Gradients
from stages.gaussians.gaussians import Gaussians

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(frozen=True)
class CudaDrawing:
    """An image of Gaussians, as `drawing.Drawing` has it, and what torch needs to lead its gradient back.

    Attributes:
        leaves: the Gaussians' arrays by name, on the GPU.
        outputs: image [H, W, 3] and transmittance [H, W] there.
        about: what gsplat tells of the ellipses.
    """

    image: np.ndarray
    transmittance: np.ndarray
    leaves: dict[str, Tensor]
    outputs: tuple[Tensor, Tensor]
    about: dict[str, Any]


def is_there() -> bool:
    """Whether gsplat is installed."""
    return find_spec("gsplat") is not None


def render(gaussians: Gaussians, camera: Camera, background: tuple[float, float, float] = WHITE) -> CudaDrawing:
    """Draw, and keep what `gradients` needs."""
    import torch
    from gsplat import rasterization

    names = ("centers", "rotations", "log_scales", "opacity_logits", "harmonics")
    leaves = {name: torch.tensor(getattr(gaussians, name), device="cuda", requires_grad=True) for name in names}
    pose = torch.eye(4, device="cuda")
    pose[:3] = torch.tensor(camera.pose)
    intrinsics = torch.eye(3, device="cuda")
    intrinsics[0, 0], intrinsics[1, 1] = float(camera.focal[0]), float(camera.focal[2])
    intrinsics[:2, 2] = torch.tensor(camera.middle)
    images, alphas, about = rasterization(
        leaves["centers"], leaves["rotations"], leaves["log_scales"].exp(), leaves["opacity_logits"].sigmoid(),
        leaves["harmonics"], pose[None], intrinsics[None], camera.width, camera.height,
        sh_degree=gaussians.degree, backgrounds=torch.tensor([background], device="cuda"), packed=False,
    )  # fmt: skip
    about["means2d"].retain_grad()
    outputs = images[0], 1 - alphas[0, ..., 0]
    image, transmittance = (output.detach().cpu().numpy() for output in outputs)
    return CudaDrawing(image, transmittance, leaves, outputs, about)


def gradients(
    gaussians: Gaussians, drawing: CudaDrawing, d_image: np.ndarray, d_transmittance: np.ndarray
) -> Gradients:
    """As `drawing.gradients`."""
    import torch

    slopes = [torch.tensor(slope, device="cuda") for slope in (d_image, d_transmittance)]
    torch.autograd.backward(drawing.outputs, slopes)
    means = drawing.about["means2d"].grad[0]
    of_harmonics = drawing.leaves["harmonics"].grad
    assert of_harmonics is not None  # every drawing depends on them
    shows = torch.any(means != 0, 1) | torch.any(of_harmonics.flatten(1) != 0, 1)
    ids = torch.nonzero(shows).squeeze(1)
    found = {name: leaf.grad[ids].cpu().numpy() for name, leaf in drawing.leaves.items() if leaf.grad is not None}
    return Gradients(ids=ids.cpu().numpy().astype(np.int32), means=means[ids].cpu().numpy(), **found)
