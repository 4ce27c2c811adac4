"""Settings of the training for tests, by the names that `--set train.` takes."""

from __future__ import annotations

from typing import Any

from configs.dotted import flatten, nested
from configs.training import TrainParams


def changed(params: TrainParams, settings: dict[str, Any]) -> TrainParams:
    """`params` with these: {"sampling.rays": 16}."""
    return TrainParams.model_validate(nested({**flatten(params.model_dump()), **settings}))


def small(settings: dict[str, Any]) -> TrainParams:
    """The defaults with these."""
    return changed(TrainParams(), settings)
