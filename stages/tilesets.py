"""One tileset over those of several workspaces, with coarse models of all of them for who looks from far."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote, unquote

import numpy as np

from stages import artifacts
from stages.artifacts.blocks import block_folder, read_plan
from stages.engine.damage import damage_named
from stages.engine.workspace import Workspace, storage_errors
from stages.errors import InputError, ReconstructionError, WorkspaceError
from stages.export import EXPORT, generator
from stages.files.tiles_3d import TILE_FROM_GLTF, Level, Overview, Root, joined, roots
from stages.geometry.grouping import Group, groups_in, quartered
from stages.geometry.similarity import Similarity
from stages.surface.placing import placed

if TYPE_CHECKING:
    from stages.texture.merging import Textured

# Models that one overview stands for, at most: so many are in memory at once. More are put together by four first.
MOST_TOGETHER = 8
# Of an overview: faces, texels along a side, quality of the JPEG. That is two megabytes or so.
FACES, TEXELS, QUALITY = 30_000, 2048, 85
# An overview's error is that of so many of its texels at least. Viewers let an error cover 16 pixels, as a rule: they
# change to finer tiles before a texel covers more than two.
TEXELS_OF_ERROR = 8.0


def join_tilesets(
    workspaces: Sequence[Path], out: Path, progress: Callable[[int, int], None] = lambda done, total: None
) -> dict[str, Any]:
    """Write `out`, which names the workspaces' own tilesets relative to its folder, and models of all beside it.

    Of a workspace that is cut into blocks, the tilesets are those of the blocks.

    Args:
        progress: told how many of the models are done, of how many.

    Returns:
        How many tilesets and models, the models' bytes, and the extent.

    Raises:
        WorkspaceError: there is no workspace, or one has no tileset, or a damaged one.
        InputError: they do not share a frame, or `out` is one of them.
        ReconstructionError: they cannot be made one model.
    """
    opened = {
        quote(Path(os.path.relpath(_tileset(each, out), out.parent)).as_posix()): each
        for each in map(Workspace.open, chain.from_iterable(map(_parts, workspaces)))
    }
    tilesets = {}
    for uri, each in opened.items():
        with damage_named(each, (EXPORT.name,)):
            tilesets[uri] = artifacts.read_json(_tileset(each, out))
    try:
        found = roots(tilesets)
    except ValueError as error:
        raise InputError(
            f"There is no tileset over these workspaces: {error}.",
            "Those that lie on the Earth, by GPS or control points, can be joined, and blocks of one workspace.",
        ) from error
    with storage_errors(out, "writing the tileset"):
        out.parent.mkdir(parents=True, exist_ok=True)
        overview, sizes = _write_overviews(out, opened, found, progress)
        together = joined(overview, found)
        artifacts.write_json(out, together)
        artifacts.forget_overviews(out, len(sizes))
    return {
        "file": str(out.absolute()),
        "tiles": len(tilesets),
        "overviews": len(sizes),
        "bytes": {"first": sizes[-1], "overviews": sum(sizes)},
        "geometric_error": together["geometricError"],
    }


def _parts(workspace: Path) -> list[Path]:
    """The workspaces of its blocks, or itself where it is not cut into any."""
    plan = read_plan(workspace)
    return [workspace] if plan is None else [block_folder(workspace, block.name) for block in plan.blocks]


def _tileset(opened: Workspace, out: Path) -> Path:
    """A workspace's own."""
    path = opened.stage_folder(EXPORT.name) / artifacts.TILESET
    if not path.is_file():
        raise WorkspaceError(
            f"{opened.root} has no 3D Tiles.",
            f"Make them: `hineus run --workspace {opened.root} --set export.tiles=true`.",
        )
    if path.resolve() == out.resolve():
        raise InputError(f"{out} is the tileset of {opened.root}.", "Name another file: `--out tileset.json`.")
    return path


def _middle(root: Root, frame_from_shared: np.ndarray) -> np.ndarray:
    """[3] of a tileset's box, in the frame of the first."""
    middle: np.ndarray = frame_from_shared[:3, :3] @ root.placed_box[:3] + frame_from_shared[:3, 3]
    return middle


# ---------------------------------------------------------------- coarse models
@dataclass(frozen=True)
class _Far:
    """What is seen of one or several tilesets from far.

    Attributes:
        part: the tileset's URI, or what stands for several.
        look: in the frame of the first tileset's root, z up.
        error: metres by which its surface misses the finest levels.
    """

    part: str | Overview
    look: Textured
    error: float

    @property
    def overview(self) -> Overview:
        assert isinstance(self.part, Overview)
        return self.part


