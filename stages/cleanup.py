"""Raw mesh to a clean, light one: only what the photos show, manifold, within a budget of faces."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from functools import partial
from typing import Any

import numpy as np

from configs.params import CleanupParams
from stages.artifacts import (
    AROUND_MESH,
    CLEAN_FULL_MESH,
    CLEAN_MESH,
    GIVEN_REGION,
    OUTLINES,
    PINHOLE_PHOTOS,
    RAW_MESH,
    SCENE,
    SILHOUETTES,
    Pictures,
)
from stages.artifacts.blocks import NEIGHBOURS, read_tile
from stages.engine.stage import Stage, StageContext
from stages.errors import ReconstructionError
from stages.geometry.cameras import PinholeCameras, PosedScene
from stages.geometry.place import box_sides
from stages.geometry.tiling import UPRIGHT

logger = logging.getLogger(__name__)

# The visibility test runs on a mesh of this many times the final faces: no slower, and fine enough for clean borders.
WORKING_FACES = 3
# Pieces that rise above the cut by less than this many of the ground's tolerances are bumps of it.
BUMP_TOLERANCES = 5.0
# What hangs further under the ground than this many of its tolerances along the region's border was made up.
UNDER_TOLERANCES = 2.0
# Specks below this part of `min_component` go before anything is measured. The rest waits until the unseen is gone:
# a background shell may be the largest piece.
SPECK = 0.1
# Masks of whole photos may lack a part now and then: of the metal cow, whose masks were guessed, 0.15 lost 2 % of the
# surface and this nothing, with as little of the table left (docs/benchmarks/auto-masks.md).
BESIDE_OUTSIDE = 0.3
# A vertex so near to a tile's border, in radii of the region, lies on it: 32-bit numbers miss it by 1e-7.
AT_BORDER = 1e-5
# What this part of the photos that see it shows on such masks stays: see `shown_on_masks`.
BESIDE_SHOWN = 0.3


def _masks(folders: Sequence[Pictures], cameras: PinholeCameras, margin: int) -> Iterator[tuple[int, np.ndarray]]:
    """Index and widened mask [H, W] bool of every photo that has one in one of the folders."""
    from stages.surface.selection import widened

    for index, name in enumerate(cameras.names):
        for mask in (mask for folder in folders if (mask := folder.mask(name)) is not None):
            yield index, widened(mask > 127, margin)


def run(context: StageContext[CleanupParams]) -> dict[str, Any]:
    from stages.surface import ground, selection, triangle_mesh
    from stages.surface.decimation import decimate

    params = context.params
    scene = context.read(SCENE)
    cameras = scene.cameras
    vertices, faces = context.read(RAW_MESH)
    numbers: dict[str, Any] = {"faces_before": len(faces)}

    def keep(chosen: np.ndarray, what: str, hint: str) -> None:
        nonlocal vertices, faces
        numbers[what] = int(np.count_nonzero(~chosen))
        if not chosen.any():
            raise ReconstructionError(
                f"Nothing of the mesh is left: its last {len(faces)} faces fell under '{what}'.", hint
            )
        vertices, faces = triangle_mesh.compact(vertices, faces[chosen])

    context.progress(0, 5, "region of interest and masks")
    inside = selection.inside_ball(vertices, faces, params.roi_radius)
    if params.keep_closed:
        inside = selection.whole_pieces(faces, inside)
    keep(
        inside, "outside_region", "Try `--set undistort.roi_scale=1.5`, or train for longer: `--set train.steps=20000`."
    )
    region = context.read(GIVEN_REGION)
    borders = _borders(context, scene)
    sides = region.sides(scene.poses_from_scene) if region else []
    vertices, faces = _crop(vertices, faces, scene, sides, params)
    numbers["ground_removed"] = params.remove_ground and scene.ground is not None
    if scene.ground is not None and not params.keep_closed and not borders:  # a tile's ground ends nowhere
        under = ground.under_the_border(vertices, scene, UNDER_TOLERANCES * params.ground_tolerance)
        keep(np.asarray(~under[faces].all(1)), "under_ground", "Try `--set undistort.roi_scale=1.5`.")
    reaching = _reaching(borders, vertices, faces)
    large, numbers["specks_dropped"] = selection.large_pieces(faces, SPECK * params.min_component, reaching)
    keep(large, "speck_faces", "Try `--set cleanup.min_component=0`.")
    if params.mask_hull:
        alone, beside = context.read(PINHOLE_PHOTOS), [context.read(OUTLINES), context.read(SILHOUETTES)]
        outside = _outside_masks(vertices, faces, cameras, alone, beside, params)
        within = np.count_nonzero(outside[faces], axis=1) < 2
        keep(
            selection.whole_pieces(faces, within) if params.keep_closed else within,
            "outside_masks",
            "Look at the masks (white is the object), or try `--set cleanup.mask_hull=false`.",
        )

    # The detail that decimation takes away, for the normal map.
    context.write(CLEAN_FULL_MESH, (vertices, faces))
    context.progress(1, 5, "lightening")
    vertices, faces = decimate(vertices, faces, WORKING_FACES * params.target_faces, _at(borders, vertices))

    context.progress(2, 5, "what the cameras see")
    if params.min_views > 0:
        around = context.read(AROUND_MESH)
        views = selection.count_views(
            vertices,
            faces,
            cameras,
            params.min_views,
            progress=lambda done, total: context.progress(2 + done / total, 5, "what the cameras see"),
            others=[] if around is None else [around],
        )
        hint = "The poses and the mesh disagree; try `--set cleanup.min_views=0` to look at the raw mesh."
        keep(_seen_faces(vertices, faces, views >= params.min_views, params), "unseen_faces", hint)

    context.progress(3, 5, "pieces")
    reaching = _reaching(borders, vertices, faces)
    large, numbers["pieces_dropped"] = selection.large_pieces(faces, params.min_component, reaching)
    keep(large, "piece_faces", "Try `--set cleanup.min_component=0`.")

    context.progress(4, 5, "decimating")
    vertices, faces = triangle_mesh.repair_manifold(vertices, faces)
    vertices, faces = decimate(vertices, faces, params.target_faces, _at(borders, vertices))
    state = triangle_mesh.mesh_state(faces)
    if not state.manifold:
        logger.warning("mesh is not manifold: %d edges, %d vertices", state.bad_edges, state.bad_vertices)
    if params.keep_closed and not state.watertight:
        logger.warning("mesh was to be closed, but %d edges are open", state.open_edges)
    context.write(CLEAN_MESH, (vertices, faces))
    if region is None:
        numbers["warnings"] = _cut_warnings(vertices, faces, scene)
    return {
        **numbers,
        "faces": len(faces),
        "vertices": len(vertices),
        "open_edges": state.open_edges,
        "watertight": state.watertight,
        "manifold": state.manifold,
    }


# ---------------------------------------------------------------- the borders of a tile
def _borders(context: StageContext[CleanupParams], scene: PosedScene) -> list[tuple[np.ndarray, float]]:
    """Planes (normal, offset) in the scene frame along which this mesh meets those of other blocks."""
    if NEIGHBOURS not in context.sources:
        return []
    return box_sides(read_tile(context.sources[NEIGHBOURS]).box.core, scene.poses_from_scene, UPRIGHT)


def _at(borders: list[tuple[np.ndarray, float]], vertices: np.ndarray) -> np.ndarray:
    """Vertices [V] bool that lie on a border, and must stay there."""
    from stages.surface.tiles import heights_above

    at: np.ndarray = np.abs(heights_above(vertices, borders)) < AT_BORDER
    return at


def _reaching(borders: list[tuple[np.ndarray, float]], vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces [F] bool at a border: what they are part of may be large on the other side of it."""
    reaching: np.ndarray = _at(borders, vertices)[faces].any(1)
    return reaching


