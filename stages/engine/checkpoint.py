"""Checkpoints: what a stage has learned so far, in one file that is whole, or known to be damaged."""

from __future__ import annotations

import logging
import pickle
import stat
import zipfile
from pathlib import Path
from typing import Any

from stages.artifacts.own_files import remove, written_whole

log = logging.getLogger(__name__)


class CheckpointDamaged(ValueError):  # noqa: N818 - it names the state of the file
    """The file is there but is not a checkpoint that was written whole."""


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write it beside the old one, then in its place: a kill leaves one of the two whole."""
    import torch

    with written_whole(path) as file:
        torch.save(state, file)


def read_checkpoint(path: Path) -> Any:
    """What was written, in the computer's own memory; None where there is nothing.

    The file is a zip, which holds a checksum of each of its parts; torch compares none of them.

    Raises:
        CheckpointDamaged: it is no file, its checksums do not agree, or it holds more than tensors and plain values.
    """
    import torch

    try:
        if not stat.S_ISREG(path.lstat().st_mode):
            raise CheckpointDamaged("it is no file")
        with zipfile.ZipFile(path) as archive:
            if any(part.compress_type != zipfile.ZIP_STORED for part in archive.infolist()):
                raise CheckpointDamaged("its parts are compressed")
            if (part := archive.testzip()) is not None:
                raise CheckpointDamaged(f"the contents of {part} changed")
        return torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError:
        return None
    except (MemoryError, CheckpointDamaged):
        raise
    except pickle.UnpicklingError as error:
        raise CheckpointDamaged("it holds more than tensors and plain values") from error
    except Exception as error:  # damaged files raise nearly anything
        raise CheckpointDamaged(str(error).partition("\n")[0] or type(error).__name__) from error


def set_aside(path: Path, why: str) -> None:
    """Rename a checkpoint that is of no use, and warn of that; the one that was set aside before goes."""
    aside = path.with_name(path.name + ".damaged")
    remove(aside)
    path.rename(aside)
    log.warning("the checkpoint is damaged (%s): its stage starts over; it is kept as %s", why, aside)
