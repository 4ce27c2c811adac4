"""360-degree pictures: how they are told from photos, and the pinhole views that they are split into.

A panorama's frame has OpenCV axes: z towards the picture's middle, x right, y down. Pixel centres are at .5.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from stages.capture.photo_reading import PREVIEW_SIDE, UnusableError, memory_for, telling_damage
from stages.inputs.formats import RAW_SUFFIXES, open_image

if TYPE_CHECKING:
    from jaxtyping import Float, UInt8

# "auto": those that are 360-degree pictures by what they say or show; "split": all twice as wide as high, too.
Mode = Literal["auto", "split", "off"]

VIEW_DEG = 90.0  # field of view of a view, both ways
LEVEL_STEP_DEG = 45.0  # a feature is never more than half of it off the middle of some view, so little stretched
STRETCH = 0.005  # a picture this near to twice as wide as high may be a sphere: some are reduced by odd factors
# The left and the right border of a sphere are neighbours: their detail, smoothed over a part of the height taken off,
# is alike. Plain walls have none in grey levels that would tell.
DETAIL_PART, MIN_DETAIL, MIN_LIKENESS = 0.03, 1.5, 0.5
# Two round pictures side by side, as the lenses of a 360-degree camera saw them: black around, not so near their rims.
DARK, DARK_SHARE, LIT_SHARE = 16, 0.97, 0.6
# Files of 360-degree cameras that only their makers' programs stitch.
UNSTITCHED = {
    ".insp": "an Insta360's photo of two fisheye lenses",
    ".insv": "an Insta360's video of two fisheye lenses",
    ".360": "a GoPro Max's video of two lenses",
}
STITCH = "stitch it and export it as a 360-degree picture or video (equirectangular) with the camera's own program"

LEAST_AROUND, MOST_AROUND = 0.9, 100.0  # times a picture's width that the whole turn may have

_PROJECTION = re.compile(rb"ProjectionType\s*(?:=\s*[\"']|>)\s*([A-Za-z]+)")


@dataclass(frozen=True)
class Sphere:
    """Where a picture lies on the whole sphere, in its own pixels.

    Attributes:
        size: width and height of the picture.
        width: of the whole 360 degrees; the whole height is half of it.
        left, top: of the picture's corner.
    """

    size: tuple[int, int]
    width: float
    left: float = 0.0
    top: float = 0.0

    @property
    def side(self) -> int:
        """Of a view in pixels, as fine in its middle as the picture at its equator."""
        return round(self.width / np.pi * np.tan(np.radians(VIEW_DEG / 2)))


@dataclass(frozen=True)
class View:
    """One pinhole view of a panorama: its name, and [3, 3] the rotation from the panorama's frame into its own."""

    name: str
    cam_from_panorama: Float[np.ndarray, "3 3"]


def _level(yaw_deg: float) -> View:
    cos, sin = np.cos(np.radians(yaw_deg)), np.sin(np.radians(yaw_deg))
    return View(f"{yaw_deg:03.0f}", np.array([[cos, 0, -sin], [0, 1, 0], [sin, 0, cos]]))


# All around, and up. Not down: there are the tripod, or who holds the camera.
VIEWS = (
    *(_level(yaw_deg) for yaw_deg in np.arange(0, 360, LEVEL_STEP_DEG)),
    View("up", np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])),
)


def focal_px(side: int) -> float:
    """Of a view of so many pixels a side."""
    return side / 2 / float(np.tan(np.radians(VIEW_DEG / 2)))


# ---------------------------------------------------------------- which pictures
def find_spheres(files: Mapping[str, Path], mode: Mode) -> tuple[dict[str, Sphere], dict[str, str]]:
    """The 360-degree pictures among files; and those that are panoramas of other kinds, with the reason.

    Of pictures that do not say what they are, those of one size are taken for the same kind: what most show.
    """
    spheres: dict[str, Sphere] = {}
    others: dict[str, str] = {}
    closing: dict[tuple[int, int], dict[str, bool]] = {}
    for path, file in files.items() if mode != "off" else ():
        if file.suffix.lower() in RAW_SUFFIXES:
            continue
        try:
            sphere, closes = _look(file, mode)
        except UnusableError as reason:
            others[path] = str(reason)
            continue
        if sphere is not None and closes is None:
            spheres[path] = sphere
        elif sphere is not None and closes is not None:
            closing.setdefault(sphere.size, {})[path] = closes
    for size, found in closing.items():
        if 2 * sum(found.values()) > len(found):
            spheres |= {path: Sphere(size, size[0]) for path in found}
    others |= {path: _too_little(sphere) for path, sphere in spheres.items() if split_size(sphere)[0] == 0}
    return {path: spheres[path] for path in files if path in spheres and path not in others}, others


def _look(file: Path, mode: Mode) -> tuple[Sphere | None, bool | None]:
    """The sphere that a picture is or may be; whether its borders meet, None where that need not be asked.

    Raises:
        UnusableError: it is a panorama of another kind.
    """
    try:
        size, xmp, grey = _glance(file)
    except UnusableError:
        return None, None  # who reads it says so
    projection = _PROJECTION.search(xmp)
    if projection is not None:
        return _stated(size, xmp, projection[1].decode().lower()), None
    if grey is None:
        return None, None
    if is_dual_fisheye(grey):
        raise UnusableError(f"a picture of two fisheye lenses: {STITCH}")
    return Sphere(size, size[0]), None if mode == "split" else borders_meet(grey)


