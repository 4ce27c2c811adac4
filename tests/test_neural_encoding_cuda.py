"""The Triton kernels of the encoding against the reference, in Triton's interpreter, and that they compile for GPUs.

Neither needs a GPU; both need the package triton (`pip install -e .[triton]`). What a GPU makes of them is asked by the
test marked `gpu`, and by `stages.neural.encodings` before it uses them.
"""

from __future__ import annotations

import importlib.util
import logging
import sys
from functools import partial
from types import ModuleType

import pytest
import torch

from stages.neural import encodings
from stages.neural.encoding_shapes import HashGrid
from stages.neural.encodings import disagreement, encode_reference, encode_with, kernels_for

needs_triton = pytest.mark.skipif(
    importlib.util.find_spec("triton") is None, reason="triton is not installed (pip install -e .[triton])"
)


def fresh_kernels(name: str) -> ModuleType:
    """A copy of the module: Triton looks when a kernel is defined whether to interpret it."""
    spec = importlib.util.find_spec("stages.neural.encoding_cuda")
    copy = importlib.util.spec_from_file_location(name, spec.origin)
    module = importlib.util.module_from_spec(copy)
    copy.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def interpreted():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TRITON_INTERPRET", "1")
        yield fresh_kernels("interpreted_encoding_cuda")


def grid_of(features: int) -> HashGrid:
    """Levels of 4 to 40 cells, the first two of which are dense."""
    return HashGrid(levels=5, features=features, log2_rows=10, coarsest=4, finest=40)


def noise(*shape: int, seed: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


RANDOM = 2 * torch.rand(150, 3, generator=torch.Generator().manual_seed(1)) - 1
BORDER = torch.tensor([[-1.0, -1, -1], [1, 1, 1], [1, -1, 0.5], [-0.5, 0.5, 1], [0.3, 1, -1]])
OUTSIDE = torch.tensor([[2.0, -3, 0.1], [1e6, 0, -1.0001], [-1.5, 1.5, 1.5], [torch.inf, -torch.inf, 0.2]])
LATTICE = torch.cartesian_prod(*[torch.linspace(-1, 1, 5)] * 3)  # the corners of the coarsest level's cells
POINTS = {"random": RANDOM, "border": BORDER, "outside": OUTSIDE, "lattice": LATTICE, "one": RANDOM[:1]}


def results(encode, points: torch.Tensor, grid: HashGrid, active: int, used: str) -> dict[str, torch.Tensor]:
    """Values and gradients of one pass; `used` names what the loss is made of."""
    table = noise(grid.num_rows, grid.features, seed=0).requires_grad_()
    features, vjp = encode(points, table, grid, active)
    cotangent = noise(*features.shape, seed=2).requires_grad_()
    gradients = vjp(cotangent)
    loss = torch.zeros(())
    if used != "gradients":
        loss = loss + (features * noise(*features.shape, seed=3)).sum()
    if used != "features":
        loss = loss + (gradients * noise(*gradients.shape, seed=4)).sum()
    loss.backward()
    found = {"features": features, "gradients": gradients, "table": table.grad}
    return found if used == "features" else {**found, "cotangent": cotangent.grad}


def assert_agree(got: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]) -> None:
    assert got.keys() == expected.keys()
    for name, value in expected.items():
        scale = value.abs().max().clamp(min=1e-9)
        torch.testing.assert_close(got[name] / scale, value / scale, rtol=1e-5, atol=1e-5, msg=name)


@needs_triton
@pytest.mark.parametrize("where", POINTS)
@pytest.mark.parametrize("active", [1, 3, 5])
def test_kernels_agree_with_the_reference_everywhere(interpreted, where, active):
    grid = grid_of(4)
    assert grid.dense.tolist() == [True, True, False, False, False]
    got = results(partial(encode_with, interpreted), POINTS[where], grid, active, "both")
    assert_agree(got, results(encode_reference, POINTS[where], grid, active, "both"))
    assert got["table"].abs().max() > 0
    assert got["features"][:, 4 * active :].eq(0).all()
    assert got["cotangent"][:, 4 * active :].eq(0).all()


@needs_triton
@pytest.mark.parametrize("used", ["both", "features", "gradients"])
@pytest.mark.parametrize("features", [1, 2, 8])
def test_kernels_agree_for_other_widths_and_uses(interpreted, features, used):
    grid = grid_of(features)
    got = results(partial(encode_with, interpreted), RANDOM, grid, 4, used)
    assert_agree(got, results(encode_reference, RANDOM, grid, 4, used))


@needs_triton
def test_a_cotangent_made_of_the_features_gets_the_whole_gradient(interpreted):
    """As in a network: the cotangent depends on the table through the features, and none of them lies row by row."""
    grads, grid = [], grid_of(4)
    for encode in (partial(encode_with, interpreted), encode_reference):
        table = noise(grid.num_rows, grid.features, seed=0).requires_grad_()
        features, vjp = encode(RANDOM, table, grid, 5)
        (vjp(torch.sin(features)).square().sum() + features.square().sum()).backward()
        grads.append(table.grad)
    torch.testing.assert_close(grads[0], grads[1], rtol=1e-4, atol=1e-5 * float(grads[1].abs().max()))


@needs_triton
def test_features_alone_are_those_of_the_whole_and_their_gradients_add_up(interpreted):
    grid, table = grid_of(2), noise(grid_of(2).num_rows, 2, seed=0).requires_grad_()
    alone = encodings._KernelFeatures.apply(RANDOM, table, grid, 3, interpreted)
    assert torch.equal(alone, encode_with(interpreted, RANDOM, table, grid, 3)[0])
    (alone * noise(*alone.shape, seed=3)).sum().backward()
    expected = results(encode_reference, RANDOM, grid, 3, "features")["table"]
    torch.testing.assert_close(table.grad, expected, rtol=1e-5, atol=1e-5)
    once = table.grad.clone()
    again = encodings._KernelFeatures.apply(RANDOM, table, grid, 3, interpreted)
    (again * noise(*alone.shape, seed=3)).sum().backward()
    torch.testing.assert_close(table.grad, 2 * once)


