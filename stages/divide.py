"""From the workspace of a large scene, whose photos have poses, to blocks: the plan, and a workspace for each of them.

A block is a workspace like any other. It is given what the whole knows: links to the photos that see it, their poses
and points in the plan's frame, where that lies in the world, and its box as the region. So it finds no poses of its
own, and all blocks are in one frame. What it shares with others is one more source, `NEIGHBOURS`: the boxes around it,
and links to what is learned there (docs/adr/0022).
"""

from __future__ import annotations

import logging
import os
import shlex
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from configs.load import load_config
from configs.params import Config, PlaceParams
from stages.artifacts import IMAGE_SET, MODEL, PHOTOS, WORLD_PLACE, SimilarityRecord
from stages.artifacts.blocks import (
    NEIGHBOURS,
    PLAN_VERSION,
    ROUGH_GAINS,
    Block,
    BlockPlan,
    BoxRecord,
    Lattice,
    Tile,
    block_folder,
    given_folder,
    is_given,
    learned_links,
    plan_path,
    read_plan,
    refuse_links,
    rough_gains_path,
    write_plan,
    write_rough_gains,
    write_tile,
)
from stages.engine.fingerprint import digest
from stages.engine.status import check_current
from stages.engine.workspace import Workspace
from stages.errors import ConfigError, ReconstructionError, SystemRequirementError, WorkspaceError
from stages.geometry.cameras import PinholeCameras
from stages.geometry.layout import find_layout
from stages.geometry.normalisation import into_frame, rotation_onto
from stages.geometry.place import BOX_MARGIN, Place
from stages.geometry.region import have_neighbours, surround_cameras
from stages.geometry.similarity import Similarity
from stages.geometry.tiling import BlockBox, cut_plan, lattice_cell, on_lattice, photos_of_blocks
from stages.geometry.vectors import unit
from stages.limits import total_memory
from stages.place import PLACE
from stages.posing.parts import rebuilt
from stages.posing.undistortion import plan_warp, png_names, posed_cameras, registered_photos, sparse_points
from stages.preflight import FEWEST_IN_A_BLOCK, GIB, photos_held
from stages.texture.rough_gains import rough_gains
from stages.train import TRAIN

log = logging.getLogger(__name__)

FEWEST_POINTS = 100  # with fewer there is nothing to cut by
# The points of a large scene spread no more across its ground than this part of their narrower spread along it.
MOST_RELIEF = 0.5
MOST_BLOCKS = 100_000
Z = np.array([0.0, 0.0, 1.0])


def divide(root: Path, count: int | None, anew: bool = False) -> BlockPlan:
    """Cut the scene of a workspace into blocks, and make or mend their workspaces.

    A plan that was made from the same poses for the same `count` stays as it is.

    Args:
        count: blocks; None: so many that each has no more photos than a process can hold in this machine's memory.
        anew: remove the blocks that there are, with all that they hold, and cut again.

    Raises:
        WorkspaceError: the photos have no poses yet, or there are blocks of another plan.
        ReconstructionError: there are not enough points to cut by.
    """
    workspace = Workspace.open(root)
    check_current(workspace, [PLACE], "poses to cut it by", f"--until {PLACE.name}")
    config = load_config(None, workspace.config_path)
    with workspace.lock():
        made_from = _made_from(workspace, config, count)
        before = read_plan(workspace.root)
        if before is not None and (anew or before.made_from != made_from):
            _remove_blocks(workspace.root, before, anew)
            before = None
        settings = digest(config.model_dump(mode="json"))
        whole = None
        if before is None:
            whole = _Whole.of(workspace, config)
            plan = _cut(whole, count, config, made_from, settings)
            log.info("%s", in_words(plan))
        else:
            plan = before
            log.info("the blocks stay as they are cut: the poses have not changed")
        for block in plan.blocks:
            refuse_links(block_folder(workspace.root, block.name))
            if before is None or before.settings != settings:
                _settle(workspace, block, config)
            if before is None or not is_given(block_folder(workspace.root, block.name)):
                whole = whole or _Whole.of(workspace, config)
                _give(workspace, whole, plan, block)
        write_plan(workspace.root, plan.model_copy(update={"settings": settings}))
    return plan


