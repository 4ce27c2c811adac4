"""COLMAP's patch match stereo, where pycolmap was built with CUDA (`pycolmap.has_cuda`).

It was not run on a GPU: there was none. Tested is all around it: the workspace, which COLMAP's own fusion reads on a
CPU, and its files read back.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, wait
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stages.artifacts.pictures import IMAGES, Pictures, write_png
from stages.geometry.cameras import PinholeCameras, PosedScene
from stages.posing.colmap_model import pinhole_model
from stages.stereo.depths import views_of

if TYPE_CHECKING:
    from jaxtyping import Float, Float32, Integer

# Each photo is compared with so many at most: those that share the most sparse points with it. COLMAP's own choice.
SOURCES = 20
# Gigabytes of photos and maps that COLMAP keeps in memory.
CACHE_GB = 4.0
POLL_S = 1.0
# Where a camera sees nothing of what was found it has no range of depths, and COLMAP would stop.
MIN_POINTS = 3


def patch_match_depths(
    scene: PosedScene,
    pictures: Pictures,
    folder: Path,
    max_side: int,
    progress: Callable[[float, float, str], None],
) -> Iterator[tuple[int, Float32[np.ndarray, "h w"]]]:
    """Match all photos with their neighbours, then give them back one by one. Needs a GPU.

    Args:
        scene: of the pictures; its sparse points choose neighbours and ranges of depth.
        folder: empty; takes the photos, and some 50 bytes a pixel of each. The caller's to remove.
        max_side: photos are reduced to so many pixels along their longer side.
        progress: told how many of how many maps are there; each photo has two.

    Returns:
        Number of the photo, and its depths along the optical axis in units of the scene, 0 where unknown. Photos that
        overlap with no other are left out.

    Raises:
        ValueError: pycolmap's, where there is no GPU.
    """
    reduced = write_workspace(scene, pictures, folder, max_side)
    _match(folder, len(reduced), progress)
    for index in range(len(reduced)):
        if depth_path(folder, index).exists():
            yield index, read_depths(folder, index, reduced.sizes[index])


def write_workspace(scene: PosedScene, pictures: Pictures, folder: Path, max_side: int) -> PinholeCameras:
    """Write images/, sparse/ and stereo/ for COLMAP; arguments as above. Returns the cameras of the reduced photos.

    Photos are numbered, for COLMAP takes commas, blanks and `#` in names amiss. All have one size, with a black margin
    to the right and below: it copies them into arrays of the widest without regard to where rows begin.
    """
    import cv2

    cameras, reduced = scene.cameras, reduced_cameras(scene.cameras, max_side)
    width, height = reduced.sizes.max(0).tolist()
    for index, name in enumerate(cameras.names):
        size = tuple(reduced.sizes[index].tolist())
        canvas = np.zeros((height, width, 3), np.uint8)
        canvas[: size[1], : size[0]] = cv2.resize(pictures.image(name), size, interpolation=cv2.INTER_AREA)
        write_png(folder / IMAGES / _name(index), canvas, compression=1)
    colmap = replace(
        reduced,
        names=tuple(_name(index) for index in range(len(cameras))),
        sizes=np.tile([width, height], (len(cameras), 1)),
        intrinsics=reduced.intrinsics - np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]),  # its stereo has whole centres
    )
    (folder / "sparse").mkdir(parents=True)
    sparse_model(colmap, scene.points, scene.observations).write_binary(str(folder / "sparse"))
    for kind in ("depth_maps", "normal_maps"):
        (folder / "stereo" / kind).mkdir(parents=True)
    seen = np.bincount(scene.observations[:, 0], minlength=len(cameras))
    names = [_name(index) for index in np.flatnonzero(seen >= MIN_POINTS).tolist()]
    problems = "".join(f"{name}\n__auto__, {SOURCES}\n" for name in names)
    (folder / "stereo" / "patch-match.cfg").write_text(problems, encoding="ascii")
    (folder / "stereo" / "fusion.cfg").write_text("".join(f"{name}\n" for name in names), encoding="ascii")
    return reduced


def sparse_model(
    cameras: PinholeCameras, points: Float[np.ndarray, "p 3"], observations: Integer[np.ndarray, "m 2"]
) -> Any:
    """The pycolmap model of cameras and of the points that two or more of them see."""
    import pycolmap

    tracks = [pycolmap.Track() for _ in points]
    pixels = []
    for index in range(len(cameras)):
        seen = observations[observations[:, 0] == index, 1]
        pixels.append(cameras.project(index, points[seen])[0])
        for number, point in enumerate(seen.tolist()):
            tracks[point].add_element(index + 1, number)
    model = pinhole_model(cameras, pixels)
    for xyz, track in zip(points.astype(np.float64), tracks, strict=True):
        if track.length() > 1:
            model.add_point3D(xyz, track, np.zeros(3, np.uint8))
    return model


def reduced_cameras(cameras: PinholeCameras, max_side: int) -> PinholeCameras:
    """The cameras of photos that were reduced to at most `max_side` pixels along a side."""
    views = views_of(cameras, max_side)
    sizes, intrinsics = np.array([view.size for view in views]), np.stack([view.matrix for view in views])
    return replace(cameras, sizes=sizes, intrinsics=intrinsics)


def depth_path(folder: Path, index: int) -> Path:
    """Where COLMAP writes the depth map of a photo; not there where it was not matched."""
    return folder / "stereo" / "depth_maps" / f"{_name(index)}.geometric.bin"


def read_depths(folder: Path, index: int, size: Integer[np.ndarray, " 2"]) -> Float32[np.ndarray, "h w"]:
    """Depths of a photo of that size (without its margin), 0 where unknown."""
    width, height = size.tolist()
    depth = read_array(depth_path(folder, index))[:height, :width]
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)


def read_array(path: Path) -> Float32[np.ndarray, "h w"]:
    """An array of one channel as COLMAP writes it: `width&height&1&`, then the numbers row by row.

    Raises:
        ValueError: it holds another number of them.
    """
    width, height, _, data = path.read_bytes().split(b"&", 3)
    numbers, shape = np.frombuffer(data, "<f4"), (int(height), int(width))
    if len(numbers) != shape[0] * shape[1]:
        raise ValueError(f"{path}: expected {shape[1]} x {shape[0]} numbers, got {len(numbers)}")
    return numbers.reshape(shape)


def _match(folder: Path, photos: int, progress: Callable[[float, float, str], None]) -> None:
    import pycolmap

    options = pycolmap.PatchMatchOptions()
    options.allow_missing_files = True  # of photos that are compared with, but not matched themselves
    options.cache_size = CACHE_GB
    with ThreadPoolExecutor(1) as pool:
        run = pool.submit(pycolmap.patch_match_stereo, folder, options=options)
        finished = False
        while not finished:
            finished = bool(wait([run], POLL_S).done)
            done = sum(1 for _ in (folder / "stereo" / "depth_maps").iterdir())
            progress(done, 2 * photos, "matching")
        run.result()


def _name(index: int) -> str:
    return f"{index:06d}.png"
