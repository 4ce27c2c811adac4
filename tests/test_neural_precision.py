"""Mixed precision, on the CPU: it learns, distances and normals do not know of it, float32 stays what it was."""

from __future__ import annotations

import pytest
import torch
from ball_training import TINY, assert_finds_the_ball, even_rays, make_trainer
from train_settings import changed

from stages.neural.acceleration import is_mixed, short_products
from stages.neural.mlp import mlp
from stages.neural.trained_field import field_state, load_field

EVERYTHING = {"terms.reflection.form": "stable", "terms.reflection.start": 0.0, "sampling.sampler": "proposal"}


def mixed(**settings):
    return changed(TINY, {"precision": "mixed", **settings})


def test_auto_is_mixed_on_cuda_only_where_it_is_fast(monkeypatch):
    names = ("auto", "float32", "mixed")
    assert [is_mixed(name, torch.device("cpu")) for name in names] == [False, False, True]
    for capability, auto in (((9, 0), True), ((8, 0), True), ((7, 5), False)):
        monkeypatch.setattr(torch.cuda, "get_device_capability", lambda device, found=capability: found)
        assert [is_mixed(name, torch.device("cuda", 0)) for name in names] == [auto, False, True]


def test_products_are_short_on_cuda_and_only_there_where_wanted():
    before = torch.get_float32_matmul_precision()
    found = []
    for wanted, device in ((True, "cuda"), (False, "cuda"), (True, "cpu")):
        with short_products(wanted, torch.device(device)):
            found.append(torch.get_float32_matmul_precision())
    assert found == ["high", before, before] == ["high", "highest", "highest"]
    with pytest.raises(ZeroDivisionError), short_products(True, torch.device("cuda")):
        raise ZeroDivisionError
    assert torch.get_float32_matmul_precision() == before


def test_a_mixed_mlp_takes_and_gives_float32_and_is_off_by_what_bfloat16_is_off():
    layers = mlp([20, 64, 64, 3], torch.Generator().manual_seed(0))
    inputs = torch.randn(200, 20, generator=torch.Generator().manual_seed(1)).requires_grad_()
    results = []
    for layers.mixed in (False, True):
        layers.zero_grad()
        inputs.grad = None
        outputs = layers(inputs)
        outputs.square().sum().backward()
        results.append((outputs.detach(), inputs.grad, layers[0].weight.grad))
    # A unit whose sum is near zero may fall on the other side of its ReLU, and its gradient comes or goes whole.
    for exact, short, limit in zip(*results, (0.02, 0.1, 0.1), strict=True):
        assert short.dtype == torch.float32
        assert 1e-4 < torch.linalg.vector_norm(short - exact) / torch.linalg.vector_norm(exact) < limit
    assert torch.equal(results[1][0], results[1][0].bfloat16().float())  # it was bfloat16


def test_colours_alone_are_mixed():
    """Distance, normals and rendering weights are those of float32 to the last bit."""
    rendered = []
    for params in (TINY, mixed()):
        trainer = make_trainer(params)
        trainer._refresh_cache(trainer.moment(0.3))
        batch = even_rays(trainer.photos, 64)
        rendered.append(trainer.render(batch, 0.3, torch.rand(5, 3, generator=trainer.generator)))
    exact, short = rendered
    for name in ("weights", "gradients", "opacity", "extra_sdf", "extra_gradients", "features"):
        assert torch.equal(getattr(exact, name), getattr(short, name)), name
    difference = (exact.colors - short.colors).abs().max()
    assert 0 < difference < 2 / 255
    assert short.colors.dtype == torch.float32


@pytest.mark.parametrize("settings", [{}, EVERYTHING], ids=["default", "everything"])
def test_all_that_is_trained_gets_float32_gradients(settings):
    trainer = make_trainer(mixed(**settings))
    numbers = trainer.step(0.5)
    assert all(value.dtype == torch.float32 and torch.isfinite(value) for value in numbers.values())
    for name, parameter in trainer.fields.named_parameters():
        assert parameter.dtype == torch.float32
        assert parameter.grad is None or parameter.grad.dtype == torch.float32
        assert name.startswith("reflection") or parameter.grad.abs().max() > 0, name


@pytest.mark.slow
def test_mixed_precision_finds_the_ball():
    assert_finds_the_ball({"precision": "mixed"})


def test_a_field_is_read_back_in_float32(tmp_path):
    trainer = make_trainer(mixed())
    torch.save(field_state(trainer.fields), tmp_path / "field.pt")
    assert trainer.fields.radiance.network.layers.mixed
    fields = load_field(tmp_path / "field.pt").fields
    assert not fields.radiance.network.layers.mixed
    assert not fields.sdf.short
