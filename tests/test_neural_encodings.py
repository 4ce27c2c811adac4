"""The hash encoding: kernels against the reference, the Jacobian against finite differences, edges."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from stages.neural.encodings import HashGrid, encode, encode_features, encode_reference

GRID = HashGrid(levels=5, features=4, log2_rows=10, coarsest=4, finest=40)


def noise_table(grid: HashGrid, dtype=torch.float32) -> torch.Tensor:
    return torch.randn(grid.num_rows, grid.features, generator=torch.Generator().manual_seed(0), dtype=dtype)


def random_points(count: int, dtype=torch.float32) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(1), dtype=dtype) * 2 - 1


def test_grid_uses_dense_rows_while_they_fit():
    assert GRID.dense.tolist() == [True, True, False, False, False]
    assert GRID.resolutions[0] == 4
    assert GRID.resolutions[-1] == 40
    assert GRID.offsets[1] == 5**3
    assert GRID.voxel_size() == pytest.approx(2 / 40)


EDGES = torch.tensor([[-1.0, -1, -1], [1, 1, 1], [0, 0, 0], [1, -1, 0.5], [-0.5, 0.5, 1], [2, -3, 0.1]])


@pytest.mark.parametrize("active", [1, 3, 5])
@pytest.mark.parametrize("points", [random_points(700), EDGES], ids=["random", "edges"])
def test_kernels_agree_with_the_reference(points, active):
    table, reference_table = (noise_table(GRID).requires_grad_() for _ in range(2))
    features, jacobian = encode(points, table, GRID, active)
    expected_features, expected_jacobian = encode_reference(points, reference_table, GRID, active)
    torch.testing.assert_close(features, expected_features, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(jacobian, expected_jacobian, rtol=1e-5, atol=1e-4)

    pull = torch.randn(features.shape, generator=torch.Generator().manual_seed(2))
    pull_jacobian = torch.randn(jacobian.shape, generator=torch.Generator().manual_seed(3))
    ((features * pull).sum() + (jacobian * pull_jacobian).sum()).backward()
    ((expected_features * pull).sum() + (expected_jacobian * pull_jacobian).sum()).backward()
    scale = reference_table.grad.abs().max()
    torch.testing.assert_close(table.grad / scale, reference_table.grad / scale, rtol=1e-5, atol=1e-5)


def test_features_alone_agree_with_the_full_encoding():
    points = random_points(300)
    table, other = (noise_table(GRID).requires_grad_() for _ in range(2))
    alone, full = encode_features(points, table, GRID, 4), encode(points, other, GRID, 4)[0]
    torch.testing.assert_close(alone, full, rtol=1e-5, atol=1e-5)
    alone.square().sum().backward()
    full.square().sum().backward()
    torch.testing.assert_close(table.grad, other.grad, rtol=1e-4, atol=1e-4)


def test_jacobian_is_the_derivative():
    table, points = noise_table(GRID, torch.float64), random_points(50, torch.float64)
    step = 1e-7
    _, jacobian = encode_reference(points, table, GRID, 5)
    for axis in range(3):
        offset = torch.zeros(3, dtype=torch.float64)
        offset[axis] = step
        high, low = (encode_reference(points + s * offset, table, GRID, 5)[0] for s in (1, -1))
        difference = (high - low) / (2 * step)
        # A point whose stencil straddles a cell's face has two one-sided derivatives: the median ignores it.
        assert np.median((difference - jacobian[:, axis]).abs().numpy()) < 1e-5


def test_inactive_levels_are_silent_and_get_no_gradient():
    table = noise_table(GRID).requires_grad_()
    features, jacobian = encode(random_points(64), table, GRID, 2)
    assert features[:, 8:].abs().max() == 0
    assert jacobian[:, :, 8:].abs().max() == 0
    (features.sum() + jacobian.sum()).backward()
    assert table.grad[GRID.offsets[2] :].abs().max() == 0
    assert table.grad[: GRID.offsets[2]].abs().max() > 0


def test_interpolation_reproduces_a_linear_function_on_dense_levels():
    grid = HashGrid(levels=1, features=4, log2_rows=12, coarsest=8, finest=8)
    side = torch.linspace(-1, 1, 9)
    x, y, z = torch.meshgrid(side, side, side, indexing="ij")
    table = torch.stack([x, y, z, x + 2 * y - z], -1).reshape(-1, 4)
    points = random_points(200)
    features, jacobian = encode(points, table, grid, 1)
    torch.testing.assert_close(features[:, :3], points, rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(jacobian[:, :, 3], torch.tensor([[1.0, 2, -1]]).expand(200, 3), rtol=1e-4, atol=1e-4)


def test_gradient_does_not_depend_on_the_thread_count():
    numba = pytest.importorskip("numba")
    points, gradients = random_points(5000), []
    before = numba.get_num_threads()
    for threads in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
        numba.set_num_threads(threads)
        table = noise_table(GRID).requires_grad_()
        features, jacobian = encode(points, table, GRID, 5)
        (features.square().sum() + jacobian.square().sum() * 1e-3).backward()
        gradients.append(table.grad.clone())
    numba.set_num_threads(before)
    assert torch.equal(gradients[0], gradients[1])