def _outside_masks(
    vertices: np.ndarray,
    faces: np.ndarray,
    cameras: PinholeCameras,
    alone: Pictures,
    beside: Sequence[Pictures],
    params: CleanupParams,
) -> np.ndarray:
    """Vertices [V] bool that are off too many masks; those beside whole photos do not cut what enough show on them."""
    from stages.surface import selection

    masks = partial(_masks, [alone, *beside], cameras)
    are_beside = any(folder.masks.exists() for folder in beside)
    most = max(params.mask_outside, BESIDE_OUTSIDE) if are_beside else params.mask_outside
    outside = selection.outside_hull(vertices, cameras, masks(params.mask_margin), most)
    if are_beside:  # no margin: the table shows in it
        outside &= ~selection.shown_on_masks(vertices, faces, cameras, masks(0), outside, BESIDE_SHOWN)
    return outside


def _cut_warnings(vertices: np.ndarray, faces: np.ndarray, scene: PosedScene) -> list[dict[str, str]]:
    """For the report and the log: that the border of the region cuts what photos have in their middle, if it does."""
    from stages.geometry.normalisation import regrown
    from stages.surface.border import border_cut, region_without_cut

    cut = border_cut(vertices, faces, scene.cameras, scene.ground)
    if cut is None:
        return []
    larger = regrown(scene, *region_without_cut(cut))
    sentence = (
        f"The region of interest cuts what {cut.photos} photos have in their middle. A larger one can be set by a "
        "command, or in the report's 3D view."
    )
    command = f"hineus run --workspace WORKSPACE --set undistort.roi_scale={larger.roi_scale:.2f}"
    return [{"sentence": sentence, "command": command}]


