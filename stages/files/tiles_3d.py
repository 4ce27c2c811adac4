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


# ---------------------------------------------------------------- over several
@dataclass(frozen=True)
class Root:
    """What one asks of a tileset that others are joined with.

    Attributes:
        box: [12] of its root.
        transform: of its root, to the frame that all share.
        on_earth: whether it has one.
        coarsest: URI, relative to the tileset, and error of what its root shows.
    """

    box: Float[np.ndarray, " 12"]
    transform: Float[np.ndarray, "4 4"]
    on_earth: bool
    coarsest: tuple[str, float]

    @property
    def placed_box(self) -> Float[np.ndarray, " 12"]:
        """Its box in the frame that all share."""
        return _moved(self.box, self.transform)


@dataclass(frozen=True)
class Overview:
    """A coarse model that is drawn in place of several tilesets, seen from far.

    Attributes:
        level: in the frame of the first tileset's root; its error against the finest levels of all.
        parts: what it stands for: URIs of tilesets, or overviews over some.
    """

    level: Level
    parts: tuple[str | Overview, ...]


def roots(tilesets: Mapping[str, dict[str, Any]]) -> dict[str, Root]:
    """Of tilesets that share one frame: the Earth's, or their own where none says where it lies.

    Args:
        tilesets: what the files hold, by their URIs relative to the new one.

    Raises:
        ValueError: there is none, some lie on the Earth and others do not, or one is no tileset of ours.
    """
    if not tilesets:
        raise ValueError("expected one tileset or more, got none")
    found = {uri: _root(each, uri) for uri, each in tilesets.items()}
    elsewhere = [uri for uri, each in found.items() if not each.on_earth]
    if 0 < len(elsewhere) < len(found):
        there = len(found) - len(elsewhere)
        raise ValueError(f"{there} of {len(found)} tilesets say where on Earth they lie, {elsewhere[0]} does not")
    return found


def joined(overview: Overview, found: Mapping[str, Root]) -> dict[str, Any]:
    """A tileset whose root is a coarse model, which what it stands for replaces.

    Overviews lie in the frame of the first tileset, so that numbers in their files are small; what leads from there to
    the Earth's centre is taken back before each tileset, which has a transform of its own.

    Args:
        found: of all tilesets, see `roots`.

    Returns:
        What its file holds.
    """
    first = next(iter(found.values()))
    root, corners = _overview_tile(overview, found, np.linalg.inv(first.transform))
    if first.on_earth:
        root["transform"] = first.transform.T.ravel().tolist()
    return _file(max(root["geometricError"], float(np.linalg.norm(np.ptp(corners, axis=0)))), root, None)


def _overview_tile(
    part: Overview | str, found: Mapping[str, Root], frame_from_shared: Float[np.ndarray, "4 4"]
) -> tuple[dict[str, Any], Float[np.ndarray, "8 3"]]:
    """A tile and the corners of its box in the frame of the first tileset."""
    if isinstance(part, str):
        box, (_, error) = found[part].placed_box, found[part].coarsest
        tile = {"boundingVolume": {"box": box.tolist()}, "geometricError": error, "content": {"uri": part}}
        back = {"transform": frame_from_shared.T.ravel().tolist()} if found[part].on_earth else {}
        return {**back, **tile}, _corners(_moved(box, frame_from_shared))
    tiles, boxes = zip(*(_overview_tile(each, found, frame_from_shared) for each in part.parts), strict=True)
    corners = np.concatenate([*boxes, part.level.bounds])
    whole = _box(corners.min(0), corners.max(0))
    tile = {
        "boundingVolume": {"box": whole},
        # a coarser tile never claims to be the better one
        "geometricError": max(part.level.error, *(each["geometricError"] for each in tiles)),
        "refine": "REPLACE",
        "content": {"uri": part.level.uri},
        "children": list(tiles),
    }
    return tile, _corners(np.array(whole))


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


def _root(tiles: dict[str, Any], uri: str) -> Root:
    try:
        root = tiles["root"]
        box = np.reshape(root["boundingVolume"]["box"], 12).astype(np.float64)
        transform = np.reshape(root.get("transform", np.eye(4).ravel()), (4, 4)).astype(np.float64).T
        content, error = str(root["content"]["uri"]), float(root["geometricError"])
    except (AttributeError, KeyError, TypeError, ValueError) as problem:
        raise ValueError(f"{uri} is no tileset with a model and a box about its root") from problem
    if error < 0 or not np.isfinite([error, *box.ravel(), *transform.ravel()]).all():
        raise ValueError(f"{uri} is no tileset with a model and a box about its root")
    return Root(box, transform, "transform" in root, (content, error))