def in_words(plan: BlockPlan) -> str:
    """How many blocks there are, and how many photos they have."""
    photos = [len(block.photos) for block in plan.blocks]
    all_photos = len({name for block in plan.blocks for name in block.photos})
    return (
        f"{len(photos)} blocks of {min(photos)} to {max(photos)} photos ({all_photos} in all, "
        f"{sum(photos) / all_photos:.1f} blocks a photo), cells of {plan.lattice.cell:.3g}"
    )


def _made_from(workspace: Workspace, config: Config, count: int | None) -> str:
    """Digest of all that a plan depends on."""
    digests = []
    for artifact in (IMAGE_SET, MODEL, WORLD_PLACE):
        manifest = workspace.published(artifact.stage)
        assert manifest is not None  # `check_current`
        digests.append(manifest.artifact_digest(artifact))
    return digest([PLAN_VERSION, digests, count, config.extract.resolution, config.undistort.max_side])


def _remove_blocks(root: Path, plan: BlockPlan, anew: bool) -> None:
    """
    Raises:
        WorkspaceError: they are to stay.
    """
    if not anew:
        raise WorkspaceError(
            f"{root} is cut into {len(plan.blocks)} blocks already, by other poses or for another number of blocks.",
            f"`hineus blocks {shlex.quote(str(root))} --anew` removes them, with all that they hold, and cuts again.",
        )
    for block in plan.blocks:
        folder = block_folder(root, block.name)
        refuse_links(folder)
        if folder.is_dir():
            with Workspace.open(folder, create=True).lock():  # nobody is at work in it
                pass
            shutil.rmtree(folder)
    plan_path(root).unlink()


# ---------------------------------------------------------------- the plan
@dataclass(frozen=True)
class _Whole:
    """What is known of the whole scene.

    Attributes:
        cameras, points, observations: in the plan's frame; rows of observations are (photo, point).
        names: of the photos in the image set, as the cameras are ordered.
        near: which points are what the photos are about, and not far behind it.
        place: of the plan's frame.
        rough_gains: [3] of photos, by name in the image set.
    """

    model: Any
    names: list[str]
    cameras: PinholeCameras
    points: np.ndarray
    observations: np.ndarray
    near: np.ndarray
    plan_from_poses: Similarity
    place: Place
    rough_gains: Mapping[str, np.ndarray]

    @staticmethod
    def of(workspace: Workspace, config: Config) -> _Whole:
        import pycolmap

        model = pycolmap.Reconstruction(str(MODEL.load(workspace.stage_folder(MODEL.stage))))
        photos = registered_photos(model)
        names = [photo.name for photo in photos]
        warps = {number: plan_warp(camera, config.undistort.max_side) for number, camera in model.cameras.items()}
        cameras = posed_cameras(photos, names, warps)
        points, _, observations = sparse_points(model, photos)
        if len(points) < FEWEST_POINTS:
            raise ReconstructionError(
                f"There are {len(points)} sparse points to cut the scene by, {FEWEST_POINTS} are needed.",
                "Let neighbouring photos overlap by two thirds.",
            )
        place = WORLD_PLACE.load(workspace.stage_folder(WORLD_PLACE.stage))
        near = surround_cameras(points, cameras.centers)
        near[near] = have_neighbours(points[near])
        up = place.up
        if up is None:
            up = unit(place.world_from_poses.rotation @ _up_of(cameras, points, observations, near))
        turn = rotation_onto(up, Z)
        plan_from_poses = Similarity(1.0, turn, np.zeros(3)).compose(place.world_from_poses)
        points = plan_from_poses.apply(points)
        return _Whole(
            model, names, into_frame(cameras, plan_from_poses.inverse()), points, observations, near, plan_from_poses,
            _place_of_plan(place, turn), rough_gains(model, PHOTOS.load(workspace.stage_folder(PHOTOS.stage))),
        )  # fmt: skip


