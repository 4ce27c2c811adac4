"""Do the photos show the same around a surface point? Patches are warped from photo to photo by the surface's tangent
plane (NeuralWarp, Darmon et al. 2022; Geo-NeuS, Fu et al. 2022).

Shapes: Q rays with a surface point each, I photos, M of them beside the ray's own, P pixels of a patch.

A plane m [Q, 3] is given in the pixels of the ray's own photo: m.p is the inverse depth of the homogeneous pixel
p = (x, y, 1). In another photo p lies at H p + (m.p) e, where H [3, 3] takes it for infinitely far, and e [3] is the
image of the ray's camera. So a patch's place there, and with it the error, is a function of three numbers.
"""

from __future__ import annotations

import torch

from stages.neural.acceleration import takes_kernel
from stages.neural.training_photos import Photos

# A patch is 7 x 7 pixels: this many steps to either side.
HALF = 3
# Variance of grey values in [0, 1] below which a patch says little: 8 levels of 255. Faint shading is no texture.
NOISE_VARIANCE = 1e-3
# Error of a patch that leaves one of the two photos.
NO_PATCH = -1.0
# Luma of red, green and blue (BT.601).
LUMA = (0.299, 0.587, 0.114)
# Other photos look from about this far aside (cosine of 25 degrees): near enough to see the same, far enough for depth.
_IDEAL_COSINE = 0.9
# Nearer than this (5 degrees) a patch says nothing of depth; flatter than this (n.d) it is too foreshortened.
_NEAREST_COSINE, _LEAST_FACING = 0.9962, 0.2
# Depth of a plane or a pixel below which it counts as through, or behind, a camera; scene units.
_LEAST_DEPTH, _LEAST_FORWARD = 1e-3, 1e-6
# A Newton step to the surface where the ray meets it more steeply than this, and no longer than that, scene units.
_LEAST_SLOPE, _LONGEST_STEP = 0.1, 0.02
# Errors of fewer photos than this say nothing: one may be hidden, or mirror something.
_LEAST_VIEWS = 2
# Of two places that do not match the error is about 1: from there on a photo is taken to show something else.
_NO_MATCH = 1.0
# lambda at which a patch counts half: between textured cloth or plaster (0.15 to 0.4) and polished metal (about 1).
_DOUBT = 0.5


def slide_to_surface(
    points: torch.Tensor, directions: torch.Tensor, sdf: torch.Tensor, gradients: torch.Tensor
) -> torch.Tensor:
    """Points [Q, 3] moved along their rays to where f = 0, by one Newton step: x - f / (g.v) v.

    Differentiable with respect to f [Q], with dx/df = -v / (g.v) as on the true level set; g.v is detached. Points stay
    where the ray grazes the surface or leaves the solid, and go 0.02 units at most.
    """
    slope = (gradients * directions).sum(1).detach()
    steep = slope < -_LEAST_SLOPE
    step = (-sdf / torch.where(steep, slope, -1.0)).clamp(-_LONGEST_STEP, _LONGEST_STEP)
    return points + (step * steep)[:, None] * directions


