"""3D Tiles 1.1 (OGC 22-025r4): a `tileset.json` over GLBs of one model, and one over the tilesets of several.

A program draws the coarsest tile first and puts a finer one in its place when the tile's geometric error, seen from
where the viewer is, covers more than some pixels. Tiles have z up; what is in a GLB, with Y up, readers turn by
themselves. A transform, column by column in the file, leads from the tiles to their parent's frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from jaxtyping import Float

# What readers do with the contents of a GLB, whose up is Y.
TILE_FROM_GLTF = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
VERSION = "1.1"
# A flat model has a box, too: of its largest side, a side is at least this part.
THINNEST = 1e-6


@dataclass(frozen=True)
class Level:
    """A GLB of the model.

    Attributes:
        uri: relative to the tileset.
        bounds: lowest and highest corner in the frame of the tiles.
        error: metres by which its surface misses that of the finest level; 0 for that.
    """

    uri: str
    bounds: Float[np.ndarray, "2 3"]
    error: float


def tileset(
    levels: Sequence[Level],
    earth_centred_from_tile: Float[np.ndarray, "4 4"] | None = None,
    extras: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """The tileset of one model, each tile replaced by the next finer one.

    Args:
        levels: the finest first.
        earth_centred_from_tile: to metres from the Earth's centre (EPSG:4978); None where that is not known.
        extras: JSON-able, kept in the asset's extras.

    Raises:
        ValueError: there is no level, or the finest has an error.
    """
    if not levels or levels[0].error != 0:
        raise ValueError(f"expected levels, the first without error, got {[level.error for level in levels]}")
    bounds = np.stack([level.bounds for level in levels])
    lowest, highest = bounds[:, 0].min(0), bounds[:, 1].max(0)
    box = _box(lowest, highest)
    # a coarser tile never claims to be the better one
    errors = np.maximum.accumulate([level.error for level in levels])
    tile: dict[str, Any] = {}
    for level, error in zip(levels, errors.tolist(), strict=True):
        finer = {"children": [tile]} if tile else {}
        tile = {
            "boundingVolume": {"box": box},
            "geometricError": error,
            "refine": "REPLACE",
            "content": {"uri": level.uri},
            **finer,
        }
    if earth_centred_from_tile is not None:
        tile["transform"] = earth_centred_from_tile.T.ravel().tolist()
    whole = max(float(np.linalg.norm(highest - lowest)), float(errors[-1]))
    return _file(whole, tile, extras)


def joined(tilesets: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
    """A tileset over others that share one frame: the Earth's, or their own where none says where it lies.

    Args:
        tilesets: what the files hold, by their URIs relative to the new one.

    Raises:
        ValueError: there is none, some lie on the Earth and others do not, or one is no tileset of ours.
    """
    if not tilesets:
        raise ValueError("expected one tileset or more, got none")
    roots = {uri: _root(each, uri) for uri, each in tilesets.items()}
    elsewhere = [uri for uri, each in roots.items() if not each.on_earth]
    if 0 < len(elsewhere) < len(roots):
        there = len(roots) - len(elsewhere)
        raise ValueError(f"{there} of {len(roots)} tilesets say where on Earth they lie, {elsewhere[0]} does not")
    boxes = {uri: _moved(each.box, each.transform) for uri, each in roots.items()}
    # axes of the first box: those of the Earth's centre would be askew
    axes = boxes[next(iter(boxes))].reshape(4, 3)[1:]
    axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
    corners = np.concatenate([_corners(box) for box in boxes.values()]) @ axes.T
    whole = np.array(_box(corners.min(0), corners.max(0))).reshape(4, 3) @ axes
    error = max(each.error for each in roots.values())
    children = [
        {"boundingVolume": {"box": box.tolist()}, "geometricError": roots[uri].error, "content": {"uri": uri}}
        for uri, box in boxes.items()
    ]
    root = {
        "boundingVolume": {"box": whole.ravel().tolist()},
        "geometricError": error,
        "refine": "REPLACE",
        "children": children,
    }
    return _file(max(error, float(np.linalg.norm(np.ptp(corners, axis=0)))), root, None)


def _file(error: float, root: dict[str, Any], extras: dict[str, Any] | None) -> dict[str, Any]:
    """The whole: `error` is that of drawing nothing."""
    return {
        "asset": {"version": VERSION, **({"extras": extras} if extras else {})},
        "geometricError": error,
        "root": root,
    }


def _box(lowest: Float[np.ndarray, " 3"], highest: Float[np.ndarray, " 3"]) -> list[float]:
    """Middle and the halves of three sides, twelve numbers."""
    halves = (highest - lowest) / 2
    halves = np.maximum(halves, THINNEST * halves.max())
    return [*((lowest + highest) / 2).tolist(), *np.diag(halves).ravel().tolist()]


def _moved(box: Float[np.ndarray, " 12"], matrix: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, " 12"]:
    moved = box.reshape(4, 3) @ matrix[:3, :3].T
    moved[0] += matrix[:3, 3]
    return moved.ravel()


def _corners(box: Float[np.ndarray, " 12"]) -> Float[np.ndarray, "8 3"]:
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    middle, *halves = box.reshape(4, 3)
    return middle + signs @ np.stack(halves)


@dataclass(frozen=True)
class _Root:
    """What `joined` asks of a tileset: its root's box [12] and transform [4, 4], and the error of drawing nothing."""

    box: Float[np.ndarray, " 12"]
    transform: Float[np.ndarray, "4 4"]
    on_earth: bool
    error: float


def _root(tiles: dict[str, Any], uri: str) -> _Root:
    try:
        root, error = tiles["root"], float(tiles["geometricError"])
        box = np.reshape(root["boundingVolume"]["box"], 12).astype(np.float64)
        transform = np.reshape(root.get("transform", np.eye(4).ravel()), (4, 4)).astype(np.float64).T
    except (AttributeError, KeyError, TypeError, ValueError):
        box = transform = np.array(np.nan)
        root, error = {}, -1.0
    if error < 0 or not np.isfinite([error, *box.ravel(), *transform.ravel()]).all():
        raise ValueError(f"{uri} is no tileset with a box about its root")
    return _Root(box, transform, "transform" in root, error)