def _up_of(cameras: PinholeCameras, points: np.ndarray, observations: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Up [3] where nothing but the photos tells it: across the plane that the scene lies in, and towards the cameras.

    Cameras that look down from the air say little of up. Where the scene lies in no plane, they are asked all the same.
    """
    middle = points[near].mean(0)
    _, spread, axes = np.linalg.svd(points[near] - middle, full_matrices=False)
    if spread[2] > MOST_RELIEF * spread[1]:
        return find_layout(cameras, points, observations).up.direction
    across = axes[2]
    return across if (cameras.centers - middle).mean(0) @ across > 0 else -across


def _place_of_plan(place: Place, turn: np.ndarray) -> Place:
    """How the plan's frame lies in the world: it is that, unless it had to be turned."""
    found = replace(place, world_from_poses=Similarity.identity(), up=Z)
    if np.array_equal(turn, np.eye(3)):
        return found
    return replace(found, origin=None, crs="", offset=None)


def _cut(whole: _Whole, count: int | None, config: Config, made_from: str, settings: str) -> BlockPlan:
    points, observations = _only(whole.near, whole.points, whole.observations)
    centers, shown_by = whole.cameras.centers, np.bincount(observations[:, 1], minlength=len(points))
    plan = np.stack([points[:, :2].min(0), points[:, :2].max(0)])
    cores = cut_plan(plan, points, observations, len(centers), _enough(whole, count, config))
    fine = _ground_resolution(whole.cameras, points, observations)
    widest = np.median([_radius(box) for box in on_lattice(cores, points, shown_by, lattice_cell(fine))])
    cell = lattice_cell(max(fine, 2 * float(widest) / config.extract.resolution))
    boxes = on_lattice(cores, points, shown_by, cell)
    seen = photos_of_blocks(boxes, points, observations, centers)
    names = [f"b{number:0{max(2, len(str(len(boxes) - 1)))}d}" for number in range(len(boxes))]
    blocks = [
        Block(
            name=name,
            core=box.core,
            region=box.region,
            photos=tuple(whole.names[i] for i in np.flatnonzero(photos)),
            neighbours=tuple(
                other for other, at in zip(names, boxes, strict=True) if other != name and box.touches(at)
            ),
        )
        for name, box, photos in zip(names, boxes, seen, strict=True)
    ]
    return BlockPlan(
        made_from=made_from,
        settings=settings,
        plan_from_poses=SimilarityRecord.model_validate(whole.plan_from_poses),
        lattice=Lattice(origin=np.zeros(3), cell=cell),
        blocks=tuple(blocks),
    )


def _only(chosen: np.ndarray, points: np.ndarray, observations: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The chosen points, and the observations of these."""
    kept = observations[chosen[observations[:, 1]]]
    return points[chosen], np.column_stack([kept[:, 0], np.cumsum(chosen)[kept[:, 1]] - 1])


def _enough(whole: _Whole, count: int | None, config: Config) -> Callable[[int, int], bool]:
    """What tells `cut_plan` that it has cut enough."""
    if count is not None:
        return lambda parts, _: parts >= count
    memory = total_memory() / GIB
    held = photos_held([(w, h) for w, h in whole.cameras.sizes.tolist()], config, memory)
    most = max(held, FEWEST_IN_A_BLOCK)  # cuts end there, whatever the memory
    log.info("a process can hold %d photos in %.1f GiB of memory", held, memory)
    return lambda parts, heaviest: heaviest <= most or parts >= MOST_BLOCKS


def _ground_resolution(cameras: PinholeCameras, points: np.ndarray, observations: np.ndarray) -> float:
    """Size of a pixel on what photos show, of the closest tenth of the photos."""
    photo, point = observations.T
    away = np.linalg.norm(points[point] - cameras.centers[photo], axis=1)
    pixel = away / cameras.intrinsics[photo, 0, 0]
    return float(np.quantile([np.median(pixel[photo == i]) for i in np.unique(photo)], 0.1))


def _radius(box: BlockBox) -> float:
    """Of the sphere that the block's region is in."""
    return BOX_MARGIN * float(np.linalg.norm(box.region[1] - box.region[0])) / 2


# ---------------------------------------------------------------- the blocks' workspaces
def _give(workspace: Workspace, whole: _Whole, plan: BlockPlan, block: Block) -> None:
    """Put what a block needs of the whole into its workspace."""
    folder = block_folder(workspace.root, block.name)
    taken = PHOTOS.load(workspace.stage_folder(PHOTOS.stage))
    with Workspace.open(folder, create=True).lock():
        photos = {name: taken.path(name) for name in block.photos}
        _link_all(given_folder(folder, "photos"), photos)
        masks = {name: taken.mask_path(name) for name in block.photos if taken.mask_path(name).exists()}
        _link_all(
            given_folder(folder, "masks"), {path.relative_to(taken.masks).as_posix(): path for path in masks.values()}
        )
        poses = given_folder(folder, "poses")
        poses.mkdir(parents=True, exist_ok=True)
        size = {image.name: (image.camera.width, image.camera.height) for image in whole.model.images.values()}
        part = rebuilt(
            whole.model, {name: (name, size[name]) for name in block.photos}, whole.plan_from_poses.inverse()
        )
        part.write(str(poses))
        WORLD_PLACE.save(poses, whole.place)
        around = given_folder(folder, NEIGHBOURS)
        learned = {
            link.relative_to(around).as_posix(): block_folder(workspace.root, name) / TRAIN.name / file
            for name in block.neighbours
            for file, link in learned_links(around, name).items()
        }
        _link_all(around, learned)
        near = [each for each in plan.blocks if each.name in (block.name, *block.neighbours)]
        boxes = {each.name: BoxRecord(core=each.core, margin=each.box().margin) for each in near}
        # by the names that the block will know them by once they are undistorted
        named = zip(png_names(list(block.photos)), block.photos, strict=True)
        gains = {png: whole.rough_gains[name] for png, name in named if name in whole.rough_gains}
        write_rough_gains(rough_gains_path(folder), gains)
        write_tile(around, Tile(name=block.name, cell=plan.lattice.cell, boxes=boxes))


def _settle(workspace: Workspace, block: Block, config: Config) -> None:
    """Make a block's workspace, or let its next run start with the settings of the whole as they are now."""
    own = Workspace.open(block_folder(workspace.root, block.name), create=True)
    given = {name: given_folder(own.root, name) for name in ("photos", "masks", "poses", NEIGHBOURS)}
    taken = PHOTOS.load(workspace.stage_folder(PHOTOS.stage))
    if not any(taken.mask_path(name).exists() for name in block.photos):
        given.pop("masks")
    sources: dict[str, Path | None] = {
        **dict.fromkeys(workspace.record.sources),
        **given,
        ROUGH_GAINS: rough_gains_path(own.root),
    }
    with own.lock():
        own.remember(sources, workspace.record.preset, settings_of(config, block).model_dump(mode="json"))


def settings_of(config: Config, block: Block) -> Config:
    """The whole's settings, less what has been done for the whole."""
    corners = " ".join(repr(float(value)) for value in block.region.ravel())
    values = config.model_dump(mode="json")
    values["place"] = PlaceParams(region=f"box {corners}").model_dump(mode="json")
    values["ingest"] |= {"auto_mask": "off", "masks_keep": "white", "leave_out": []}
    values["ingest"]["min_images"] = min(config.ingest.min_images, max(2, len(block.photos)))
    values["undistort"] |= {"roi_scale": 1.0, "subject": 1}
    values["cleanup"]["keep_closed"] = False  # a tile is open where its neighbours go on
    values["materials"]["balls"] = []
    try:
        return Config.model_validate(values)
    except ValueError as error:
        raise ConfigError(f"The settings of the whole do not do for block {block.name}: {error}.") from error


def _link_all(folder: Path, wanted: Mapping[str, Path]) -> None:
    """Let a folder hold these links, by their relative names, and nothing else; what they lead to may come later.

    They are relative, so that a workspace can be moved with its blocks.

    Raises:
        SystemRequirementError: the system makes no links.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    for name, target in wanted.items():
        at = folder / name
        at.parent.mkdir(parents=True, exist_ok=True)
        try:
            at.symlink_to(os.path.relpath(target, at.parent))
        except OSError as error:
            raise SystemRequirementError(
                f"No link can be made at {at}: {error.strerror or error}.",
                "Blocks share photos by links. Choose a disk that knows them with `--workspace DIR`; on Windows turn "
                "on developer mode.",
            ) from error
