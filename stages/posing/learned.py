"""Corners and matches of learned descriptors, written into COLMAP's database."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from stages.posing.corners import find_corners
from stages.posing.xfeat import XFeat, describe_points, mutual_matches

# Matches that are not worth a search for an epipolar geometry: five make up any.
MIN_MATCHES = 8
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
    """Write the mutual nearest neighbours of pairs of image ids; what the pairs had is replaced."""
    import pycolmap
    import torch

    pairs = list(pairs)
    with pycolmap.Database.open(database) as opened, torch.inference_mode():
        for done, (first, second) in enumerate(pairs):
            progress(done / len(pairs))
            matches = mutual_matches(descriptors[first], descriptors[second])
            if len(matches) >= MIN_MATCHES:
                opened.write_matches(first, second, matches)


def likely_pairs(descriptors: Descriptors, all_up_to: int) -> list[tuple[int, int]]:
    """Pairs of image ids to match: all of small sets, else each photo with those whose mean descriptors are likest."""
    import torch

    ids = sorted(descriptors)
    if len(ids) <= all_up_to:
        return list(combinations(ids, 2))
    means = torch.stack([descriptors[i].mean(0) if len(descriptors[i]) else torch.zeros(64) for i in ids])
    cosines = torch.nn.functional.normalize(means, dim=1)
    nearest = (cosines @ cosines.T).fill_diagonal_(-2).topk(min(LIKELY_PARTNERS, len(ids) - 1)).indices.tolist()
    return sorted({(min(ids[i], ids[j]), max(ids[i], ids[j])) for i, partners in enumerate(nearest) for j in partners})


def _grey(path: Path) -> np.ndarray:
    """[H, W] float32, 0 to 255."""
    from PIL import Image

    with Image.open(path) as image:
        return np.asarray(image.convert("L"), dtype=np.float32)
