"""Raw mesh to a clean, light one: only what the photos show, manifold, within a budget of faces."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from typing import Any

import numpy as np

from configs.params import CleanupParams
from stages.artifacts import CLEAN_FULL_MESH, CLEAN_MESH, GIVEN_REGION, PINHOLE_PHOTOS, RAW_MESH, SCENE, Pictures
from stages.engine.stage import Stage, StageContext
from stages.errors import ReconstructionError
from stages.geometry.cameras import PinholeCameras, PosedScene
from stages.geometry.place import GivenRegion
from stages.geometry.plane import Plane, fit_plane
from stages.geometry.similarity import Similarity

logger = logging.getLogger(__name__)

# The visibility test runs on a mesh of this many times the final faces: no slower, and fine enough for clean borders.
WORKING_FACES = 3
# Faces that lean less than this from the ground's plane belong to it, and this much area (in the region's radii
# squared) is enough to fit it.
GROUND_TILT_DEG, MIN_GROUND_AREA = 15.0, 0.02
# Pieces that rise above the cut by less than this many tolerances, and have less than this part of the largest one's
# area, are bumps of the ground.
BUMP_TOLERANCES, BUMP_AREA = 5.0, 0.05
# What hangs further under the ground than this many tolerances, further out than this, was made up along the border of
# the region; unless more than this part of the sparse points lies under the ground, too.
UNDER_TOLERANCES, BORDER_RADIUS, MAX_UNDER = 2.0, 0.75, 0.01
# Specks below this part of `min_component` go before anything is measured. The rest waits until the unseen is gone:
# a background shell may be the largest piece.
SPECK = 0.1


def _masks(pictures: Pictures, cameras: PinholeCameras, margin: int) -> Iterator[tuple[int, np.ndarray]]:
    """Index and widened mask [H, W] bool of every photo that has one."""
    import cv2

    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
    for index, name in enumerate(cameras.names):
        mask = pictures.mask(name)
        if mask is not None:
            yield index, cv2.dilate(mask, kernel) > 127


def run(context: StageContext[CleanupParams]) -> dict[str, Any]:
    from stages.surface import selection, triangle_mesh
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
        inside, "outside_region", "Try `--set undistort.roi_scale=1.5`, or train for longer: `--set train.steps=6000`."
    )
    region = context.read(GIVEN_REGION)
    sides = region_sides(region, scene.poses_from_scene) if region else []
    vertices, faces = _crop(vertices, faces, scene, sides, params)
    numbers["ground_removed"] = params.remove_ground and scene.ground is not None
    if scene.ground is not None and not params.keep_closed:
        under = _under_the_border(vertices, scene, UNDER_TOLERANCES * params.ground_tolerance)
        keep(np.asarray(~under[faces].all(1)), "under_ground", "Try `--set undistort.roi_scale=1.5`.")
    large, numbers["specks_dropped"] = selection.large_pieces(faces, SPECK * params.min_component)
    keep(large, "speck_faces", "Try `--set cleanup.min_component=0`.")
    if params.mask_hull:
        masks = _masks(context.read(PINHOLE_PHOTOS), cameras, params.mask_margin)
        outside = selection.outside_hull(vertices, cameras, masks, params.mask_outside)
        within = np.count_nonzero(outside[faces], axis=1) < 2
        keep(
            selection.whole_pieces(faces, within) if params.keep_closed else within,
            "outside_masks",
            "Look at the masks (white is the object), or try `--set cleanup.mask_hull=false`.",
        )

    # The detail that decimation takes away, for the normal map.
    context.write(CLEAN_FULL_MESH, (vertices, faces))
    context.progress(1, 5, "lightening")
    vertices, faces = decimate(vertices, faces, WORKING_FACES * params.target_faces)

    context.progress(2, 5, "what the cameras see")
    if params.min_views > 0:
        views = selection.count_views(
            vertices,
            faces,
            cameras,
            params.min_views,
            progress=lambda done, total: context.progress(2 + done / total, 5, "what the cameras see"),
        )
        hint = "The poses and the mesh disagree; try `--set cleanup.min_views=0` to look at the raw mesh."
        keep(_seen_faces(vertices, faces, views >= params.min_views, params), "unseen_faces", hint)

    context.progress(3, 5, "pieces")
    large, numbers["pieces_dropped"] = selection.large_pieces(faces, params.min_component)
    keep(large, "piece_faces", "Try `--set cleanup.min_component=0`.")

    context.progress(4, 5, "decimating")
    vertices, faces = decimate(*triangle_mesh.repair_manifold(vertices, faces), params.target_faces)
    state = triangle_mesh.mesh_state(faces)
    if not state.manifold:
        logger.warning("mesh is not manifold: %d edges, %d vertices", state.bad_edges, state.bad_vertices)
    if params.keep_closed and not state.watertight:
        logger.warning("mesh was to be closed, but %d edges are open", state.open_edges)
    context.write(CLEAN_MESH, (vertices, faces))
    return {
        **numbers,
        "faces": len(faces),
        "vertices": len(vertices),
        "open_edges": state.open_edges,
        "watertight": state.watertight,
        "manifold": state.manifold,
    }


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
    from stages.surface import solids, triangle_mesh

    if params.keep_closed:
        vertices, faces = solids.cut_to_ball(vertices, faces, params.roi_radius)
    if params.remove_ground:
        if scene.ground is None:
            logger.warning("no ground was found in the sparse points, so none is removed")
        else:
            sides = [*sides, _cut_above_ground(vertices, faces, scene.ground, params.ground_tolerance)]
    for normal, offset in sides:
        cut = solids.cut_at_plane if params.keep_closed else triangle_mesh.clip
        vertices, faces = cut(vertices, faces, normal, offset)
        if not len(faces):
            raise ReconstructionError(
                "Nothing of the mesh is left inside the box and above the ground.",
                "Look at `place.region` and at the report's drawing, or try `--set cleanup.remove_ground=false`.",
            )
    if params.remove_ground and scene.ground is not None:
        vertices, faces = _without_bumps(vertices, faces, *sides[-1], BUMP_TOLERANCES * params.ground_tolerance)
    return vertices, faces


def _under_the_border(vertices: np.ndarray, scene: PosedScene, depth: float) -> np.ndarray:
    """Vertices [V] bool that hang under the ground by more than `depth` along the region's border.

    Photos show the ground going on there and nothing below it, so that training may leave flaps.
    """
    assert scene.ground is not None
    points = scene.points[np.linalg.norm(scene.points, axis=1) < 1]
    if scene.kind != "object" or (scene.ground.heights(points) < -depth).sum() > MAX_UNDER * len(points):
        return np.zeros(len(vertices), dtype=bool)
    hanging: np.ndarray = np.linalg.norm(vertices, axis=1) > BORDER_RADIUS
    hanging &= scene.ground.heights(vertices) < -depth
    return hanging


def _without_bumps(
    vertices: np.ndarray, faces: np.ndarray, normal: np.ndarray, offset: float, height: float
) -> tuple[np.ndarray, np.ndarray]:
    """The mesh without what a bumpy ground leaves above its cut: small pieces that rise by less than `height`."""
    from stages.surface import triangle_mesh

    labels = triangle_mesh.label_pieces(len(faces), triangle_mesh.face_adjacency(faces))
    areas = np.bincount(labels, np.linalg.norm(triangle_mesh.face_normals(vertices, faces), axis=1))
    tops = np.full(len(areas), -np.inf)
    np.maximum.at(tops, labels, (vertices @ normal - offset)[faces].max(1))
    bumps = (tops < height) & (areas < BUMP_AREA * areas.max())
    return triangle_mesh.compact(vertices, faces[~bumps[labels]])


def region_sides(region: GivenRegion, poses_from_scene: Similarity) -> list[tuple[np.ndarray, float]]:
    """The sides of the box that was given, see `box_sides`; none where it was a sphere."""
    if region.box is None:
        return []
    return box_sides(region.box, region.world_from_poses.compose(poses_from_scene))


def box_sides(box: np.ndarray, world_from_scene: Similarity) -> list[tuple[np.ndarray, float]]:
    """Planes (normal [3], offset) in the scene frame, the box's inside above them, of a world box [2, 3]."""
    sides = []
    for sign, corner in ((1.0, box[0]), (-1.0, box[1])):
        for axis in range(3):
            side = Plane(sign * np.eye(3)[axis], sign * float(corner[axis]), 0.0, 0.0).within(world_from_scene)
            sides.append((side.normal, side.offset))
    return sides


