"""Corners and matches of learned descriptors, written into COLMAP's database."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from stages.inputs.formats import open_image
from stages.posing.corners import find_corners
from stages.posing.xfeat import XFeat, describe_points, mutual_best, mutual_matches

# Matches that are not worth a search for an epipolar geometry: five make up any.
MIN_MATCHES = 8
# Where poses are known: degrees between viewing directions, pixels from the epipolar line, cosine of descriptors.
GUIDED_ANGLE_DEG, GUIDED_PX, GUIDED_COSINE = 60.0, 2.0, 0.7
# In large sets a photo is matched with so many that look most like it.
LIKELY_PARTNERS = 30

Descriptors = Mapping[int, Any]
Progress = Callable[[float], None]


def write_corners(
    database: Path, images_folder: Path, masks_folder: Path | None, network: XFeat, progress: Progress
) -> dict[int, Any]:
    """Write the corners of all photos of a database; returns their descriptors [n, 64] by image id.

    Args:
        masks_folder: corners are looked for where PHOTO.png in there is not black; everywhere without.
        progress: told the part that is done.
    """
    import pycolmap

    descriptors = {}
    with pycolmap.Database.open(database) as opened:
        images = sorted(opened.read_all_images(), key=lambda image: image.image_id)
        for done, image in enumerate(images):
            progress(done / len(images))
            mask = None if masks_folder is None else masks_folder / f"{image.name}.png"
            corners, descriptors[image.image_id] = corners_of(images_folder / image.name, mask, network)
            opened.write_keypoints(image.image_id, corners.astype(np.float32))
    return descriptors


def corners_of(photo: Path, mask: Path | None, network: XFeat) -> tuple[np.ndarray, Any]:
    """Corners [n, 2] in pixels of a photo, and their descriptors [n, 64]."""
    import torch

    pixels = _grey(photo)
    corners = find_corners(pixels)
    if mask is not None:
        columns, rows = np.floor(corners).astype(int).T
        corners = corners[_grey(mask)[rows, columns] > 0]
    device = next(network.parameters()).device
    with torch.inference_mode():
        points = torch.from_numpy(corners.astype(np.float32)).to(device)
        return corners, describe_points(network, torch.from_numpy(pixels).to(device), points)


def write_matches(
    database: Path, descriptors: Descriptors, pairs: Iterable[tuple[int, int]], progress: Progress
) -> None:
    """Write the mutual nearest neighbours of pairs of image ids, which have no matches yet."""
    import pycolmap
    import torch

    pairs = list(pairs)
    with pycolmap.Database.open(database) as opened, torch.inference_mode():
        for done, (first, second) in enumerate(pairs):
            progress(done / len(pairs))
            matches = mutual_matches(descriptors[first], descriptors[second])
            if len(matches) >= MIN_MATCHES:
                opened.write_matches(first, second, matches)


def write_guided_matches(database: Path, descriptors: Descriptors, model: Any) -> None:
    """Replace the matches of pairs of photos that a model places by those that fit their poses.

    Near its epipolar line a corner has few rivals, so views that are further apart can be matched. Pairs with a photo
    that has no pose keep their matches.

    Args:
        model: pycolmap reconstruction on this database.
    """
    import pycolmap
    import torch

    with pycolmap.Database.open(database) as opened, torch.inference_mode():
        views = {i: _View.of(model.images[i], opened.read_keypoints(i)[:, :2]) for i in sorted(model.reg_image_ids())}
        for first, second in combinations(views, 2):
            if opened.exists_matches(first, second):
                opened.delete_matches(first, second)
            if views[first].forward @ views[second].forward < math.cos(math.radians(GUIDED_ANGLE_DEG)):
                continue
            far = torch.from_numpy(epipolar_distance(views[first], views[second]) > GUIDED_PX)
            cosines = (descriptors[first] @ descriptors[second].T).masked_fill(far.to(descriptors[first].device), -1)
            matches = mutual_best(cosines, GUIDED_COSINE)
            if len(matches) >= MIN_MATCHES:
                opened.write_matches(first, second, matches)


@dataclass(frozen=True)
class _View:
    """A photo of a model: pose [3, 4], rays [n, 3] of its corners with depth 1, and its focal length in pixels."""

    cam_from_world: np.ndarray
    rays: np.ndarray
    focal: float

    @classmethod
    def of(cls, image: Any, keypoints: np.ndarray) -> _View:
        normalised = np.asarray(image.camera.cam_from_img(keypoints.astype(np.float64))).reshape(-1, 2)
        rays = np.c_[normalised, np.ones(len(normalised))]
        return cls(np.asarray(image.cam_from_world().matrix()), rays, image.camera.mean_focal_length())

    @property
    def forward(self) -> np.ndarray:
        return self.cam_from_world[2, :3]


def epipolar_distance(first: _View, second: _View) -> np.ndarray:
    """[n, m] Sampson distance in pixels of all pairs of corners to the epipolar geometry of two poses."""
    rotation = second.cam_from_world[:, :3] @ first.cam_from_world[:, :3].T
    translation = second.cam_from_world[:, 3] - rotation @ first.cam_from_world[:, 3]
    essential = np.cross(np.eye(3), translation).T @ rotation
    lines, back = first.rays @ essential.T, second.rays @ essential
    steepness = (lines[:, :2] ** 2).sum(1)[:, None] / second.focal**2 + (back[:, :2] ** 2).sum(1)[None] / first.focal**2
    return np.abs(lines @ second.rays.T) / np.sqrt(steepness)


def likely_pairs(descriptors: Descriptors, all_up_to: int) -> list[tuple[int, int]]:
    """Pairs of image ids to match: all of small sets, else each photo with those whose mean descriptors are likest."""
    import torch

    ids = sorted(descriptors)
    if len(ids) <= all_up_to:
        return list(combinations(ids, 2))
    means = torch.stack([descriptors[i].mean(0) if len(descriptors[i]) else descriptors[i].new_zeros(64) for i in ids])
    cosines = torch.nn.functional.normalize(means, dim=1)
    nearest = (cosines @ cosines.T).fill_diagonal_(-2).topk(min(LIKELY_PARTNERS, len(ids) - 1)).indices.tolist()
    return sorted({(min(ids[i], ids[j]), max(ids[i], ids[j])) for i, partners in enumerate(nearest) for j in partners})


def _grey(path: Path) -> np.ndarray:
    """[H, W] float32, 0 to 255."""
    with open_image(path) as image:
        return np.asarray(image.convert("L"), dtype=np.float32)
