"""Blocks of a large scene: their plan, which lies in the workspace of the whole, and what each block is given.

<whole>/blocks/plan.json
<whole>/blocks/<name>/                  the block's own workspace
<whole>/blocks/<name>/given/photos      links to the whole's photos that see it; `masks` likewise
<whole>/blocks/<name>/given/poses       a COLMAP model: the whole's cameras and points; how it lies in the world
<whole>/blocks/<name>/given/neighbours  tile.json; links to the fields of the blocks around it
<whole>/blocks/<name>/given/rough_gains.json  how bright its photos are among all of the whole
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from stages.artifacts.artifact import Artifact
from stages.artifacts.json_files import Array, PathInside, Record, read_record
from stages.artifacts.own_files import refuse_link, write_own
from stages.artifacts.place import SimilarityRecord
from stages.artifacts.train import FIELD, SCENE
from stages.geometry.tiling import BlockBox

NEIGHBOURS = "neighbours"  # the source of a block's stages that look beyond it
ROUGH_GAINS = "rough gains"  # the source of its bake: what brings its textures to the brightness of the others'
FROM_WHOLE = (NEIGHBOURS, ROUGH_GAINS)  # sources that nobody names, the whole gives them
LEARNED: tuple[Artifact[Any], ...] = (FIELD, SCENE)  # of a block, which those around it read
PLAN_VERSION = 1
_BLOCKS, _GIVEN, _PLAN, _TILE, _ROUGH = "blocks", "given", "plan.json", "tile.json", "rough_gains.json"


class BoxRecord(Record):
    """See `BlockBox`."""

    core: Array
    margin: Array

    def box(self) -> BlockBox:
        return BlockBox(self.core, self.margin)


class Lattice(Record):
    """The one lattice of all blocks, in the plan's frame: points origin + cell * (i, j, k)."""

    origin: Array
    cell: float


class Block(Record):
    """One block.

    Attributes:
        core: lowest and highest corner of what its tile covers; cores tile the ground plan without gaps.
        region: of what it learns: the core and a margin around it.
        photos: names in the whole's image set.
        neighbours: names of the blocks whose region touches its core.
    """

    name: PathInside
    core: Array
    region: Array
    photos: tuple[PathInside, ...]
    neighbours: tuple[PathInside, ...]

    def box(self) -> BlockBox:
        return BlockBox(self.core, self.region[1] - self.core[1])


class BlockPlan(Record):
    """How a large scene is cut.

    Attributes:
        made_from: digest of the poses and of what was asked for. settings: of those that the blocks were given.
        plan_from_poses: from the frame of the whole's poses to the plan's: its world, turned so that +Z is up.
    """

    version: int = PLAN_VERSION
    made_from: str
    settings: str
    plan_from_poses: SimilarityRecord
    lattice: Lattice
    blocks: tuple[Block, ...]


class Tile(Record):
    """What a block's extraction needs to know.

    Attributes:
        name: of the block. cell: of the lattice, whose points are its multiples.
        boxes: of the block and its neighbours, by name; all in the frame of the block's poses, which is the plan's.
    """

    name: PathInside
    cell: float
    boxes: Mapping[PathInside, BoxRecord]

    @property
    def box(self) -> BlockBox:
        return self.boxes[self.name].box()


# ---------------------------------------------------------------- where things lie
def block_folder(whole: Path, name: str) -> Path:
    """The workspace of a block."""
    return whole / _BLOCKS / name


def refuse_links(block: Path) -> None:
    """What is written for a block, or removed with it, is where it seems to be.

    Raises:
        WorkspaceError: a folder on the way is a link, so that other folders would be written to, or removed.
    """
    for folder in (block.parent, block, block / _GIVEN):
        refuse_link(folder)


def given_folder(block: Path, what: str) -> Path:
    """What a block is given: "photos", "masks", "poses" or `NEIGHBOURS`."""
    return block / _GIVEN / what


def rough_gains_path(block: Path) -> Path:
    """The block's source `ROUGH_GAINS`."""
    return block / _GIVEN / _ROUGH


def whole_of(block: Path) -> Path | None:
    """The workspace that a workspace is a block of; None where it is none."""
    whole = block.parent.parent
    return whole if block.parent.name == _BLOCKS and plan_path(whole).is_file() else None


# ---------------------------------------------------------------- files
def plan_path(whole: Path) -> Path:
    return whole / _BLOCKS / _PLAN


def read_plan(whole: Path) -> BlockPlan | None:
    """None where the workspace was not cut into blocks."""
    return read_record(plan_path(whole), BlockPlan) if plan_path(whole).exists() else None


def write_plan(whole: Path, plan: BlockPlan) -> None:
    plan_path(whole).parent.mkdir(parents=True, exist_ok=True)
    write_own(plan_path(whole), plan.model_dump_json(indent=1) + "\n")


def read_tile(neighbours: Path) -> Tile:
    """Of a block's source `NEIGHBOURS`."""
    return read_record(neighbours / _TILE, Tile)


def is_given(block: Path) -> bool:
    """Whether a block has been given all that it needs: its tile comes last, and earlier versions gave no gains."""
    return (given_folder(block, NEIGHBOURS) / _TILE).is_file() and rough_gains_path(block).is_file()


def write_tile(neighbours: Path, tile: Tile) -> None:
    write_own(neighbours / _TILE, tile.model_dump_json(indent=1) + "\n")


def read_rough_gains(path: Path) -> Mapping[str, tuple[float, float, float]]:
    """Factors on the channels of photos, by the names of their pinhole images; of some photos they are not known."""
    return read_record(path, dict[str, tuple[float, float, float]])


def write_rough_gains(path: Path, gains: Mapping[str, Iterable[float]]) -> None:
    rounded = {name: [round(float(factor), 4) for factor in factors] for name, factors in gains.items()}
    write_own(path, json.dumps(rounded, indent=1) + "\n")


def learned_links(neighbours: Path, name: str) -> dict[str, Path]:
    """File of what the neighbour of this name learns -> the link to it."""
    return {file: neighbours / name / file for artifact in LEARNED for file in artifact.files}


def learned_by(neighbours: Path, name: str) -> Path | None:
    """Where the neighbour of this name published what it has learned; None where it has not yet."""
    links = list(learned_links(neighbours, name).values())
    return links[0].resolve().parent if all(link.is_file() for link in links) else None