def _cut_above_ground(
    vertices: np.ndarray, faces: np.ndarray, ground: Plane, tolerance: float
) -> tuple[np.ndarray, float]:
    """Plane (normal [3], offset) a tolerance above the ground, which is fitted anew to the mesh where it shows it."""
    from stages.surface.triangle_mesh import face_normals

    centers = vertices[faces].mean(1).astype(np.float64)
    normals = face_normals(vertices, faces)
    areas = np.linalg.norm(normals, axis=1)
    level = normals @ ground.normal > np.cos(np.radians(GROUND_TILT_DEG)) * areas
    normal, offset = ground.normal, ground.offset
    for reach in (2 * tolerance, tolerance, tolerance):
        on_it = level & (np.abs(centers @ normal - offset) < reach)
        if areas[on_it].sum() / 2 < MIN_GROUND_AREA:
            return ground.normal, ground.offset + tolerance
        normal, offset = fit_plane(centers[on_it], ground.normal, areas[on_it])
    return normal, offset + tolerance


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
    area = np.linalg.norm(triangle_mesh.face_normals(vertices, faces), axis=1) / 2
    return selection.fill_small_gaps(vertices, faces, chosen, params.max_hidden_area * float(area[chosen].sum()))


CLEANUP: Stage[CleanupParams] = Stage(
    name="cleanup",
    version=7,
    settings=lambda config: config.cleanup,
    run=run,
    reads=(SCENE, PINHOLE_PHOTOS, GIVEN_REGION, RAW_MESH),
    writes=(CLEAN_MESH, CLEAN_FULL_MESH),
    summary="floaters and unseen shells gone, manifold, decimated",
)
