"""The limit of a step: its matrix products are those that the networks do; a row for each implementation."""

from __future__ import annotations

import pytest
from torch.utils.flop_counter import FlopCounterMode

from benchmarks import step_limit, step_speed


def test_the_products_are_those_of_a_step(monkeypatch):
    monkeypatch.setitem(step_limit.POINTS, "cpu", 256)
    shape = step_limit.shape_of(10)
    step = step_limit.networks_step(shape)
    with FlopCounterMode(display=False) as counter:
        step()
    expected = sum(2 * (a or 256) * (b or 256) * (c or 256) for part in step_limit.products(shape) for a, b, c in part)
    assert counter.get_total_flops() == expected


@pytest.mark.slow
def test_each_implementation_has_a_row(monkeypatch):
    monkeypatch.setitem(step_limit.POINTS, "cpu", 256)
    monkeypatch.setitem(step_limit.LOG2_ROWS, "cpu", (10,))
    monkeypatch.setattr(step_speed, "REPETITIONS", 1)
    rows = step_limit.limit_rows("cpu")
    assert [row[2] for row in rows] == ["numba", "PyTorch"]
    for _, threads, _, networks, whole, limit, _, reached in rows:
        assert int(threads) == step_speed.cores_of("cpu")
        assert float(limit) > float(networks) > 0
        assert float(whole) > 0
        assert reached.endswith(" %")
    assert rows[0][5:7] == rows[1][5:7]
