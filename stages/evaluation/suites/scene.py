"""What a suite says of a scene: its photos, poses and masks, the photos to judge by, and the truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from stages.evaluation.photos.novel_views import NovelViews
from stages.inputs.formats import PHOTO_SUFFIXES


@dataclass(frozen=True)
class Wanted:
    """How the user wants scenes to be read.

    Attributes:
        masks: whether to use the masks that come with the photos; most papers' figures are without. An alpha channel
            is a mask in any case.
        hold_out: hold out every n-th photo where the suite has no test photos of its own; 0: none.
        truth: folder of the evaluation data, where it does not lie with the photos.
    """

    masks: bool = False
    hold_out: int = 0
    truth: Path | None = None

    def masks_in(self, folder: Path) -> Path | None:
        """A scene's folder of masks, if it is there and to be used."""
        return folder if self.masks and folder.is_dir() else None


@dataclass(frozen=True)
class Truth:
    """What the mesh is held against.

    Attributes:
        protocol: by which a suite's papers score, see `stages.evaluation.suites.scores`.
        folder: that the protocol reads.
        scan: the number DTU gives the scene.
        split: NeRO's file that names the test views; None: all are.
    """

    protocol: Literal["known", "dtu", "glossy", "depth maps"]
    folder: Path
    scan: int = 0
    split: Path | None = None


@dataclass(frozen=True)
class SuiteScene:
    """One scene.

    Attributes:
        name: as the paper's tables call it, for those they have.
        photos: folder. poses, masks: None where they are found or not used.
        views, truth: what can be scored.
        lacking: what cannot be scored and why, a sentence each.
    """

    name: str
    photos: Path
    poses: Path | None = None
    masks: Path | None = None
    views: NovelViews | None = None
    truth: Truth | None = None
    lacking: tuple[str, ...] = ()

    @property
    def left_out(self) -> tuple[str, ...]:
        """Test photos that lie among `photos`: no stage may see them."""
        return self.views.names if self.views is not None and self.views.folder == self.photos else ()


def photo_names(folder: Path) -> list[str]:
    """Photos directly in `folder`, sorted."""
    return sorted(
        path.name
        for path in folder.iterdir()
        if path.suffix.lower() in PHOTO_SUFFIXES and path.is_file() and not path.name.startswith(".")
    )


def every_nth(folder: Path, names: list[str], poses: Path, every: int) -> NovelViews | None:
    """Every n-th photo from the first, as Mip-NeRF 360 and LLFF do, as test views; None where `every` is 0."""
    return NovelViews(folder, tuple(names[::every]), poses) if every else None


def places_in(folder: Path) -> list[Path]:
    """`folder` itself and the folders in it, by name: each may be a scene."""
    return [folder, *sorted(path for path in folder.iterdir() if path.is_dir())]


def folders_with(folder: Path, *needed: str) -> list[Path]:
    """`folder` itself where it has all of the files or folders `needed`, else those of its folders that have."""
    found = [place for place in places_in(folder) if all((place / name).exists() for name in needed)]
    return found[:1] if folder in found else found