def _glance(file: Path) -> tuple[tuple[int, int], bytes, np.ndarray | None]:
    """Size, XMP, and, where it is twice as wide as high, grey pixels [H, W] uint8, perhaps reduced.

    Raises:
        UnusableError: it cannot be read, or not with the memory that is free.
    """
    with telling_damage(), open_image(file) as stored:
        size, xmp, grey = stored.size, _xmp(stored), None
        if abs(size[0] / size[1] / 2 - 1) <= STRETCH:
            with memory_for(stored, file, PREVIEW_SIDE):
                stored.draft("L", (PREVIEW_SIDE, PREVIEW_SIDE // 2))
                grey = np.asarray(stored.convert("L").reduce(max(1, stored.height // (PREVIEW_SIDE // 2))))
    return size, xmp, grey


def _xmp(stored: Any) -> bytes:
    xmp = stored.info.get("xmp") or stored.info.get("XML:com.adobe.xmp") or b""
    return xmp.encode() if isinstance(xmp, str) else bytes(xmp)


def _stated(size: tuple[int, int], xmp: bytes, projection: str) -> Sphere:
    """What Google's photo sphere metadata (GPano) say; its numbers are of the picture before it was reduced."""
    if projection != "equirectangular":
        raise UnusableError(f"a panorama of {projection} projection, which no camera model fits")

    def number(name: str, default: float) -> float:
        found = re.search(rb"%s\s*(?:=\s*[\"']|>)\s*(\d+)" % name.encode(), xmp)
        return min(float(found[1]), 1e9) if found else default

    stored_width = number("CroppedAreaImageWidthPixels", size[0]) or size[0]
    scale = size[0] / stored_width
    width = number("FullPanoWidthPixels", stored_width)
    middle = (width / 2 - size[1] / scale) / 2  # of the height
    left, top = number("CroppedAreaLeftPixels", 0), number("CroppedAreaTopPixels", max(middle, 0))
    sphere = Sphere(size, width * scale, left * scale, top * scale)
    if not LEAST_AROUND <= sphere.width / size[0] <= MOST_AROUND or max(sphere.left, sphere.top) > sphere.width:
        raise UnusableError("a panorama that says of itself what cannot be (FullPanoWidthPixels and the like)")
    return sphere


def _too_little(sphere: Sphere) -> str:
    across, high = (360 * side / sphere.width for side in sphere.size)
    return f"a panorama of {across:.0f} x {high:.0f} degrees: only 360-degree pictures are split into views"


def borders_meet(grey: UInt8[np.ndarray, "h w"]) -> bool:
    """Whether the left and right columns of a picture show the same detail, as those of a whole turn do."""
    import cv2

    columns = grey[:, [0, -1]].astype(np.float32)
    blur = cv2.GaussianBlur(columns, (1, 0), sigmaX=1e-3, sigmaY=max(1.0, DETAIL_PART * len(columns)))
    detail = columns - blur
    if detail.std(0).min() < MIN_DETAIL:
        return False
    return float(np.corrcoef(detail.T)[0, 1]) >= MIN_LIKENESS


def is_dual_fisheye(grey: UInt8[np.ndarray, "h w"]) -> bool:
    """Whether a picture twice as wide as high shows two circles side by side on black."""
    height, width = grey.shape
    y, x = np.mgrid[0:height, 0:width]
    radius = np.hypot(x % (width / 2) + 0.5 - width / 4, y + 0.5 - height / 2) / (height / 2)
    around, rim = grey[radius > 1.05], grey[(radius > 0.7) & (radius < 0.9)]
    return bool((around < DARK).mean() > DARK_SHARE and (rim >= DARK).mean() > LIT_SHARE)


# ---------------------------------------------------------------- views
def split(pixels: UInt8[np.ndarray, "h w *c"], sphere: Sphere, side: int) -> Iterator[tuple[View, np.ndarray]]:
    """The views that lie on the picture whole, with their pixels [side, side, ...]."""
    import cv2

    # a pixel more on both sides, from the other end: interpolation goes on around the sphere
    whole = round(sphere.width) == pixels.shape[1]
    wrapped = np.concatenate([pixels[:, -2:], pixels, pixels[:, :2]], 1) if whole else pixels
    for view in VIEWS:
        maps = _maps(view.name, sphere, side)
        if maps is not None:
            x, y = maps[0] + 2 * whole, maps[1]
            yield view, cv2.remap(wrapped, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)


@lru_cache(maxsize=2 * len(VIEWS))
def _maps(name: str, sphere: Sphere, side: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Positions in the picture of a view's pixels, x and y [side, side] float32 as cv2.remap wants them (centres at
    integers); None where some lie beside it."""
    (view,) = (view for view in VIEWS if view.name == name)
    x, y = (np.mgrid[0:side, 0:side][::-1] + 0.5 - side / 2) / focal_px(side)
    rays = np.stack([x, y, np.ones_like(x)], -1) @ view.cam_from_panorama
    yaw = np.arctan2(rays[..., 0], rays[..., 2])
    pitch = np.arctan2(rays[..., 1], np.hypot(rays[..., 0], rays[..., 2]))
    column = (yaw / (2 * np.pi) + 0.5) * sphere.width - sphere.left
    row = (pitch / np.pi + 0.5) * sphere.width / 2 - sphere.top
    column = np.where(column < 0, column + sphere.width, column)
    inside = (column <= sphere.size[0]) & (row >= 0) & (row <= sphere.size[1])
    if not inside.all():
        return None
    return (column - 0.5).astype(np.float32), (row - 0.5).astype(np.float32)


def split_size(sphere: Sphere) -> tuple[int, int]:
    """How many views a picture gives, and their side in pixels."""
    small = 16  # views that lie on the picture do so at any size
    return sum(_maps(view.name, sphere, small) is not None for view in VIEWS), sphere.side
