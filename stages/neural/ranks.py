"""Several processes that train one field: each renders a share of a step's rays, and what they find is summed.

All have the same networks and the same generator, so they draw the same rays. Gradients are summed in one exchange,
after which the optimiser's step is the same everywhere, bit for bit: parameters are not sent again, only compared.

The first process leads: it alone looks at the clock, decides, and writes. The others wait for a training, then for each
of its steps. A process that ends takes its connections with it, so the others end, too, instead of waiting for it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import timedelta
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor
from torch import distributed as dist

from stages.errors import SystemRequirementError

Result = TypeVar("Result")

# Within a step all have the same to do; between trainings the first may match a thousand photos.
EXCHANGE, WAIT = timedelta(minutes=30), timedelta(days=30)
_END = -1.0  # in place of a progress: no more steps of this training


class Ranks:
    """This process's place among those that train together. Where it is alone nothing is exchanged.

    Attributes:
        rank: from 0, which is the first. size: how many there are. local, local_size: the same on this machine.
        cut_off: something failed in the middle of what all do together, so that nothing can be done together any more.
    """

    def __init__(self, rank: int = 0, size: int = 1, local: int = 0, local_size: int = 1) -> None:
        self.rank, self.size, self.local, self.local_size = rank, size, local, local_size
        self.cut_off = False
        self._orders = dist.new_group(backend="gloo", timeout=WAIT) if size > 1 else None

    @property
    def is_first(self) -> bool:
        return self.rank == 0

    @property
    def alone(self) -> bool:
        return self.size == 1

    def use(self, device: str) -> None:
        """Let "cuda" mean this process's own GPU from here on.

        Raises:
            SystemRequirementError: there are fewer GPUs than processes on this machine.
        """
        if self.alone or device != "cuda":
            return
        if (found := torch.cuda.device_count()) < self.local_size:
            raise SystemRequirementError(
                f"There are {self.local_size} processes on this machine, and {found} GPUs.",
                f"Start one for each: `torchrun --nproc-per-node {found} -m hineus_cli ...`.",
            )
        torch.cuda.set_device(self.local)

    # ------------------------------------------------------------------ a step
    def share(self, count: int) -> slice:
        """The rows of `count` that are this process's.

        Raises:
            ValueError: there are fewer rows than processes.
        """
        if count < self.size and not self.alone:
            raise ValueError(f"{count} rays cannot be shared by {self.size} processes")
        return slice(count * self.rank // self.size, count * (self.rank + 1) // self.size)

    def seed(self, seed: int, step: int) -> int:
        """Of what this process draws for itself at a step."""
        return int(np.random.SeedSequence([seed, step, self.rank]).generate_state(1, np.uint64)[0] >> np.uint64(1))

    @torch.no_grad()
    def sum_gradients(self, parameters: Sequence[Tensor], beside: Sequence[Tensor]) -> list[Tensor]:
        """Sum the parameters' gradients over all processes where they lie, and `beside` with them; returns those sums.

        One exchange of all in float32. A parameter has a gradient afterwards if it had one in any process: the
        optimiser passes over parameters that have none.
        """
        present = torch.tensor([float(p.grad is not None) for p in parameters], device=beside[0].device)
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in parameters]
        tensors = [present, *gradients, *beside]
        flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
        with self._together():
            dist.all_reduce(flat)
        sums = [
            part.view_as(like) for part, like in zip(flat.split([t.numel() for t in tensors]), tensors, strict=True)
        ]
        for parameter, anywhere, gradient in zip(parameters, sums[0], sums[1:], strict=False):
            if parameter.grad is not None:
                parameter.grad.copy_(gradient)
            elif anywhere > 0:
                parameter.grad = gradient.clone()
        return sums[1 + len(gradients) :]

    @torch.no_grad()
    def take_from_first(self, tensors: Sequence[Tensor]) -> None:
        """Give these tensors the first process's values, where they lie."""
        with self._together():
            for tensor in tensors:
                dist.broadcast(tensor, src=0)

    @torch.no_grad()
    def check_same(self, parameters: Sequence[Tensor]) -> None:
        """
        Raises:
            SystemRequirementError: float32 parameters are not the same in all processes, bit for bit.
        """
        sums = torch.stack([p.detach().reshape(-1).view(torch.int32).sum(dtype=torch.int64) for p in parameters])
        extremes = torch.stack([sums, -sums])
        with self._together():
            dist.all_reduce(extremes, dist.ReduceOp.MAX)
        if not torch.equal(extremes[0], -extremes[1]):
            self.cut_off = True
            raise SystemRequirementError(
                f"The networks of the {self.size} processes are no longer the same.",
                "Processors or libraries that round otherwise do that: use machines of one kind.",
            )

    # ------------------------------------------------------------------ who leads, and who follows
    @contextmanager
    def leading(self, training: bytes) -> Iterator[None]:
        """As the first: inside, the others are at this training, described in bytes. They are told when it ends."""
        if not self.alone:
            self._tell_training(training)
        try:
            yield
        finally:
            if not (self.alone or self.cut_off):
                self._tell(_END)

    def step(self, work: Callable[[float], Result], progress: float) -> Result:
        """As the first: `work(progress)`, as the others do now."""
        if self.alone:
            return work(progress)
        self._tell(progress)
        with self._whole():
            return work(progress)

    def trainings(self) -> Iterator[bytes]:
        """As one of the others: what the first says of each training, until there are no more. Make all its `steps`."""
        while (training := self._tell_training(None)) is not None:
            yield training

    def steps(self) -> Iterator[float]:
        """As one of the others: the progress at each step of this training."""
        while (progress := self._tell(_END)) != _END:
            yield progress

    def end(self) -> None:
        """As the first: let the others end."""
        if not (self.alone or self.cut_off):
            self._tell_training(None)

    def _tell(self, number: float) -> float:
        """The first one's number."""
        told = torch.tensor(number, dtype=torch.float64)
        with self._together():
            dist.broadcast(told, src=0, group=self._orders)
        return float(told)

    def _tell_training(self, training: bytes | None) -> bytes | None:
        """The first one's."""
        told = [training]
        with self._together():
            dist.broadcast_object_list(told, src=0, group=self._orders)
        return told[0]

    @contextmanager
    def _together(self) -> Iterator[None]:
        """Inside all processes exchange something.

        Raises:
            SystemRequirementError: one of them is gone, or something was cut off before.
        """
        if self.cut_off:
            raise self._lost("its own last step was cut off")
        try:
            with self._whole():
                yield
        except RuntimeError as error:
            raise self._lost("one of them has ended, or does not answer") from error

    @contextmanager
    def _whole(self) -> Iterator[None]:
        """What is cut off inside, by an error or a signal, leaves the others in the middle of it."""
        try:
            yield
        except BaseException:
            self.cut_off = True
            raise

    def _lost(self, why: str) -> SystemRequirementError:
        return SystemRequirementError(
            f"Process {self.rank} of {self.size} cannot go on without the others: {why}.",
            "What went wrong is told before this, or by another one. The last checkpoint is kept: run the same command "
            "again to go on.",
        )


ALONE = Ranks()
_ours = ALONE


def ours() -> Ranks:
    """This process's place: alone, unless it has `joined` others."""
    return _ours


@contextmanager
def joined() -> Iterator[Ranks]:
    """Inside, this process is one of those that torchrun started. Its own children are not: they are ordinary ones."""
    global _ours
    nccl = torch.cuda.is_available() and dist.is_nccl_available()
    dist.init_process_group("cpu:gloo,cuda:nccl" if nccl else "gloo", timeout=EXCHANGE)
    rank, size = int(os.environ.pop("RANK")), int(os.environ.pop("WORLD_SIZE"))
    _ours = Ranks(rank, size, int(os.environ.get("LOCAL_RANK", 0)), int(os.environ.get("LOCAL_WORLD_SIZE", 1)))
    try:
        yield _ours
    finally:
        if _ours.is_first:
            with suppress(SystemRequirementError):  # the others are gone, which was told
                _ours.end()
        if not _ours.cut_off:
            dist.destroy_process_group()
        _ours = ALONE
