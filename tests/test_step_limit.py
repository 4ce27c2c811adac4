"""The limit of a step: its matrix products are those that the networks do."""

from __future__ import annotations

from torch.utils.flop_counter import FlopCounterMode

from benchmarks import step_limit


def test_the_products_are_those_of_a_step(monkeypatch):
    monkeypatch.setattr(step_limit, "POINTS", 256)
    shape = step_limit.shape_of(10)
    step = step_limit.networks_step(shape)
    with FlopCounterMode(display=False) as counter:
        step()
    expected = sum(2 * (a or 256) * (b or 256) * (c or 256) for a, b, c in step_limit.products(shape))
    assert counter.get_total_flops() == expected