def _write_overviews(
    out: Path, opened: Mapping[str, Workspace], found: Mapping[str, Root], progress: Callable[[int, int], None]
) -> tuple[Overview, list[int]]:
    """Coarse models beside `out`, and the bytes of each; that of all is the last.

    Args:
        opened: the workspaces of the tilesets, by these' URIs. found: the tilesets' roots.
    """
    uris = list(found)
    frame_from_shared = np.linalg.inv(found[uris[0]].transform)
    group = quartered(np.stack([_middle(found[uri], frame_from_shared) for uri in uris]), MOST_TOGETHER)
    sizes: list[int] = []

    def coarsest(index: int) -> _Far:
        uri = uris[index]
        with damage_named(opened[uri], (EXPORT.name,)):
            return _coarsest(uri, opened[uri].stage_folder(EXPORT.name), found[uri], frame_from_shared)

    def write(look: Textured) -> str:
        path = artifacts.overview_path(out, len(sizes))
        path.parent.mkdir(exist_ok=True)
        sizes.append(path.write_bytes(_glb(look)))
        progress(len(sizes), groups_in(group))
        return quote(path.relative_to(out.parent).as_posix())

    try:
        return _overview(group, coarsest, write).overview, sizes
    except ValueError as error:
        raise ReconstructionError(
            f"There is no model over these tilesets: {error}.",
            "Make theirs again: `hineus export --workspace WORKSPACE`.",
        ) from error


def _overview(group: Group, coarsest: Callable[[int], _Far], write: Callable[[Textured], str]) -> _Far:
    """One model in place of a group's, whose own are made first.

    Args:
        coarsest: of a row, what its tileset's root shows.
        write: keeps a model, and gives its URI.
    """
    from stages.texture.merging import merged

    parts = [coarsest(each) if isinstance(each, int) else _overview(each, coarsest, write) for each in group]
    look, missed = merged([part.look for part in parts], FACES, _texture_size(parts))
    error = max(max(part.error for part in parts) + missed, TEXELS_OF_ERROR * look.texel_side)
    corners = look.mesh.vertices.astype(np.float64)
    level = Level(write(look), np.stack([corners.min(0), corners.max(0)]), error)
    return _Far(Overview(level, tuple(part.part for part in parts)), look, error)


def _texture_size(parts: Sequence[_Far]) -> int:
    """A power of two, enough for all texels that there are, `TEXELS` at most."""
    texels = sum(len(part.look.texture) ** 2 for part in parts)
    return min(1 << math.ceil(math.log2(texels) / 2), TEXELS)


def _coarsest(uri: str, folder: Path, root: Root, frame_from_shared: np.ndarray) -> _Far:
    """What a tileset's root shows.

    Raises:
        ValueError: it is no GLB of ours.
    """
    from stages.files.glb import read_glb
    from stages.texture.merging import Textured

    name, error = unquote(root.coarsest[0]), root.coarsest[1]
    if Path(name).name != name:
        raise ValueError(f"{uri} names a file of another folder, {name}")
    mesh, image = read_glb((folder / name).read_bytes())
    frame_from_tile = frame_from_shared @ root.transform
    rotation = frame_from_tile[:3, :3] @ TILE_FROM_GLTF
    vertices = mesh.vertices.astype(np.float64) @ rotation.T + frame_from_tile[:3, 3]
    return _Far(uri, Textured(replace(mesh, vertices=vertices), _pixels(image)), error)


def _pixels(image: bytes) -> np.ndarray:
    """[S, S, 3] uint8 sRGB, shrunk to what an overview can show of it."""
    import cv2

    found = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR)
    if found is None:
        raise ValueError("a texture cannot be read")
    side = min(len(found), TEXELS)
    shrunk: np.ndarray = cv2.resize(found, (side, side), interpolation=cv2.INTER_AREA)[..., ::-1]
    return np.ascontiguousarray(shrunk)


def _glb(look: Textured) -> bytes:
    import cv2

    from stages.files.contents import Textures
    from stages.files.glb import glb_bytes

    done, jpeg = cv2.imencode(".jpg", look.texture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    assert done
    upright = placed(look.mesh, Similarity(1.0, TILE_FROM_GLTF.T, np.zeros(3)))
    return glb_bytes(upright, Textures(jpeg.tobytes()), generator())