def views_beside(
    centers: torch.Tensor,
    points: torch.Tensor,
    normals: torch.Tensor,
    directions: torch.Tensor,
    candidates: torch.Tensor,
    count: int,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Of photos with centres [I, 3] those that look at points [Q, 3] with normals [Q, 3] from beside their rays.

    Returns their indices [Q, M], the cosines n.d [Q, M] towards them, and whether each may serve [Q, M]: it is one of
    the candidates [Q, I], and looks neither along the ray's direction [Q, 3] nor along the surface. M is `count`, or I
    where that is less; those nearest to 25 degrees aside are taken.
    """
    to_cameras = torch.nn.functional.normalize(centers - points[:, None], dim=2)
    facing = torch.einsum("qa,qia->qi", normals, to_cameras)
    aside = -torch.einsum("qa,qia->qi", directions, to_cameras)
    fit = candidates & (facing > _LEAST_FACING) & (aside < _NEAREST_COSINE)
    rank = torch.where(fit, (aside - _IDEAL_COSINE).abs(), torch.inf)
    views = rank.topk(min(count, len(centers)), dim=1, largest=False).indices
    return views, facing.gather(1, views), fit.gather(1, views)


def pixels_of(photos: Photos, images: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """The pixels [Q, 2] (int64; x, y) of photos [Q] that show points [Q, 3] before their cameras."""
    homogeneous = torch.einsum("qab,qb->qa", photos.pixel_from_scene[images], points - photos.centers[images])
    return (homogeneous[:, :2] / homogeneous[:, 2:]).floor().long()


def tangent_planes(photos: Photos, images: torch.Tensor, points: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
    """Planes m [Q, 3] through points with unit normals [Q, 3], in the pixels of photos [Q].

    A plane through the photo's centre has no such m: its distance is held away from 0.
    """
    distance = ((points - photos.centers[images]) * normals).sum(1, keepdim=True)
    plane = normals / torch.where(distance.abs() < _LEAST_DEPTH, _LEAST_DEPTH, distance)
    return torch.bmm(photos.scene_from_pixel[images].transpose(1, 2), plane.unsqueeze(2)).squeeze(2)


def patch_errors(
    photos: Photos, images: torch.Tensor, pixels: torch.Tensor, planes: torch.Tensor, views: torch.Tensor, step: int
) -> torch.Tensor:
    """1 - (cov + e) / sqrt((var_i + e) (var_j + e)) [Q, M]: how much two photos differ around a surface point.

    Grey values of 7 x 7 pixels, `step` apart, around pixels [Q, 2] (int64; x, y) of photos [Q], against what photos
    `views` [Q, M] show at the same places of the planes [Q, 3]; e = `NOISE_VARIANCE`. One minus the normalised
    cross-correlation: 0 for equal patches and, thanks to e, about 0 for flat ones; 1 for unrelated ones, up to 2;
    `NO_PATCH` where the patch leaves a photo. Differentiable with respect to the planes.
    """
    homographies = torch.einsum("qmab,qbc->qmac", photos.pixel_from_scene[views], photos.scene_from_pixel[images])
    shifts = photos.centers[images][:, None] - photos.centers[views]
    epipoles = torch.einsum("qmab,qmb->qma", photos.pixel_from_scene[views], shifts)
    arguments = (photos, images, pixels, planes, views, homographies.contiguous(), epipoles.contiguous(), step)
    return _KernelErrors.apply(*arguments) if takes_kernel(planes) else patch_errors_reference(*arguments)


def patch_errors_reference(
    photos: Photos,
    images: torch.Tensor,
    pixels: torch.Tensor,
    planes: torch.Tensor,
    views: torch.Tensor,
    homographies: torch.Tensor,
    epipoles: torch.Tensor,
    step: int,
) -> torch.Tensor:
    """`patch_errors` in plain torch, with homographies [Q, M, 3, 3] and epipoles [Q, M, 3].

    The reference of the kernel, and the path on CUDA.
    """
    line = step * torch.arange(-HALF, HALF + 1, device=planes.device)
    patch = torch.stack(torch.meshgrid(line, line, indexing="xy"), 2).view(-1, 2)
    places = pixels[:, None] + patch  # [Q, P, 2]
    own_inside = ((places >= 0) & (places < photos.sizes[images][:, None])).flatten(1).all(1)
    rows = photos.first[images][:, None] + places[..., 1] * photos.sizes[images, :1] + places[..., 0]
    own = _grey(photos, rows.masked_fill(~own_inside[:, None], 0))

    homogeneous = torch.nn.functional.pad(places + 0.5, (0, 1), value=1.0).to(planes.dtype)
    inverse_depth = (homogeneous @ planes.unsqueeze(2)).squeeze(2)
    warped = torch.einsum("qmab,qpb->qmpa", homographies.to(planes.dtype), homogeneous)
    warped = warped + inverse_depth[:, None, :, None] * epipoles[:, :, None]
    in_front = warped[..., 2] > _LEAST_FORWARD
    position = warped[..., :2] / torch.where(in_front, warped[..., 2], 1.0).unsqueeze(3) - 0.5
    last = photos.sizes[views][:, :, None] - 1
    whole = (in_front & (position >= 0).all(3) & (position < last).all(3)).all(2) & own_inside[:, None]
    other = _bilinear(photos, views, torch.where(whole[:, :, None, None], position, 0.0))

    own, other = own - own.mean(1, keepdim=True), other - other.mean(2, keepdim=True)
    variance, other_variance = own.square().mean(1)[:, None] + NOISE_VARIANCE, other.square().mean(2) + NOISE_VARIANCE
    covariance = (own[:, None] * other).mean(2) + NOISE_VARIANCE
    return torch.where(whole, 1 - covariance / (variance * other_variance).sqrt(), NO_PATCH)


def mean_of_best(errors: torch.Tensor, valid: torch.Tensor, count: int) -> torch.Tensor:
    """Mean [Q] of the `count` smallest valid errors [Q, M] below 1; 0 where fewer than two are.

    The others may be hidden, or mirror something else.
    """
    ranked = torch.where(valid, errors.detach(), torch.inf).topk(min(count, errors.shape[1]), dim=1, largest=False)
    kept = ranked.values < _NO_MATCH
    number = kept.sum(1)
    mean = torch.where(kept, errors.gather(1, ranked.indices), 0.0).sum(1) / number.clamp(min=1)
    return mean * (number >= _LEAST_VIEWS)


def patch_trust(lambda_ambiguity: torch.Tensor) -> torch.Tensor:
    """Weight [Q] of a patch's error: sg[1 / (1 + (lambda / 0.5)^4)].

    Photos that disagree on the colour of a place (the paper's lambda_ambiguity) mirror something there: where the
    patches match then is not where the surface is.
    """
    return 1 / (1 + (lambda_ambiguity.detach() / _DOUBT) ** 4)


def _grey(photos: Photos, rows: torch.Tensor) -> torch.Tensor:
    """Grey values [...] in [0, 1] of rows [...] of the photos' pixels."""
    red, green, blue = (photos.pixels[rows].float() / 255).unbind(-1)
    return LUMA[0] * red + LUMA[1] * green + LUMA[2] * blue


def _bilinear(photos: Photos, views: torch.Tensor, position: torch.Tensor) -> torch.Tensor:
    """Grey values [Q, M, P] of photos [Q, M] at positions [Q, M, P, 2], pixels from the first pixel's centre."""
    corner = position.detach().long()
    x, y = (position - corner).unbind(3)
    width = photos.sizes[views][:, :, None, 0]
    row = photos.first[views][:, :, None] + corner[..., 1] * width + corner[..., 0]
    v00, v01, v10, v11 = (_grey(photos, row + dy * width + dx) for dy in (0, 1) for dx in (0, 1))
    return torch.lerp(torch.lerp(v00, v01, x), torch.lerp(v10, v11, x), y)


class _KernelErrors(torch.autograd.Function):
    """`patch_errors` with its slope in one pass: the plane has three numbers, so the whole Jacobian is kept."""

    @staticmethod
    def forward(ctx, photos, images, pixels, planes, views, homographies, epipoles, step):
        from stages.neural import kernels

        errors = torch.empty(views.shape)
        slopes = torch.empty(*views.shape, 3)
        kernels.patch_errors(
            photos.pixels.numpy(), photos.first.numpy(), photos.sizes.numpy(), images.numpy(), pixels.numpy(),
            planes.detach().numpy(), views.numpy(), homographies.numpy(), epipoles.numpy(),
            HALF, step, NOISE_VARIANCE, _LEAST_FORWARD, NO_PATCH, LUMA, errors.numpy(), slopes.numpy(),
        )  # fmt: skip
        ctx.save_for_backward(slopes)
        return errors

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad_errors):
        (slopes,) = ctx.saved_tensors
        return None, None, None, (grad_errors.unsqueeze(2) * slopes).sum(1), None, None, None, None
