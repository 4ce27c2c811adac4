"""What is wrong with a set of masks, seen from their pictures: one sentence and a command for each kind."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from stages.capture.listing import name_some
from stages.capture.mask_fit import TURNS, OutlineFit, outline_fit

MasksKeep = Literal["auto", "white", "black"]

WHOLE = 0.999  # a mask that keeps more than this part of the photo cuts nothing out
BORDER = 0.02  # width of the border that is looked at, as part of the longest side
# The development sets' masks keep 0 to 0.51 of the border (inverted: 0.49 to 1), and of the middle from 0.1 less to 1
# more than that.
KEPT_BORDER = 0.9
MUCH_OF_BORDER, MORE_THAN_MIDDLE = 0.4, 0.2
MOST = 0.7  # this part of the masks says what the set is like
FITTING = 0.25  # fewer masks than this that fit their photos: by chance it is 0 to 0.06, see `mask_fit`
MIN_SET = 3  # fewer masks than this say nothing of their set
COARSE = 0.25  # a mask this small beside its photo has edges of several pixels
BLACK, WHITE = 40, 215  # a photo has more than a few pixels between these
GREY_CAST = 12  # difference of colour channels that JPEG leaves in grey
TWO_VALUED, EACH_VALUE = 0.98, 0.002  # a photo that is black and white to this part is a mask


@dataclass(frozen=True)
class MaskLook:
    """What was seen of one mask.

    Attributes:
        photo, file: paths relative to the folder of photos, and the mask's name.
        kept: part of the photo that it keeps.
        border: part of the photo's border that it keeps; `middle`: of the middle, half as wide and high.
        same: masks with the same are the same picture.
        size, photo_size: width and height in pixels, of the mask's file and of the upright photo.
        fit: of its outline on the photo's edges, where it has one.
    """

    photo: str
    file: str
    kept: float
    border: float
    middle: float
    same: str
    size: tuple[int, int]
    photo_size: tuple[int, int]
    fit: OutlineFit | None

    @property
    def seems_inverted(self) -> bool:
        framed = self.border > KEPT_BORDER and self.middle < self.border and self.kept <= WHOLE
        return framed or (self.border > MUCH_OF_BORDER and self.border - self.middle > MORE_THAN_MIDDLE)


@dataclass(frozen=True)
class Doubt:
    """Something wrong with the masks; `impossible`: nothing good can come of them."""

    message: str
    hint: str
    impossible: bool = False


def look(photo: str, file: str, mask: np.ndarray, size: tuple[int, int], rgb: np.ndarray) -> MaskLook:
    """At `mask` [H, W] bool of the upright photo `rgb` [h, w, 3] uint8; `size`: width and height of the mask's file."""
    height, width = mask.shape
    edge = max(1, round(BORDER * max(mask.shape)))
    border = np.ones(mask.shape, bool)
    border[edge:-edge, edge:-edge] = False
    middle = mask[height // 4 : height - height // 4, width // 4 : width - width // 4]
    return MaskLook(
        photo,
        file,
        kept=float(mask.mean()),
        border=float(mask[border].mean()),
        middle=float(middle.mean()),
        same=hashlib.sha1(np.packbits(mask).tobytes(), usedforsecurity=False).hexdigest(),
        size=size,
        photo_size=(width, height),
        fit=outline_fit(mask, rgb),
    )


def find_doubts(looks: Sequence[MaskLook], masks_keep: MasksKeep = "auto") -> list[Doubt]:
    """All that is wrong with these masks; `masks_keep`: the colour that keeps, if the user has said which.

    Masks that keep nothing are not among them: their photos are left out one by one.
    """
    seen = [look for look in looks if look.kept > 0]
    if not seen:
        return []
    doubts = [_whole(seen), _inverted(seen, masks_keep), _same(seen) or _not_of_these(seen), _coarse(seen)]
    return [doubt for doubt in doubts if doubt is not None]


def nothing_kept(count: int, example: str) -> tuple[str, str]:
    """What to say, and the hint, where all masks keep nothing."""
    return (
        f"All {count} masks are empty: they keep nothing of their photos, e.g. of {example}.",
        "White is the object: make the masks again, or run without: `--no-masks`.",
    )


def is_black_and_white(rgb: np.ndarray) -> bool:
    """Whether a picture [H, W, 3] uint8 is a mask rather than a photo."""
    sample = rgb[:: max(1, rgb.shape[0] // 200), :: max(1, rgb.shape[1] // 200)].astype(np.int16)
    if (sample.max(axis=2) - sample.min(axis=2)).max() > GREY_CAST:
        return False
    black, white = float((sample.max(axis=2) < BLACK).mean()), float((sample.min(axis=2) > WHITE).mean())
    return black + white >= TWO_VALUED and min(black, white) >= EACH_VALUE


def _whole(seen: Sequence[MaskLook]) -> Doubt | None:
    whole = [look.file for look in seen if look.kept > WHOLE]
    if not whole:
        return None
    if len(whole) == len(seen):
        return Doubt(
            f"All {len(seen)} masks keep the whole photo and cut nothing out, e.g. {whole[0]}.",
            "Run without them: `--no-masks`.",
            impossible=True,
        )
    return Doubt(
        f"{len(whole)} of {len(seen)} masks keep the whole photo: {name_some(whole)}.",
        "Mend them if the object does not fill those photos, or run without: `--no-masks`.",
    )


def _inverted(seen: Sequence[MaskLook], masks_keep: MasksKeep) -> Doubt | None:
    inverted = [look.file for look in seen if look.seems_inverted]
    cutting = sum(look.kept <= WHOLE for look in seen)
    if not inverted:
        return None
    if len(inverted) < MOST * cutting:
        return Doubt(
            f"{len(inverted)} of {len(seen)} masks seem inverted against the others: {name_some(inverted)}.",
            "Invert those, or name the photos in `ingest.leave_out`.",
        )
    return Doubt(
        f"The masks seem inverted: in {len(inverted)} of {len(seen)} the photo's border is kept and something in its "
        f"middle cut out, e.g. {inverted[0]}.",
        f"Try the other colour: `--masks-{'white' if masks_keep == 'black' else 'black'}-keeps`."
        if masks_keep != "auto"
        else "Say which colour is the object: `--masks-black-keeps`, or `--masks-white-keeps` if they are right.",
        impossible=masks_keep == "auto",
    )


def _same(seen: Sequence[MaskLook]) -> Doubt | None:
    cutting = [look for look in seen if look.kept <= WHOLE]
    if len(cutting) < MIN_SET or len({look.same for look in cutting}) > 1:
        return None
    return Doubt(
        f"All {len(cutting)} masks are one and the same picture, e.g. {cutting[0].file}; the outline of an object "
        "differs from photo to photo.",
        "A mask of what to ignore, as of the lens or a tripod, is none of the object: run without, `--no-masks`.",
        impossible=len({look.file for look in cutting}) == 1,
    )


def _not_of_these(seen: Sequence[MaskLook]) -> Doubt | None:
    judged = [(look, look.fit) for look in seen if look.fit is not None]
    off = [(look, fit) for look, fit in judged if not fit.fits]
    if len(judged) < MIN_SET or len(judged) - len(off) >= FITTING * len(judged):
        return None
    message = (
        f"The masks do not seem to belong to these photos: the outlines of {len(off)} of {len(judged)} lie on no edges "
        f"of theirs, e.g. {off[0][0].file} on {off[0][0].photo}."
    )
    turn, count = Counter(fit.turn for _, fit in off).most_common(1)[0]
    if turn in TURNS and count >= MOST * len(off):
        return Doubt(message + f" They would fit {turn}.", "Make them again from these photos, or `--no-masks`.")
    return Doubt(
        message,
        "Look at one beside its photo (are they drawn far around the object?); name the right folder with `--masks`, "
        "or use `--no-masks`.",
    )


def _coarse(seen: Sequence[MaskLook]) -> Doubt | None:
    coarse = [look for look in seen if look.size[0] < COARSE * look.photo_size[0]]
    if not coarse:
        return None
    first = coarse[0]
    return Doubt(
        f"{len(coarse)} of {len(seen)} masks are much smaller than their photos, e.g. {first.file}: {first.size[0]} x "
        f"{first.size[1]} for {first.photo_size[0]} x {first.photo_size[1]}. Their outlines are coarse.",
        "Make them at the photos' size, or run without: `--no-masks`.",
    )
