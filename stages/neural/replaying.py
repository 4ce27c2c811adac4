"""A training step as a CUDA graph: recorded once, then launched in one go.

A step is about a thousand small kernels, and a GPU is done with most of them before the host has launched the next. A
graph has no such gaps. It needs what the step has on CUDA in any case: shapes that do not depend on the data, and
nothing that waits for the device. What changes from step to step lies in tensors that keep their places.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass
from typing import Any, TypeVar

import torch

log = logging.getLogger(__name__)

# Steps of a new kind that go kernel by kernel first: kernels are compiled, and the optimiser makes its state.
WARM_UP = 3

Result = TypeVar("Result")


@dataclass
class _Recording:
    kind: Hashable
    steps: int = 0
    graph: torch.cuda.CUDAGraph | None = None
    results: Any = None


class Replay:
    """Calls a step, from the fourth of a kind on as a graph; where one cannot be recorded, kernel by kernel for good.

    Results lie where the next call writes its own.
    """

    def __init__(self, device: torch.device, generators: Iterable[torch.Generator]) -> None:
        """generators: what the step draws from; a graph goes on with them as the step would."""
        self.generators, self.stream = tuple(generators), torch.cuda.Stream(device)
        self.recording = _Recording(None)
        self.possible = True

    def __call__(self, step: Callable[[], Result], kind: Hashable) -> Result:
        """One step. `kind` names what is fixed in a graph; the rest the step reads from tensors that stay."""
        if kind != self.recording.kind:
            self.recording = _Recording(kind)
        recording = self.recording
        recording.steps += 1
        if recording.graph is None and (not self.possible or recording.steps <= WARM_UP):
            return self._eagerly(step)
        if recording.graph is None and not self._record(step):
            return self._eagerly(step)
        assert recording.graph is not None
        recording.graph.replay()
        results: Result = recording.results
        return results

    def _eagerly(self, step: Callable[[], Result]) -> Result:
        """On the stream that records: what backward passes remember of streams must not differ."""
        self.stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self.stream):
            results = step()
        torch.cuda.current_stream().wait_stream(self.stream)
        return results

    def _record(self, step: Callable[[], Any]) -> bool:
        graph = torch.cuda.CUDAGraph()
        for generator in self.generators:
            graph.register_generator_state(generator)
        try:
            with torch.cuda.graph(graph, stream=self.stream, capture_error_mode="thread_local"):
                results = step()
        except RuntimeError as error:
            log.warning("a training step cannot be a CUDA graph here (%s): it goes kernel by kernel, slower", error)
            self.possible = False
            return False
        self.recording.graph, self.recording.results = graph, results
        return True
