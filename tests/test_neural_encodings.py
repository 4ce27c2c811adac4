"""The encodings: kernels against the reference, spatial derivatives against finite differences, edges."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from stages.neural.encoding_shapes import Frequencies, HashGrid
from stages.neural.encodings import encode, encode_features, encode_reference, hash_jacobian

GRID = HashGrid(levels=5, features=4, log2_rows=10, coarsest=4, finest=40)


FREQUENCIES = Frequencies(levels=4)


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


def cotangent_of(points: torch.Tensor, grid: HashGrid | Frequencies = GRID) -> torch.Tensor:
    generator = torch.Generator().manual_seed(2)
    return torch.randn(len(points), grid.channels, generator=generator).requires_grad_()


def pull(result: torch.Tensor, seed: int) -> torch.Tensor:
    """A scalar with another gradient for every entry of the result."""
    return (result * torch.randn(result.shape, generator=torch.Generator().manual_seed(seed))).sum()


@pytest.mark.parametrize("used", ["both", "features", "gradients"])
@pytest.mark.parametrize("active", [1, 3, 5])
@pytest.mark.parametrize("points", [random_points(700), EDGES], ids=["random", "edges"])
def test_kernels_agree_with_the_reference(points, active, used):
    results = []
    for function in (encode, encode_reference):
        table, cotangent = noise_table(GRID).requires_grad_(), cotangent_of(points)
        features, vjp = function(points, table, GRID, active)
        gradients = vjp(cotangent)
        (pull(features, 3) * (used != "gradients") + pull(gradients, 4) * (used != "features")).backward()
        results.append((features, gradients, cotangent.grad, table.grad))
    for got, expected in zip(*results, strict=True):
        scale = expected.abs().max().clamp(min=1e-9)
        torch.testing.assert_close(got / scale, expected / scale, rtol=1e-5, atol=1e-5)
    assert results[0][3].abs().max() > 0


def test_a_result_that_nothing_depends_on_costs_the_other_no_gradient():
    """Only one of features and gradients is in the graph, instead of one with a gradient of zero."""
    points, grads = random_points(50), {}
    for used in ("features", "gradients"):
        for function in (encode, encode_reference):
            table = noise_table(GRID).requires_grad_()
            features, vjp = function(points, table, GRID, 4)
            loss = pull(features, 3) if used == "features" else pull(vjp(cotangent_of(points).detach()), 4)
            loss.backward()
            grads[used, function] = table.grad
        expected = grads[used, encode_reference]
        assert expected.abs().max() > 0
        torch.testing.assert_close(grads[used, encode], expected, rtol=1e-4, atol=1e-5 * float(expected.abs().max()))


def test_a_cotangent_made_of_the_features_gets_the_whole_gradient():
    """As in a network: the cotangent depends on the table through the features."""
    points, grads = random_points(80), []
    for function in (encode, encode_reference):
        table = noise_table(GRID).requires_grad_()
        features, vjp = function(points, table, GRID, 5)
        (vjp(torch.sin(features)).square().sum() + features.square().sum()).backward()
        grads.append(table.grad)
    torch.testing.assert_close(grads[0], grads[1], rtol=1e-4, atol=1e-5 * float(grads[1].abs().max()))


def test_a_second_product_is_refused():
    points = random_points(4)
    _, vjp = encode(points, noise_table(GRID), GRID, 5)
    vjp(cotangent_of(points))
    with pytest.raises(RuntimeError, match="twice"):
        vjp(cotangent_of(points))


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
    _, jacobian = hash_jacobian(points, table, GRID, 5)
    for axis in range(3):
        offset = torch.zeros(3, dtype=torch.float64)
        offset[axis] = step
        high, low = (encode_reference(points + s * offset, table, GRID, 5)[0] for s in (1, -1))
        difference = (high - low) / (2 * step)
        # A point whose stencil straddles a cell's face has two one-sided derivatives: the median ignores it.
        assert np.median((difference - jacobian[:, axis]).abs().numpy()) < 1e-5


def test_inactive_levels_are_silent_and_get_no_gradient():
    table = noise_table(GRID).requires_grad_()
    points = random_points(64)
    cotangent = cotangent_of(points)
    features, vjp = encode(points, table, GRID, 2)
    assert features[:, 8:].abs().max() == 0
    (features.sum() + vjp(cotangent).square().sum()).backward()
    assert cotangent.grad[:, 8:].abs().max() == 0
    assert cotangent.grad[:, :8].abs().max() > 0
    assert table.grad[GRID.offsets[2] :].abs().max() == 0
    assert table.grad[: GRID.offsets[2]].abs().max() > 0


def test_interpolation_reproduces_a_linear_function_on_dense_levels():
    grid = HashGrid(levels=1, features=4, log2_rows=12, coarsest=8, finest=8)
    side = torch.linspace(-1, 1, 9)
    x, y, z = torch.meshgrid(side, side, side, indexing="ij")
    table = torch.stack([x, y, z, x + 2 * y - z], -1).reshape(-1, 4)
    points = random_points(200)
    features, vjp = encode(points, table, grid, 1)
    torch.testing.assert_close(features[:, :3], points, rtol=1e-5, atol=1e-5)
    last = torch.eye(4)[3].expand(200, 4)
    torch.testing.assert_close(vjp(last), torch.tensor([[1.0, 2, -1]]).expand(200, 3), rtol=1e-4, atol=1e-4)


def test_gradients_of_several_queries_add_up_in_the_table():
    points, table, other = random_points(50), *(noise_table(GRID).requires_grad_() for _ in range(2))
    for part in points.split(25):
        encode(part, table, GRID, 4)[0].sum().backward()
    (encode_features(points[:25], other, GRID, 4).sum() + encode(points[25:], other, GRID, 4)[0].sum()).backward()
    assert table.grad.abs().max() > 0
    torch.testing.assert_close(table.grad, other.grad, rtol=1e-5, atol=1e-5)


def test_gradient_does_not_depend_on_the_thread_count():
    numba = pytest.importorskip("numba")
    points, gradients = random_points(5000), []
    before = numba.get_num_threads()
    for threads in (1, min(2, numba.config.NUMBA_NUM_THREADS)):
        numba.set_num_threads(threads)
        table = noise_table(GRID).requires_grad_()
        features, vjp = encode(points, table, GRID, 5)
        (features.square().sum() + vjp(cotangent_of(points)).square().sum() * 1e-3).backward()
        gradients.append(table.grad.clone())
    numba.set_num_threads(before)
    assert torch.equal(gradients[0], gradients[1])


def test_frequencies_are_sines_and_cosines_of_octaves():
    points = torch.tensor([[0.5, 0.25, -0.125]])
    features, _ = encode(points, None, FREQUENCIES, 2)
    angles = np.pi * np.array([0.5, 0.25, -0.125])
    expected = np.concatenate([np.sin(angles), np.cos(angles), np.sin(2 * angles), np.cos(2 * angles), np.zeros(12)])
    np.testing.assert_allclose(features[0], expected, atol=1e-6)
    assert torch.equal(encode_features(points, None, FREQUENCIES, 2), features)
    assert (FREQUENCIES.voxel_size(1), FREQUENCIES.voxel_size()) == (1.0, 0.125)  # half of 2 and of 2 / 8


@pytest.mark.parametrize("active", [1, 4])
def test_frequencies_vjp_is_the_derivative(active):
    points = random_points(20, torch.float64).requires_grad_()
    features, vjp = encode(points, None, FREQUENCIES, active)
    cotangent = torch.randn(features.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    (expected,) = torch.autograd.grad((features * cotangent).sum(), points)
    torch.testing.assert_close(vjp(cotangent), expected)
    assert expected.abs().max() > 1


def test_frequencies_vjp_reaches_what_it_is_given():
    points = random_points(10)
    cotangent = cotangent_of(points, FREQUENCIES)
    encode(points, None, FREQUENCIES, 3)[1](cotangent).square().sum().backward()
    assert (cotangent.grad[:, :18].abs().amax(0) > 0).all()
    assert cotangent.grad[:, 18:].abs().max() == 0
