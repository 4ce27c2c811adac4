"""Drawing Gaussians and its gradient, against a slow loop that differentiates itself."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.gaussians.drawing import camera_of, draw, gradients, render
from stages.gaussians.gaussians import Gaussians
from stages.geometry.cameras import PinholeCameras

pytestmark = pytest.mark.slow  # the kernels' compilation

BACKGROUND = (0.2, 0.5, 0.9)
FIELDS = ("centers", "rotations", "log_scales", "opacity_logits", "harmonics")
C0, C1 = 0.28209479177387814, 0.4886025119029199
# In the polynomials of 3DGS (Kerbl et al.), as its `sh_utils` has them.
C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
C3 = (
    -0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154, -0.4570457994644658,
    1.445305721320277, -0.5900435899266435,
)  # fmt: skip


def some_cameras(width: int = 21, height: int = 18) -> PinholeCameras:
    """One camera three units before the origin, its principal point beside the middle."""
    intrinsics = np.array([[[22.0, 0.3, 11.0], [0, 23.0, 8.0], [0, 0, 1]]])
    turn = np.linalg.qr(np.eye(3) + 0.1 * np.array([[0, 1, -1], [-1, 0, 1], [1, -1, 0]]))[0]
    turn *= np.sign(np.diag(turn))[:, None]
    extrinsics = np.concatenate([turn, [[0.1], [-0.1], [3.0]]], 1)[None]
    return PinholeCameras(("a",), np.array([[width, height]]), intrinsics, extrinsics)


def some_gaussians(count: int, degree: int = 3, seed: int = 0) -> Gaussians:
    """All around, one of them behind the camera, one far to the side and one all but opaque."""
    rng = np.random.default_rng(seed)
    centers = rng.normal(0, 0.6, (count, 3))
    centers[0] = (0.0, 0.0, -9.0)
    centers[1] = (2.6, 0.1, -0.9)
    logits = rng.normal(0.5, 1.5, count)
    logits[2] = 12.0
    harmonics = rng.normal(0, 0.25, (count, (degree + 1) ** 2, 3))
    log_scales = rng.normal(-2.0, 0.5, (count, 3))
    arrays = (centers, rng.normal(0, 1, (count, 4)), log_scales, logits, harmonics)
    return Gaussians(*(array.astype(np.float32) for array in arrays), np.ones(count, bool))


def slow_basis(d: torch.Tensor, count: int) -> torch.Tensor:
    x, y, z = d
    values = [
        torch.full_like(x, C0), -C1 * y, C1 * z, -C1 * x,
        C2[0] * x * y, C2[1] * y * z, C2[2] * (2 * z * z - x * x - y * y), C2[3] * x * z, C2[4] * (x * x - y * y),
        C3[0] * y * (3 * x * x - y * y), C3[1] * x * y * z, C3[2] * y * (4 * z * z - x * x - y * y),
        C3[3] * z * (2 * z * z - 3 * x * x - 3 * y * y), C3[4] * x * (4 * z * z - x * x - y * y),
        C3[5] * z * (x * x - y * y), C3[6] * x * (x * x - 3 * y * y),
    ]  # fmt: skip
    return torch.stack(values[:count])


def slow_rotation(q: torch.Tensor) -> torch.Tensor:
    w, x, y, z = q / q.norm()
    return torch.stack(
        [
            1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
            2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
            2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
        ]
    ).reshape(3, 3)  # fmt: skip


def slow_draw(arrays: dict[str, torch.Tensor], cameras: PinholeCameras) -> tuple[torch.Tensor, torch.Tensor]:
    """Image [H, W, 3] and transmittance [H, W], one pixel after the other, by the equations of the paper."""
    K, pose = (torch.tensor(m[0]) for m in (cameras.intrinsics, cameras.extrinsics))
    position = torch.tensor(cameras.centers[0])
    width, height = cameras.sizes[0].tolist()
    ellipses = []
    for n in range(len(arrays["centers"])):
        center = arrays["centers"][n]
        x, y, z = pose[:, :3] @ center + pose[:, 3]
        opacity = torch.sigmoid(arrays["opacity_logits"][n])
        if z <= 0.01:
            continue
        half_x, half_y = 0.5 * width / K[0, 0], 0.5 * height / K[1, 1]
        u = (x / z).clamp(-K[0, 2] / K[0, 0] - 0.3 * half_x, (width - K[0, 2]) / K[0, 0] + 0.3 * half_x)
        v = (y / z).clamp(-K[1, 2] / K[1, 1] - 0.3 * half_y, (height - K[1, 2]) / K[1, 1] + 0.3 * half_y)
        zero = torch.zeros_like(z)
        J = torch.stack(
            [
                torch.stack([K[0, 0] / z, K[0, 1] / z, -(K[0, 0] * u + K[0, 1] * v) / z]),
                torch.stack([zero, K[1, 1] / z, -K[1, 1] * v / z]),
            ]
        )
        axes = slow_rotation(arrays["rotations"][n]) * arrays["log_scales"][n].exp()
        flat = J @ pose[:, :3] @ axes
        covariance = flat @ flat.T + 0.3 * torch.eye(2)
        mean = torch.stack([(K[0, 0] * x + K[0, 1] * y) / z + K[0, 2], K[1, 1] * y / z + K[1, 2]])
        direction = (center - position) / (center - position).norm()
        harmonics = arrays["harmonics"][n]
        color = (0.5 + slow_basis(direction, len(harmonics)) @ harmonics).clamp_min(0)
        ellipses.append((float(z.detach()), mean, torch.linalg.inv(covariance), opacity, color))
    ellipses.sort(key=lambda ellipse: ellipse[0])
    rows, opens = [], []
    for row in range(height):
        for column in range(width):
            pixel = torch.tensor([column + 0.5, row + 0.5])
            color, open_ = torch.zeros(3), torch.tensor(1.0)
            for _, mean, conic, opacity, own in ellipses:
                offset = pixel - mean
                alpha = (opacity * torch.exp(-0.5 * offset @ conic @ offset)).clamp_max(0.999)
                if alpha < 1 / 255:
                    continue
                if open_ * (1 - alpha) < 1e-4:
                    break
                color = color + open_ * alpha * own
                open_ = open_ * (1 - alpha)
            rows.append(color + open_ * torch.tensor(BACKGROUND))
            opens.append(open_)
    return torch.stack(rows).reshape(height, width, 3), torch.stack(opens).reshape(height, width)


@pytest.fixture(autouse=True)
def double_precision():
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(before)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_drawing_and_its_gradient_are_those_of_the_slow_loop(degree):
    gaussians, cameras = some_gaussians(25, degree), some_cameras()
    arrays = {name: torch.tensor(getattr(gaussians, name), dtype=torch.float64) for name in FIELDS}
    for array in arrays.values():
        array.requires_grad_()
    image, open_ = slow_draw(arrays, cameras)
    rng = np.random.default_rng(1)
    d_image, d_open = rng.normal(0, 1, image.shape), rng.normal(0, 1, open_.shape)
    ((image * torch.tensor(d_image)).sum() + (open_ * torch.tensor(d_open)).sum()).backward()

    drawing = render(gaussians, camera_of(cameras, 0), BACKGROUND)
    np.testing.assert_allclose(drawing.image, image.detach(), atol=2e-5)
    np.testing.assert_allclose(drawing.transmittance, open_.detach(), atol=1e-5)
    found = gradients(gaussians, drawing, d_image.astype(np.float32), d_open.astype(np.float32))
    assert len(found.ids) > 15
    assert 0 not in found.ids
    for name in FIELDS:
        truth = arrays[name].grad.numpy()
        assert np.abs(truth).max() > 0
        dense = np.zeros_like(truth)
        dense[found.ids] = getattr(found, name)
        np.testing.assert_allclose(dense, truth, atol=2e-4 * np.abs(truth).max(), err_msg=name)


def test_what_draws_is_cut_to_an_image():
    gaussians = some_gaussians(25)
    bright = replace(gaussians, harmonics=gaussians.harmonics + 5)
    image, alpha = draw(bright, some_cameras(), 0, (0.0, 0.0, 0.0))
    assert image.shape == (18, 21, 3)
    assert alpha.shape == (18, 21)
    assert image.max() == 1
    assert image.min() >= 0
    assert alpha.min() >= 0
    assert alpha.max() <= 1
    assert (image[alpha == 0] == 0).all()
    assert (alpha == 0).any()


def test_no_gaussian_in_sight_leaves_the_background():
    image, alpha = draw(some_gaussians(3).select(np.array([0])), some_cameras(), 0, BACKGROUND)
    assert np.allclose(image, BACKGROUND)
    assert not alpha.any()


def test_the_number_of_threads_changes_nothing():
    import numba

    gaussians, cameras = some_gaussians(300), some_cameras(160, 120)
    answers, before = [], numba.get_num_threads()
    try:
        for threads in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
            numba.set_num_threads(threads)
            drawing = render(gaussians, camera_of(cameras, 0))
            ones = np.ones_like(drawing.image)
            answers.append((drawing.image, gradients(gaussians, drawing, ones, ones[..., 0]).centers))
    finally:
        numba.set_num_threads(before)
    for one, other in zip(*answers, strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.gpu
def test_gsplat_draws_the_same_and_leads_back_the_same():
    pytest.importorskip("gsplat")
    from stages.gaussians import drawing_cuda

    cameras = some_cameras(160, 120)
    cameras.intrinsics[0] = [[150, 0, 83], [0, 155, 58], [0, 0, 1]]
    gaussians, camera = some_gaussians(2000), camera_of(cameras, 0)
    rng = np.random.default_rng(1)
    d_image, d_open = rng.normal(0, 1, (120, 160, 3)).astype(np.float32), np.zeros((120, 160), np.float32)
    ours, theirs = render(gaussians, camera, BACKGROUND), drawing_cuda.render(gaussians, camera, BACKGROUND)
    # A pixel that one of both is done with an ellipse earlier differs by less than what was left open.
    assert np.quantile(np.abs(ours.image - theirs.image), 0.999) < 1e-3
    found = gradients(gaussians, ours, d_image, d_open)
    other = drawing_cuda.gradients(gaussians, theirs, d_image, d_open)
    for name in FIELDS:
        dense = [np.zeros_like(getattr(gaussians, name)) for _ in range(2)]
        for array, each in zip(dense, (found, other), strict=True):
            array[each.ids] = getattr(each, name)
        assert np.quantile(np.abs(dense[0] - dense[1]), 0.99) < 1e-2 * np.abs(dense[0]).max()
