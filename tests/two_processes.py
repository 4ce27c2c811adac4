"""Two processes that train together, as torchrun starts them, and what each of them finds."""

from __future__ import annotations

import multiprocessing
import os
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


def torchruns(rank: int, port: int) -> dict[str, str]:
    """What torchrun tells a process of its place among two."""
    places = {"RANK": rank, "WORLD_SIZE": 2, "LOCAL_RANK": rank, "LOCAL_WORLD_SIZE": 2, "MASTER_PORT": port}
    return {"MASTER_ADDR": "127.0.0.1", **{name: str(value) for name, value in places.items()}}


def in_two_processes(work: Callable[..., Any], folder: Path, *arguments: Any, seconds: float = 900) -> list[Any]:
    """What `work(*arguments)` returns in each of two processes, inside `joined`."""
    port, context = free_port(), multiprocessing.get_context("spawn")
    processes = [
        context.Process(target=_one, args=(work, rank, port, folder / f"{rank}.pt", arguments)) for rank in range(2)
    ]
    for process in processes:
        process.start()
    for process in processes:
        process.join(seconds)
    left = [process for process in processes if process.is_alive()]
    for process in left:
        process.kill()
    assert not left
    return [torch.load(folder / f"{rank}.pt", weights_only=False) for rank in range(2)]


def _one(work: Callable[..., Any], rank: int, port: int, answer: Path, arguments: tuple[Any, ...]) -> None:
    from stages.neural.ranks import joined

    os.environ |= torchruns(rank, port)
    torch.set_num_threads(1)
    with joined():
        torch.save(work(*arguments), answer)
