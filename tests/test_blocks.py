"""Where memory runs out, work goes on in smaller blocks, and its result is the same."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from ball_training import TINY, make_trainer
from train_settings import changed

from stages import blocks
from stages.blocks import in_blocks, is_out_of_memory, with_less
from stages.neural import renderer as renderer_module
from stages.neural.trained_field import TrainedField

NO_MEMORY = RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 8 bytes.")


@pytest.fixture(autouse=True)
def nothing_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of what was enough: it is remembered for as long as the process is."""
    monkeypatch.setattr(blocks, "_enough", {})


def failing_above(most: int, sizes: list[int], error: Exception = NO_MEMORY) -> Callable[[slice], np.ndarray]:
    def work(rows: slice) -> np.ndarray:
        sizes.append(rows.stop - rows.start)
        if rows.stop - rows.start > most:
            raise error
        return np.arange(rows.start, rows.stop)

    return work


@pytest.mark.parametrize("count", [0, 1, 99, 100, 1000])
def test_blocks_shrink_until_they_fit_and_cover_everything_once(count: int):
    sizes: list[int] = []
    parts = in_blocks(failing_above(100, sizes), count, 800, "numbers", least=1)
    assert np.concatenate([np.zeros(0), *parts]).tolist() == list(range(count))
    assert all(len(part) <= 100 for part in parts)


def test_what_was_enough_is_kept_and_told_once_a_size(caplog: pytest.LogCaptureFixture):
    sizes: list[int] = []
    for _ in range(3):
        in_blocks(failing_above(300, sizes), 800, 800, "numbers")
    assert [size for size in sizes if size > 400] == [800]
    assert [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING] == [
        "Memory ran out with 800 at once (numbers): it goes on with 400.",
        "Memory ran out with 400 at once (numbers): it goes on with 256.",
    ]


def test_at_the_least_the_error_is_the_librarys():
    sizes: list[int] = []
    with pytest.raises(RuntimeError, match="can't allocate memory"):
        in_blocks(failing_above(0, sizes), 10, 8, "numbers", least=3)
    assert sizes == [8, 4, 3]


def test_another_error_is_not_tried_again():
    sizes: list[int] = []
    with pytest.raises(ValueError, match="of another kind"):
        in_blocks(failing_above(0, sizes, ValueError("of another kind")), 10, 8, "numbers", least=1)
    assert sizes == [8]


def test_what_the_failed_attempt_held_is_free_before_the_next():
    alive: list[Any] = []

    class Large:
        def __init__(self) -> None:
            alive.append(None)
            self.self = self  # a circle, as frames of autograd make them

        def __del__(self) -> None:
            alive.pop()

    def work(size: int) -> int:
        assert not alive
        large = Large()
        if size > 1:
            raise MemoryError(large)
        return size

    assert with_less(work, 4, "numbers") == 1


@pytest.mark.parametrize(
    ("error", "answer"),
    [
        (MemoryError(), True),
        (NO_MEMORY, True),
        (RuntimeError("CUDA out of memory. Tried to allocate 2.00 GiB"), True),
        (RuntimeError("std::bad_alloc"), True),
        (OSError(12, "Cannot allocate memory"), True),
        (RuntimeError("expected 3 channels"), False),
        (OSError(28, "No space left on device"), False),
    ],
)
def test_which_errors_are_of_memory(error: Exception, answer: bool):
    assert is_out_of_memory(error) is answer


# ---------------------------------------------------------------- training
def one_step(
    monkeypatch: pytest.MonkeyPatch, most: int, masks: bool, settings: dict[str, str] | None = None
) -> tuple[dict[str, float], list[torch.Tensor], list]:
    """Numbers, gradients, and the sizes that were rendered, where no more rays than `most` fit."""
    # Without the term that picks some of the rays at hand, and samples in the middle of their strata.
    of_all = {"terms.planar.form": "off", "sampling.rays": 64}
    trainer = make_trainer(changed(TINY, of_all | (settings or {})), masks)
    stratified, render, rendered = renderer_module.stratified, trainer.renderer.render, []
    monkeypatch.setattr(
        renderer_module, "stratified", lambda rows, strata, _, device: stratified(rows, strata, None, device)
    )

    def scarce(batch, moment, extra, generator):
        rendered.append(len(batch))
        result = render(batch, moment, extra)
        if len(batch) > most:
            raise NO_MEMORY
        return result

    monkeypatch.setattr(trainer.renderer, "render", scarce)
    numbers = {name: float(value) for name, value in trainer.step(0.3).items()}
    numbers["needed"] = float(trainer.needed.errors.sum())
    monkeypatch.undo()
    monkeypatch.setattr(blocks, "_enough", {})
    return numbers, [p.grad.clone() for p in trainer.fields.parameters() if p.grad is not None], rendered


@pytest.mark.parametrize("masks", [False, True])
def test_a_step_in_parts_is_the_same_step(monkeypatch: pytest.MonkeyPatch, masks: bool):
    numbers, gradients, _ = one_step(monkeypatch, 64, masks)
    in_parts, of_parts, rendered = one_step(monkeypatch, 20, masks)
    assert rendered == [64, 32, 16, 16, 16, 16]
    assert in_parts == pytest.approx(numbers, rel=1e-4, abs=1e-6)
    assert len(of_parts) == len(gradients) > 5
    for part, whole in zip(of_parts, gradients, strict=True):
        torch.testing.assert_close(part, whole, rtol=1e-3, atol=1e-6 * float(whole.abs().max() + 1))


def test_a_learned_scale_gets_the_same_gradient_in_parts(monkeypatch: pytest.MonkeyPatch):
    whole, parts = (one_step(monkeypatch, most, False, {"density.scale": "learned"})[1] for most in (64, 20))
    scalars = [(w, p) for w, p in zip(whole, parts, strict=True) if w.ndim == 0]
    assert len(scalars) == 1
    assert float(scalars[0][0]) != 0
    torch.testing.assert_close(*scalars[0], rtol=1e-3, atol=1e-6)


def test_training_goes_on_with_fewer_rays_at_once(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture):
    trainer = make_trainer(changed(TINY, {"sampling.rays": 64}))
    render = trainer.renderer.render

    def scarce(batch, *rest):
        if len(batch) > 40:
            raise NO_MEMORY
        return render(batch, *rest)

    monkeypatch.setattr(trainer.renderer, "render", scarce)
    losses = [float(trainer.step(i / 60)["loss"]) for i in range(8)]
    assert np.isfinite(losses).all()
    assert len([record for record in caplog.records if "rays of a training step" in record.getMessage()]) == 1


# ---------------------------------------------------------------- a field
def test_a_field_is_evaluated_in_smaller_blocks(monkeypatch: pytest.MonkeyPatch):
    field = TrainedField(make_trainer().fields, "cpu")
    points = np.random.default_rng(0).uniform(-1, 1, (3000, 3)).astype(np.float32)
    whole, sdf = field.sdf(points), field.fields.sdf.sdf

    def scarce(places: torch.Tensor, levels: int) -> torch.Tensor:
        if len(places) > 700:
            raise NO_MEMORY
        return sdf(places, levels)

    monkeypatch.setattr(field.fields.sdf, "sdf", scarce)
    assert field.sdf(points) == pytest.approx(whole, abs=1e-6)