def _crop(
    vertices: np.ndarray,
    faces: np.ndarray,
    scene: PosedScene,
    sides: list[tuple[np.ndarray, float]],
    params: CleanupParams,
) -> tuple[np.ndarray, np.ndarray]:
    """The mesh within the box and above the ground, where there is a box and the ground is to go.

    A mesh that is to be closed ends in lids there, and at the border of the region of interest.
    """
    from stages.surface import ground, solids, triangle_mesh

    if params.keep_closed:
        vertices, faces = solids.cut_to_ball(vertices, faces, params.roi_radius)
    if params.remove_ground:
        if scene.ground is None:
            logger.warning("no ground was found in the sparse points, so none is removed")
        else:
            sides = [*sides, ground.cut_above(vertices, faces, scene.ground, params.ground_tolerance)]
    for normal, offset in sides:
        cut = solids.cut_at_plane if params.keep_closed else triangle_mesh.clip
        vertices, faces = cut(vertices, faces, normal, offset)
        if not len(faces):
            raise ReconstructionError(
                "Nothing of the mesh is left inside the box and above the ground.",
                "Look at `place.region` and at the report's drawing, or try `--set cleanup.remove_ground=false`.",
            )
    if params.remove_ground and scene.ground is not None:
        vertices, faces = ground.without_bumps(vertices, faces, *sides[-1], BUMP_TOLERANCES * params.ground_tolerance)
    return vertices, faces


def _seen_faces(vertices: np.ndarray, faces: np.ndarray, seen: np.ndarray, params: CleanupParams) -> np.ndarray:
    """Faces [F] bool to keep, given which vertices [V] bool are seen: seen ones, their surroundings, small gaps."""
    from stages.surface import selection, triangle_mesh

    chosen: np.ndarray = seen[faces].any(1)
    if params.keep_closed:
        return selection.whole_pieces(faces, chosen)
    if not chosen.any():
        return chosen
    chosen = selection.spread(faces, len(vertices), chosen, params.rings)
    chosen = selection.smooth_selection(faces, len(vertices), chosen, params.rings)
    area = triangle_mesh.face_areas(vertices, faces)
    return selection.fill_small_gaps(vertices, faces, chosen, params.max_hidden_area * float(area[chosen].sum()))


CLEANUP: Stage[CleanupParams] = Stage(
    name="cleanup",
    version=11,
    settings=lambda config: config.cleanup,
    run=run,
    reads=(SCENE, PINHOLE_PHOTOS, OUTLINES, SILHOUETTES, GIVEN_REGION, RAW_MESH, AROUND_MESH),
    writes=(CLEAN_MESH, CLEAN_FULL_MESH),
    sources=(NEIGHBOURS,),
    summary="floaters and unseen shells gone, manifold, decimated",
)