@needs_triton
def test_no_points_give_no_rows_and_no_gradient(interpreted):
    got = results(partial(encode_with, interpreted), RANDOM[:0], grid_of(4), 5, "both")
    assert got["features"].shape == (0, 20)
    assert got["gradients"].shape == (0, 3)
    assert got["table"].eq(0).all()


@needs_triton
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="Triton brings its assembler for Linux only")
@pytest.mark.parametrize("capability", [75, 90])
def test_kernels_compile_for_gpus_without_one(tmp_path, monkeypatch, capability):
    """The interpreter takes Python that the compiler may refuse."""
    import triton
    from triton.backends.compiler import GPUTarget
    from triton.compiler import ASTSource

    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    compiled = fresh_kernels("compiled_encoding_cuda")
    constants = {"ROW_MASK": 2**17 - 1, "FEATURES": 4, "BLOCK": compiled.BLOCK}
    for kernel, more in (
        (compiled._encode, {**constants, "WITH_JACOBIAN": True}),
        (compiled._encode, {**constants, "WITH_JACOBIAN": False, "jacobian": None}),
        (compiled._add_gradient, {**constants, "OF_FEATURES": True, "OF_JACOBIAN": True, "feature_row": 1}),
        (compiled._vjp, {"BLOCK": compiled.BLOCK, "column": 1}),  # a whole number 1 is a constant to Triton
        (compiled._vjp_gradient, {"BLOCK": compiled.BLOCK}),
    ):
        integers = {"num_points", "axis", "channels", "row", "column"} | {
            f"{of}_{way}" for of in ("feature", "cotangent") for way in ("row", "column")
        }
        signature = {
            name: "constexpr"
            if name in more
            else "*i32"
            if name == "levels"
            else "i32"
            if name in integers
            else "*fp32"
            for name in kernel.arg_names
        }
        # Tensors begin at multiples of 16 bytes: rows are read and added to whole.
        aligned = {(i,): [["tt.divisibility", 16]] for i, kind in enumerate(signature.values()) if kind[0] == "*"}
        source = ASTSource(fn=kernel, signature=signature, constexprs=more, attrs=aligned)
        assembly = triton.compile(source, target=GPUTarget("cuda", capability, 32)).asm["ptx"]
        if kernel is compiled._encode:
            assert assembly.count("ld.global.v4") == 8
        if kernel is compiled._add_gradient and capability >= 90:
            assert assembly.count("red.global.gpu.relaxed.add.v4.f32") == 8


# ---------------------------------------------------------------- which kernels are taken
def test_kernels_that_do_not_agree_are_not_used_and_it_is_said_once(monkeypatch, caplog):
    from stages.neural import encoding_cpu

    class Wrong:
        """The CPU kernels, but for a tenth too much in the table's gradient."""

        def __getattr__(self, name):
            return getattr(encoding_cpu, name)

        def backward(self, points, grid, active_levels, grad_features, grad_jacobian, grad_table):
            encoding_cpu.backward(points, grid, active_levels, 1.1 * grad_features, grad_jacobian, grad_table)

    assert disagreement(encoding_cpu, grid_of(4), "cpu") < 1e-6
    assert disagreement(Wrong(), grid_of(4), "cpu") > 1e-3
    stand_in = ModuleType("stages.neural.encoding_cuda")
    for kernels, taken in ((encoding_cpu, True), (Wrong(), False)):
        for name in ("forward", "backward", "vjp_forward", "vjp_backward"):
            setattr(stand_in, name, getattr(kernels, name))
        monkeypatch.setitem(sys.modules, "stages.neural.encoding_cuda", stand_in)
        monkeypatch.setattr(sys.modules["stages.neural"], "encoding_cuda", stand_in, raising=False)
        encodings._cuda_kernels.cache_clear()
        with caplog.at_level(logging.WARNING):
            found = {encodings._cuda_kernels(4, torch.device("cpu")) for _ in range(2)}
        assert found == {stand_in if taken else None}
    encodings._cuda_kernels.cache_clear()
    assert sum("are off by" in record.message for record in caplog.records) == 1


def test_without_triton_the_reference_goes_on_and_it_is_said_once(monkeypatch, caplog):
    monkeypatch.setitem(sys.modules, "stages.neural.encoding_cuda", None)
    monkeypatch.delattr("stages.neural.encoding_cuda", raising=False)
    encodings._cuda_kernels.cache_clear()
    assert encodings._cuda_kernels(4, torch.device("cpu")) is None
    assert encodings._cuda_kernels(4, torch.device("cpu")) is None
    encodings._cuda_kernels.cache_clear()
    assert sum("no CUDA kernels" in record.message for record in caplog.records) == 1


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")
@pytest.mark.parametrize("features", [1, 2, 4, 8])
def test_the_kernels_are_taken_on_cuda_and_agree(features):
    kernels = kernels_for(RANDOM.cuda(), grid_of(features))
    assert kernels is not None
    assert disagreement(kernels, grid_of(features), "cuda", 10_000) < encodings.AGREEMENT
    finest = 2048  # where a position in cells is rounded to so much, and which way is the compiler's choice
    rounding = finest * torch.finfo(torch.float32).eps
    assert disagreement(kernels, HashGrid(12, features, 19, 16, finest), "cuda", 10_000) < rounding
