"""The SDF network: its start, its gradient, its depth, its encodings, and the files it is kept in."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from stages.neural.encoding_shapes import Frequencies, HashGrid
from stages.neural.fields import BEND, Fields, FieldShape, SdfNetwork, smooth_relu, smooth_relu_reference
from stages.neural.trained_field import field_state, load_field

GRID = HashGrid(levels=4, features=4, log2_rows=10, coarsest=4, finest=24)
SHAPE = FieldShape(
    sdf_grid=GRID, sdf_layers=1, sdf_width=16, radiance_layers=1, radiance_width=8, reflected=True, features=3,
    sphere_radius=0.4, background_grid=None, num_images=2,
)  # fmt: skip
SHAPES = {
    "hash": SHAPE,
    "hash, deep": dataclasses.replace(SHAPE, sdf_layers=4),
    "frequency": dataclasses.replace(SHAPE, sdf_grid=Frequencies(4)),
    "frequency, deep": dataclasses.replace(SHAPE, sdf_grid=Frequencies(4), sdf_layers=4),
    "numerical": dataclasses.replace(SHAPE, numerical=True),
}
every_shape = pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)


def network(shape: FieldShape, noise: float = 0.0, dtype: torch.dtype = torch.float32) -> SdfNetwork:
    """The network at its start, or with all parameters moved by noise."""
    generator = torch.Generator().manual_seed(0)
    result = SdfNetwork(shape, generator).to(dtype)
    with torch.no_grad():
        for parameter in result.parameters():
            parameter += noise * torch.randn(parameter.shape, generator=generator, dtype=dtype)
    return result


def random_points(count: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(1), dtype=dtype) * 2 - 1


def test_smooth_relu_kernel_agrees_with_the_reference():
    z = torch.cat([torch.linspace(-0.2, 0.2, 801), torch.tensor([-1e4, 3.0, 1e4])])
    results = []
    for function in (smooth_relu, smooth_relu_reference):
        leaf = z.clone().requires_grad_()
        activation, slope = function(leaf)
        (activation * torch.cos(5 * leaf.detach()) + slope * torch.sin(3 * leaf.detach())).sum().backward()
        results.append((activation, slope, leaf.grad))
    torch.testing.assert_close(results[0][:2], results[1][:2], rtol=1e-6, atol=1e-6)
    # At the two ends of the bend itself the second derivative is one or the other.
    inner = (z.abs() - BEND).abs() > 1e-4
    torch.testing.assert_close(results[0][2][inner], results[1][2][inner], rtol=1e-5, atol=1e-5)


def test_slope_is_the_derivative():
    z = torch.linspace(-0.2, 0.2, 101, dtype=torch.float64).requires_grad_()
    activation, slope = smooth_relu(z)
    torch.testing.assert_close(torch.autograd.grad(activation.sum(), z)[0], slope)


@every_shape
def test_it_starts_as_the_sphere(shape):
    points = random_points(200)
    sdf, _, gradients = network(shape)(points, 4)
    radius = torch.linalg.vector_norm(points, dim=1)
    # The hash table's noise of 1e-4 is all there is beside it.
    torch.testing.assert_close(sdf, radius - 0.4, rtol=0, atol=1e-3)
    torch.testing.assert_close(gradients, points / radius[:, None], rtol=0, atol=0.05)


@pytest.mark.parametrize("layers", [1, 8])
@pytest.mark.parametrize("grid", [GRID, Frequencies(4)], ids=["hash", "frequency"])
def test_it_starts_exactly_as_the_sphere_when_the_encoding_is_silent(layers, grid):
    shape = dataclasses.replace(SHAPE, sdf_grid=grid, sdf_layers=layers, sdf_width=32)
    sdf_network, points = network(shape), random_points(50)
    if sdf_network.table is not None:
        sdf_network.table.data.zero_()
    sdf, features, _ = sdf_network(points, 4)
    torch.testing.assert_close(sdf, torch.linalg.vector_norm(points, dim=1) - 0.4, rtol=0, atol=1e-5)
    assert features.abs().max() < 1e-5


def test_one_layer_starts_as_it_always_has():
    """The order of the random draws: table, first layer, outputs."""
    generator = torch.Generator().manual_seed(0)
    expected = SHAPE.sdf_grid.initial_table(generator)
    first = (torch.rand(16, 16, generator=generator) * 2 - 1) * (6 / 16) ** 0.5
    last = (torch.rand(4, 16, generator=generator) * 2 - 1) * (6 / 16) ** 0.5
    last[0] *= 0.1
    started = network(SHAPE)
    assert torch.equal(started.table, expected)
    assert torch.equal(started.weights[0], first)
    assert torch.equal(started.weights[1], last)
    assert torch.equal(started.biases[1], -0.25 * BEND * last.sum(1))


@pytest.mark.parametrize("name", ["hash", "hash, deep", "frequency", "frequency, deep"])
@pytest.mark.parametrize("active", [2, 4])
def test_the_gradient_is_the_derivative(name, active):
    moved, points = network(SHAPES[name], 0.1, torch.float64), random_points(40, torch.float64)
    _, _, gradients = moved(points, active)
    step = 1e-7 * torch.eye(3, dtype=torch.float64)
    differences = torch.stack([moved.sdf(points + e, active) - moved.sdf(points - e, active) for e in step], 1) / 2e-7
    # A point whose stencil straddles a cell's face has two one-sided derivatives: the median ignores it.
    assert (differences - gradients).abs().median() < 1e-6
    assert (gradients - points / torch.linalg.vector_norm(points, dim=1, keepdim=True)).abs().median() > 1e-2


@pytest.mark.parametrize("name", ["hash", "hash, deep"])
def test_the_kernels_train_the_network_as_the_reference_does(name):
    """float32 runs the kernels, float64 plain torch: same values, same gradients of all parameters."""
    results = []
    for dtype in (torch.float32, torch.float64):
        moved, points = network(SHAPES[name], 0.05).to(dtype), random_points(300).to(dtype)
        sdf, features, gradients = moved(points, 3)
        (sdf.square().sum() + features.sin().sum() + (gradients.norm(dim=1) - 1).square().sum()).backward()
        results.append([sdf, features, gradients, *(p.grad for p in moved.parameters())])
    for got, expected in zip(*results, strict=True):
        torch.testing.assert_close(got.double(), expected, rtol=1e-3, atol=1e-4 * float(expected.detach().abs().max()))


@every_shape
def test_f_alone_is_the_same_f(shape):
    moved, points = network(shape, 0.1), random_points(60)
    torch.testing.assert_close(moved.sdf(points, 3), moved(points, 3)[0], rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("layers", [1, 8])
def test_depth_neither_kills_nor_blows_up_the_signal(layers):
    """Features of size 1 come out about as they went in, whatever the depth."""
    shape = dataclasses.replace(SHAPE, sdf_layers=layers, sdf_width=64, features=15)
    deep = network(shape)
    deep.table.data = torch.randn(deep.table.shape, generator=torch.Generator().manual_seed(2))
    _, features, gradients = deep(random_points(500), 4)
    assert 0.3 < features.std() < 3
    assert gradients.isfinite().all()


def test_numerical_gradients_are_central_differences_one_voxel_wide():
    moved, points = network(SHAPES["numerical"], 0.1, torch.float64), random_points(30, torch.float64)
    for active in (1, 4):
        step = GRID.voxel_size(active)
        expected = torch.empty_like(points)
        for axis in range(3):
            offset = torch.zeros(3, dtype=torch.float64)
            offset[axis] = step
            expected[:, axis] = (moved.sdf(points + offset, active) - moved.sdf(points - offset, active)) / (2 * step)
        torch.testing.assert_close(moved(points, active)[2], expected)


def test_numerical_gradients_meet_the_analytic_ones_on_a_smooth_field():
    """Half a wavelength is too wide for that: tell the network that its voxels are finer."""

    class Fine(Frequencies):
        def voxel_size(self, active_levels: int | None = None) -> float:
            return 1e-3

    analytic = network(dataclasses.replace(SHAPE, sdf_grid=Fine(4)), 0.2, torch.float64)
    numerical = network(dataclasses.replace(SHAPE, sdf_grid=Fine(4), numerical=True), 0.2, torch.float64)
    points = random_points(100, torch.float64)
    points = points[torch.linalg.vector_norm(points, dim=1) > 0.2]
    expected, got = analytic(points, 2)[2], numerical(points, 2)[2]
    assert (got - expected).abs().max() < 0.05 * (expected - expected.mean(0)).std()


@every_shape
def test_every_parameter_gets_a_gradient_from_f_and_from_its_slope(shape):
    moved, points = network(shape, 0.05), random_points(200)
    for result in (0, 2):
        moved.zero_grad(set_to_none=True)
        moved(points, 4)[result].square().sum().backward()
        for name, parameter in moved.named_parameters():
            if result == 2 and name.startswith("biases") and name.endswith(str(shape.sdf_layers)):
                continue  # a constant has no slope
            assert parameter.grad is not None, name
            assert parameter.grad.abs().max() > 0, name


@every_shape
def test_it_learns_a_box_from_the_sphere(shape):
    """Adam on f and its unit slope: the error falls to a small part of what it was."""
    learner = network(dataclasses.replace(shape, sdf_width=32))
    tables = [] if learner.table is None else [learner.table]
    others = [p for name, p in learner.named_parameters() if name != "table"]
    optimizer = torch.optim.Adam([{"params": tables, "lr": 2e-2}, {"params": others, "lr": 6e-3}])
    generator, errors = torch.Generator().manual_seed(3), []
    for _ in range(60):
        points = torch.rand(400, 3, generator=generator) * 1.6 - 0.8
        outside = points.abs() - torch.tensor([0.5, 0.3, 0.4])
        box = outside.clamp(min=0).norm(dim=1) + outside.amax(1).clamp(max=0)
        sdf, _, gradients = learner(points, 4)
        error = (sdf - box).abs().mean()
        optimizer.zero_grad()
        (error + 0.01 * (gradients.norm(dim=1) - 1).square().mean()).backward()
        optimizer.step()
        errors.append(error.item())
    assert errors[0] > 0.05
    assert sum(errors[-10:]) / 10 < 0.25 * errors[0]


@every_shape
def test_a_saved_field_reads_back(shape, tmp_path):
    fields = Fields(shape)
    assert len(fields.tables()) == (0 if isinstance(shape.sdf_grid, Frequencies) else 1)
    torch.save(field_state(fields), tmp_path / "field.pt")
    field = load_field(tmp_path / "field.pt")
    assert field.fields.shape == shape
    points = random_points(20)
    expected = fields.sdf.sdf(points, 4).detach()
    torch.testing.assert_close(torch.from_numpy(field.sdf(points.numpy())), expected)
    assert field.normals(points.numpy()).shape == (20, 3)
