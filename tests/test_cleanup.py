"""What cleanup keeps and drops, on small meshes with known answers, and the stage on a small scene."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rigs import capture, ring, scene_without_points, three_rings

from configs.params import CleanupParams
from stages import artifacts
from stages.artifacts.blocks import NEIGHBOURS, BoxRecord, Tile, write_tile
from stages.cleanup import CLEANUP
from stages.engine.stage import StageContext
from stages.errors import ReconstructionError
from stages.geometry.cameras import PinholeCameras
from stages.geometry.place import given_region
from stages.geometry.plane import Plane
from stages.geometry.similarity import Similarity
from stages.surface import selection, triangle_mesh
from stages.surface.border import GROWTH
from stages.surface.decimation import decimate
from stages.surface.isosurface import extract_isosurface
from stages.surface.solids import extract_solid

SIZE = 160


def ball(radius=0.5, center=(0, 0, 0), resolution=32):
    surface = extract_isosurface(lambda p: np.linalg.norm(p - np.array(center), axis=1) - radius, resolution)
    return surface.vertices, surface.faces


def join(*meshes):
    offsets = np.cumsum([0, *(len(v) for v, _ in meshes)])
    vertices = np.concatenate([v for v, _ in meshes])
    return vertices, np.concatenate([f + o for (_, f), o in zip(meshes, offsets, strict=False)])


@pytest.fixture
def stage(tmp_path):
    """Runs cleanup on a mesh; returns its numbers, vertices and faces."""
    undistort, train, extract, place, out = (
        tmp_path / name for name in ("undistort", "train", "extract", "place", "out")
    )

    def run(
        vertices,
        faces,
        masks=None,
        scene_extras=None,
        region=None,
        kind=artifacts.PINHOLE_PHOTOS,
        neighbours=None,
        around=None,
        **params,
    ):
        for folder in (undistort, train, extract, place, out):
            folder.mkdir()
        cameras = three_rings()
        artifacts.SCENE.save(train, replace(scene_without_points(cameras), **(scene_extras or {})))
        artifacts.GIVEN_REGION.save(place, region)
        artifacts.RAW_MESH.save(extract, (vertices, faces))
        artifacts.AROUND_MESH.save(extract, around)
        if masks is not None:
            import cv2

            for index, mask in masks(cameras):
                path = kind.load(undistort).mask_path(cameras.names[index])
                path.parent.mkdir(exist_ok=True)
                cv2.imwrite(str(path), mask.astype(np.uint8) * 255)
        context = StageContext(
            inputs={"undistort": undistort, "train": train, "extract": extract, "place": place},
            sources={} if neighbours is None else {NEIGHBOURS: neighbours},
            out=out,
            scratch=tmp_path,
            params=CleanupParams(**params),
        )
        return CLEANUP.run(context), *artifacts.CLEAN_MESH.load(out)

    return run


def test_small_pieces_go_and_their_number_is_told():
    vertices, faces = join(ball(), ball(0.06, (0.8, 0, 0)), ball(0.06, (-0.8, 0, 0)))
    keep, dropped = selection.large_pieces(faces, 0.1)
    assert dropped == 2
    assert np.linalg.norm(vertices[faces[keep]], axis=2).max() < 0.55
    assert selection.large_pieces(faces, 0.0) == (pytest.approx(np.ones(len(faces), bool)), 0)


def test_small_pieces_that_are_spared_stay():
    vertices, faces = join(ball(), ball(0.06, (0.8, 0, 0)), ball(0.06, (-0.8, 0, 0)))
    spared = (vertices[:, 0] > 0.85)[faces].any(1)
    keep, dropped = selection.large_pieces(faces, 0.1, spared)
    assert dropped == 1
    assert vertices[faces[keep], 0].min() > -0.6
    assert vertices[faces[keep], 0].max() > 0.8


def test_the_border_of_a_tile_stays_and_what_reaches_it(stage, tmp_path):
    """A block whose core ends at x = 0.1 (scene): half a ball, and a crumb that goes on in the next block."""
    core = np.array([[-9.0, -9, -9], [0.1, 9, 9]])  # the scene's frame is that of the poses here
    around = tmp_path / NEIGHBOURS
    around.mkdir()
    write_tile(around, Tile(name="b00", cell=0.1, boxes={"b00": BoxRecord(core=core, margin=np.ones(3))}))
    half = triangle_mesh.clip(*ball(resolution=64), np.array([-1.0, 0, 0]), -0.1)
    crumb = triangle_mesh.clip(*ball(0.04, (0.1, 0.7, 0)), np.array([-1.0, 0, 0]), -0.1)
    vertices, faces = join(half, crumb)
    light = {"target_faces": 600, "min_component": 0.2, "min_views": 0}
    numbers, kept, left = stage(vertices, faces, neighbours=around, **light)
    assert numbers["pieces_dropped"] == numbers["specks_dropped"] == 0
    border = lambda points: {tuple(each) for each in points[np.abs(points[:, 0] - 0.1) < 1e-6].tolist()}  # noqa: E731
    assert len(border(kept)) > 50
    assert border(kept) == border(vertices)
    assert len(left) < len(faces) / 2


def test_views_of_a_ball_are_those_on_its_near_side():
    vertices, faces = ball()
    cameras = three_rings(count=1, elevations=(0,))  # at +x
    seen = selection.count_views(vertices, faces, cameras, enough=1) > 0
    horizon = 0.5**2 / 2.5  # the tangent cone touches the ball at x = r^2 / d
    assert seen[vertices[:, 0] > horizon + 0.06].all()
    assert not seen[vertices[:, 0] < horizon - 0.06].any()


def test_what_is_in_the_way_hides_though_it_is_no_part_of_the_mesh():
    vertices, faces = ball()
    cameras = three_rings(count=1, elevations=(0,))  # at +x
    wall = np.array([[0.8, 0, -2], [0.8, 2, -2], [0.8, 2, 2], [0.8, 0, 2]]), np.array([[0, 1, 2], [0, 2, 3]])
    seen = selection.count_views(vertices, faces, cameras, enough=1, others=[wall]) > 0
    near = vertices[:, 0] > 0.3
    assert seen[near & (vertices[:, 1] < -0.05)].all()
    assert not seen[near & (vertices[:, 1] > 0.05)].any()


def test_what_lies_around_a_tile_hides_what_is_under_it(stage):
    dome = triangle_mesh.clip(*ball(0.8), np.array([1.0, 0, 0]), -0.3)
    _, kept, _ = stage(*ball(), around=dome, rings=0, max_hidden_area=0.0)
    assert kept[:, 0].min() < -0.49
    assert kept[:, 0].max() < 0.2


def test_views_are_counted_up_to_enough():
    vertices, faces = ball()
    cameras = three_rings()
    top = vertices[:, 2].argmax()
    assert selection.count_views(vertices, faces, cameras, enough=3)[top] == 3
    assert selection.count_views(vertices, faces, cameras, enough=99)[top] == len(cameras)


def test_what_lies_outside_the_image_is_not_seen():
    vertices, faces = ball()
    cameras = three_rings(count=1, elevations=(0,))
    narrow = PinholeCameras(cameras.names, np.array([[SIZE // 2, SIZE]]), cameras.intrinsics, cameras.extrinsics)
    seen = selection.count_views(vertices, faces, narrow, enough=1) > 0
    pixels, _ = cameras.project(0, vertices)
    assert seen.any()
    assert not seen[pixels[:, 0] >= SIZE // 2].any()


def test_small_unseen_gaps_are_kept_and_large_ones_dropped():
    vertices, faces = ball()
    middle = vertices[faces].mean(1)
    small, large = middle[:, 2] > 0.48, middle[:, 2] < -0.1
    keep = selection.fill_small_gaps(vertices, faces, ~small & ~large, max_area=0.2)
    assert keep[small].all()
    assert not keep[large].any()


def test_unseen_islands_are_not_gaps():
    vertices, faces = join(ball(), ball(0.06, (0.8, 0, 0)))
    island = np.linalg.norm(vertices[faces].mean(1), axis=1) > 0.6
    assert not selection.fill_small_gaps(vertices, faces, ~island, max_area=10)[island].any()


def test_smoothing_a_selection_fills_notches_only():
    vertices, faces = ball()
    notch = np.zeros(len(faces), dtype=bool)
    notch[np.flatnonzero(vertices[faces].mean(1)[:, 2] > 0)[0]] = True
    assert selection.smooth_selection(faces, len(vertices), ~notch, 2).all()
    half = vertices[faces].mean(1)[:, 2] > 0
    smooth = selection.smooth_selection(faces, len(vertices), half, 2)
    assert smooth[half].all()
    assert vertices[faces[smooth]].mean(1)[:, 2].min() > -0.15


def bow_tie():
    """Two tetrahedra that share one vertex."""
    tetrahedron = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    other = np.where(tetrahedron == 0, 0, tetrahedron + 3)
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, 0, 0], [0, -1, 0], [0, 0, -1]], float)
    return vertices, np.concatenate([tetrahedron, other])


def test_mesh_state_counts_what_is_wrong():
    _, faces = ball()
    assert triangle_mesh.mesh_state(faces) == triangle_mesh.MeshState(0, 0, 0)
    assert triangle_mesh.mesh_state(faces[1:]).open_edges == 3
    assert triangle_mesh.mesh_state(np.concatenate([faces, faces[:1]])).bad_edges == 3
    turned = faces.copy()
    turned[0] = turned[0, ::-1]
    assert triangle_mesh.mesh_state(turned).bad_edges == 3
    assert triangle_mesh.mesh_state(bow_tie()[1]).bad_vertices == 1
    assert not triangle_mesh.mesh_state(bow_tie()[1]).manifold


def test_repair_splits_a_vertex_where_two_fans_meet():
    vertices, faces = triangle_mesh.repair_manifold(*bow_tie())
    assert len(vertices) == 8
    assert len(faces) == 8
    state = triangle_mesh.mesh_state(faces)
    assert state.manifold
    assert state.watertight
    np.testing.assert_array_equal(vertices[faces], bow_tie()[0][bow_tie()[1]])


def test_repair_drops_duplicates_slivers_and_fins_and_leaves_the_rest_alone():
    vertices, faces = ball()
    fin = np.array([[faces[0, 1], faces[0, 0], len(vertices)]])
    point = vertices[faces[0, 0]] + 1e-3
    spoiled = np.concatenate([faces, faces[:2], [[5, 5, 9]], fin])
    repaired, new_faces = triangle_mesh.repair_manifold(np.concatenate([vertices, point[None]]), spoiled)
    np.testing.assert_array_equal(new_faces, faces)
    np.testing.assert_array_equal(repaired, vertices)


def test_repair_drops_faces_back_to_back():
    """Alone, one of them would be a hole."""
    vertices, faces = ball()
    pillow = np.array([[5, 90, 200], [90, 5, 200]])  # shares vertices with the ball, but no edges
    repaired, new_faces = triangle_mesh.repair_manifold(vertices, np.concatenate([faces, pillow]))
    np.testing.assert_array_equal(new_faces, faces)
    np.testing.assert_array_equal(repaired, vertices)
    thrice = np.concatenate([faces, faces[:1], faces[:1, ::-1]])  # once there and back: the first one stays
    np.testing.assert_array_equal(triangle_mesh.repair_manifold(vertices, thrice)[1], faces)


def test_decimation_keeps_shape_and_closedness():
    vertices, faces = ball(resolution=64)
    light, kept = decimate(vertices, faces, 1000)
    assert 900 <= len(kept) <= 1000
    state = triangle_mesh.mesh_state(kept)
    assert state.manifold
    assert state.watertight
    assert np.abs(np.linalg.norm(light, axis=1) - 0.5).max() < 0.01
    same = decimate(vertices, faces, len(faces))
    np.testing.assert_array_equal(same[1], faces)


def test_decimation_reaches_its_target_on_a_rough_surface_and_leaves_no_hole():
    vertices, faces = ball(resolution=48)
    rough = (vertices * np.random.default_rng(0).normal(1, 0.03, (len(vertices), 1))).astype(np.float32)
    _, kept = decimate(rough, faces, 1000)
    assert 990 <= len(kept) <= 1000
    assert triangle_mesh.mesh_state(kept) == triangle_mesh.MeshState(0, 0, 0)


def test_decimation_keeps_a_border_in_place_and_lightens_it():
    vertices, faces = ball(resolution=96)
    upper, kept = triangle_mesh.clip(vertices, faces, np.array([0.0, 0, 1]), 0.1)
    light, few = decimate(upper, kept, 600)
    assert len(few) <= 600
    before, after = triangle_mesh.mesh_state(kept), triangle_mesh.mesh_state(few)
    assert after.manifold
    assert 10 < after.open_edges < before.open_edges / 2
    use = triangle_mesh.edge_use(few)
    rim = few[use.face, use.slot][use.counts[use.edge] == 1]
    np.testing.assert_allclose(light[rim, 2], 0.1, atol=0.005)
    np.testing.assert_allclose(np.linalg.norm(light[rim, :2], axis=1), np.sqrt(0.5**2 - 0.1**2), atol=0.01)


def test_decimation_leaves_frozen_vertices_where_they_are_and_other_borders_to_themselves():
    vertices, faces = ball(resolution=96)
    upper, kept = triangle_mesh.clip(vertices, faces, np.array([0.0, 0, 1]), 0.1)
    band, kept = triangle_mesh.clip(upper, kept, np.array([0.0, 0, -1]), -0.3)
    frozen = np.abs(band[:, 2] - 0.1) < 1e-6
    light, few = decimate(band, kept, len(kept) // 4, frozen)
    assert len(few) < len(kept) / 2
    assert triangle_mesh.mesh_state(few).manifold
    rim = light[np.abs(light[:, 2] - 0.1) < 1e-6]
    assert {tuple(each) for each in rim.tolist()} == {tuple(each) for each in band[frozen].tolist()}
    assert (np.abs(light[:, 2] - 0.3) < 5e-3).sum() < (np.abs(band[:, 2] - 0.3) < 1e-6).sum() / 2


def test_decimation_does_not_depend_on_what_pymeshlab_did_before():
    import pymeshlab

    first = decimate(*ball(resolution=32), 500)
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(*ball(resolution=16)))
    meshes.meshing_decimation_quadric_edge_collapse(
        targetfacenum=100, optimalplacement=False, planarquadric=True, planarweight=1.0, qualitythr=1.0,
        boundaryweight=9.0, qualityweight=False, autoclean=False,
    )  # fmt: skip
    again = decimate(*ball(resolution=32), 500)
    for before, after in zip(first, again, strict=True):
        np.testing.assert_array_equal(before, after)


def test_decimation_refuses_an_impossible_target():
    with pytest.raises(ValueError, match="target_faces >= 4"):
        decimate(*ball(), 3)


def test_hull_drops_what_most_masks_exclude_but_trusts_no_single_mask():
    cameras = three_rings()
    points = np.array([[0, 0, 0], [0.8, 0, 0.0], [0, 0, 0.3]])
    disk = silhouettes(cameras)
    assert selection.outside_hull(points, cameras, disk, 0.1).tolist() == [False, True, False]
    one_bad = [(i, mask if i else np.zeros_like(mask)) for i, mask in disk]
    assert selection.outside_hull(points, cameras, one_bad, 0.05).tolist() == [False, True, False]
    assert not selection.outside_hull(points, cameras, [], 0.1).any()


def silhouettes(cameras, radius=0.5):
    """Masks [H, W] of a ball at the origin."""
    masks = []
    grid = np.stack(np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5), axis=2).reshape(-1, 2)
    for i in range(len(cameras)):
        origins, directions = cameras.rays(i, grid)
        closest = np.linalg.norm(np.cross(origins, directions), axis=1)
        masks.append((i, (closest < radius).reshape(SIZE, SIZE)))
    return masks


def test_stage_drops_floaters_inner_and_outer_shells(stage):
    thing = ball(0.5, resolution=64)
    inner = ball(0.3, resolution=64)
    v, f = ball(0.95, resolution=64)
    cap = f[(v[f][:, :, 2] < -0.7).all(1)]  # background shell behind the object, turned away from the cameras above
    floater = ball(0.05, (0.75, 0, 0.3), resolution=64)
    specks = ball(0.995, resolution=64)  # beyond the region of interest
    vertices, faces = join(thing, inner, (v, cap), floater, (specks[0], specks[1][:2000]))
    numbers, vertices, faces = stage(vertices, faces, min_component=0.02)
    radii = np.linalg.norm(vertices, axis=1)
    assert radii.min() > 0.48
    assert radii.max() < 0.52
    assert numbers["manifold"]
    assert numbers["unseen_faces"] > len(inner[1])
    assert numbers["outside_region"] == 2000
    assert numbers["pieces_dropped"] + numbers["specks_dropped"] >= 1
    assert numbers["faces"] == len(faces)
    # The part that cameras above see is kept, the underside is not.
    assert vertices[:, 2].max() > 0.48
    assert -0.48 < vertices[:, 2].min() < -0.1
    assert not numbers["watertight"]


def test_stage_keeps_small_pieces_of_the_surface(stage):
    """Thin parts come out of training in pieces, of some thousandths of the whole."""
    numbers, vertices, _ = stage(*join(ball(0.5, resolution=96), ball(0.05, (0, 0, 0.6), resolution=96)))
    assert vertices[:, 2].max() > 0.64
    assert numbers["pieces_dropped"] == 0


def test_stage_can_keep_the_unseen_underside(stage):
    numbers, vertices, _ = stage(*join(ball(0.5, resolution=48), ball(0.3, resolution=48)), keep_closed=True)
    assert numbers["watertight"]
    assert numbers["manifold"]
    assert np.linalg.norm(vertices, axis=1).min() > 0.47


@pytest.mark.parametrize(("kind", "rim"), [(artifacts.PINHOLE_PHOTOS, 0.62), (artifacts.OUTLINES, 0.64)])
def test_stage_cuts_to_the_masks(stage, kind, rim):
    surface = extract_isosurface(
        lambda p: np.minimum(np.linalg.norm(p, axis=1) - 0.5, np.abs(p[:, 2] + 0.3) - 0.03), 64
    )
    numbers, vertices, _ = stage(surface.vertices, surface.faces, masks=silhouettes, kind=kind)
    assert numbers["outside_masks"] > 1000
    assert np.linalg.norm(vertices[:, :2], axis=1).max() < rim
    assert vertices[:, 2].max() > 0.48


def bulging_ball_on_a_table():
    """The ball of `silhouettes`, with a blister on its top that only cameras above see on their masks."""

    def distance(p):
        ball, blister = np.linalg.norm(p, axis=1) - 0.5, np.linalg.norm(p - [0, 0, 0.38], axis=1) - 0.3
        return np.minimum(np.minimum(ball, blister), np.abs(p[:, 2] + 0.3) - 0.03)

    return extract_isosurface(distance, 64)


def test_what_bulges_is_shown_on_masks_and_a_table_is_not():
    surface, cameras = bulging_ball_on_a_table(), three_rings()
    masks, vertices = silhouettes(cameras), surface.vertices
    off = selection.outside_hull(vertices, cameras, masks, 0.3)
    top, table = off & (vertices[:, 2] > 0.55), off & (vertices[:, 2] < -0.2)
    assert min(np.count_nonzero(top), np.count_nonzero(table)) > 100
    shown = selection.shown_on_masks(vertices, surface.faces, cameras, masks, off, 0.3)
    assert shown[top].mean() > 0.95
    assert not shown[table].any()
    assert not shown[~off].any()
    one = [masks[int(np.argmax(cameras.centers[:, 2]))]]
    assert not selection.shown_on_masks(vertices, surface.faces, cameras, one, off, 0.3).any()


@pytest.mark.parametrize(("kind", "top"), [(artifacts.PINHOLE_PHOTOS, 0.55), (artifacts.SILHOUETTES, 0.68)])
def test_masks_beside_photos_leave_no_hole_where_the_mesh_bulges(stage, kind, top):
    surface = bulging_ball_on_a_table()
    _, vertices, _ = stage(surface.vertices, surface.faces, masks=silhouettes, kind=kind)
    assert vertices[:, 2].max() == pytest.approx(top, abs=0.03)
    assert np.linalg.norm(vertices[:, :2], axis=1).max() < 0.64


def test_stage_without_masks_keeps_the_table(stage):
    surface = extract_isosurface(
        lambda p: np.minimum(np.linalg.norm(p, axis=1) - 0.5, np.abs(p[:, 2] + 0.3) - 0.03), 64
    )
    numbers, vertices, faces = stage(surface.vertices, surface.faces, target_faces=3000)
    assert np.linalg.norm(vertices[:, :2], axis=1).max() > 0.85
    assert vertices[:, 2].min() > -0.31 - 0.01  # its underside is gone
    assert len(faces) <= 3000
    assert numbers["manifold"]


def test_stage_says_when_nothing_is_left(stage):
    empty = lambda cameras: [(i, np.zeros((SIZE, SIZE), bool)) for i in range(len(cameras))]  # noqa: E731
    with pytest.raises(ReconstructionError) as caught:
        stage(*ball(), masks=empty)
    assert "outside_masks" in caught.value.message
    assert "--set cleanup.mask_hull=false" in caught.value.hint


# ---------------------------------------------------------------- box and ground
def test_clipping_a_ball_cuts_at_the_plane_and_keeps_the_rest():
    vertices, faces = ball(0.5, resolution=48)
    normal = np.array([0.6, 0.0, 0.8])
    above, kept = triangle_mesh.clip(vertices, faces, normal, 0.2)
    heights = above @ normal
    assert heights.min() == pytest.approx(0.2, abs=1e-6)
    assert heights.max() == pytest.approx(0.5, abs=1e-3)
    state = triangle_mesh.mesh_state(kept)
    assert state.manifold
    rim = np.abs(heights - 0.2) < 1e-6
    assert 100 < state.open_edges <= rim.sum()
    np.testing.assert_allclose(np.linalg.norm(above[rim], axis=1), 0.5, atol=2e-3)
    below, rest = triangle_mesh.clip(vertices, faces, -normal, -0.2)
    area = lambda v, f: np.linalg.norm(triangle_mesh.face_normals(v, f), axis=1).sum()  # noqa: E731
    assert area(above, kept) + area(below, rest) == pytest.approx(area(vertices, faces), rel=1e-5)
    assert len(triangle_mesh.clip(vertices, faces, normal, 0.6)[1]) == 0
    np.testing.assert_array_equal(triangle_mesh.clip(vertices, faces, normal, -0.6)[1], faces)


def table_with_ball(tilt=0.02):
    """A ball of radius 0.4 that stands on a slab whose upper side is z = tilt x - 0.35."""
    sides = lambda p: np.abs(p[:, 2] - tilt * p[:, 0] + 0.4) - 0.05  # noqa: E731
    surface = extract_solid(lambda p: np.minimum(np.linalg.norm(p, axis=1) - 0.4, sides(p)), 64)
    return surface.vertices, surface.faces


@pytest.mark.parametrize("keep_closed", [False, True])
def test_stage_removes_the_ground_on_request(stage, keep_closed):
    ground = Plane(np.array([0.0, 0, 1]), -0.36, 0.01, 0.5)  # a little off: it is fitted anew
    bumps = [ball(0.06, (x, 0.5, 0.02 * x - 0.35), resolution=64) for x in (-0.5, 0.5)]
    numbers, vertices, _ = stage(
        *join(table_with_ball(), *bumps), scene_extras={"ground": ground}, remove_ground=True, keep_closed=keep_closed
    )
    assert numbers["ground_removed"]
    assert np.linalg.norm(vertices[:, :2], axis=1).max() < 0.42
    heights = vertices[:, 2] - 0.02 * vertices[:, 0] + 0.35
    assert heights.min() == pytest.approx(0.015, abs=0.005)
    assert vertices[:, 2].max() > 0.38
    assert numbers["watertight"] == keep_closed


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cut", "params"),
    [
        ({}, {}),
        ({"ground": Plane(np.array([0.0, 0, 1]), -0.35, 0.01, 0.5)}, {"remove_ground": True}),
        ({}, {"region": given_region("box", (-0.6, -0.2, -0.38, 0.3, 0.7, 0.2), Similarity.identity())}),
        ({}, {"mask_hull": True}),
    ],
    ids=["ball", "ground", "box", "masks"],
)
def test_stage_makes_a_solid_of_what_leaves_the_region(stage, cut, params):
    masks = silhouettes if params.pop("mask_hull", False) else None
    numbers, vertices, faces = stage(
        *table_with_ball(), masks, scene_extras=cut, keep_closed=True, target_faces=2000, **params
    )
    assert (numbers["open_edges"], numbers["watertight"], numbers["manifold"]) == (0, True, True)
    assert numbers["faces"] <= 2000
    a, b, c = vertices.astype(float)[faces].transpose(1, 0, 2)
    assert (a * np.cross(b, c)).sum() > 0
    assert np.linalg.norm(vertices, axis=1).max() < 0.99


def test_stage_drops_what_closes_the_surface_beyond_the_region(stage):
    surface = extract_solid(lambda p: p[:, 2] + 0.1, 32)  # below ground all is solid
    _, vertices, _ = stage(surface.vertices, surface.faces, roi_radius=1.0)
    np.testing.assert_allclose(vertices[:, 2], -0.1, atol=1e-4)
    assert np.linalg.norm(vertices, axis=1).max() > 0.95


@pytest.mark.parametrize("seen_below", [False, True])
def test_stage_drops_flaps_under_the_ground_at_the_border_unless_points_lie_there(stage, seen_below):
    ground = Plane(np.array([0.0, 0, 1]), -0.1, 0.01, 0.5)
    flap = lambda p: np.maximum(np.linalg.norm(p - [0.85, 0, -0.25], axis=1) - 0.1, -p[:, 2] - 0.6)  # noqa: E731
    pit = lambda p: np.linalg.norm(p - [0.2, 0, -0.25], axis=1) - 0.1  # noqa: E731
    slab = lambda p: np.abs(p[:, 2] + 0.13) - 0.03  # noqa: E731
    surface = extract_solid(lambda p: np.minimum(slab(p), np.minimum(flap(p), pit(p))), 64)
    points = np.random.default_rng(0).uniform([-0.6, -0.6, -0.1], [0.6, 0.6, 0.1], (200, 3))
    points[: 10 if seen_below else 1, 2] = -0.3
    seen = {"points": points.astype(np.float32), "point_errors": np.zeros(200, np.float32)}
    numbers, vertices, _ = stage(surface.vertices, surface.faces, scene_extras={"ground": ground, **seen}, min_views=0)
    assert (numbers["under_ground"] > 0) != seen_below
    low = vertices[vertices[:, 2] < -0.2]
    assert (low[:, 0] < 0.4).any()
    assert (low[:, 0] > 0.76).any() == seen_below


def test_stage_says_when_a_solid_was_wanted_and_is_none(stage, monkeypatch, caplog):
    decimated = "stages.surface.decimation.decimate"
    monkeypatch.setattr(decimated, lambda vertices, faces, *_: (vertices, faces[1:]))
    numbers, _, _ = stage(*ball(), keep_closed=True)
    assert numbers["open_edges"] > 0
    assert "was to be closed" in caplog.text


def test_stage_keeps_the_ground_where_none_was_found_and_says_so(stage, caplog):
    numbers, vertices, _ = stage(*table_with_ball(), remove_ground=True)
    assert not numbers["ground_removed"]
    assert np.linalg.norm(vertices[:, :2], axis=1).max() > 0.85
    assert "no ground was found" in caplog.text


def test_stage_crops_to_the_box_of_the_world(stage):
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    world_from_poses = Similarity(0.5, np.eye(3), np.array([7.0, 0, 0]))
    poses_from_scene = Similarity(4.0, turn, np.array([6.0, 0, 0]))
    region = given_region("box", (9.6, -1.0, -0.2, 10.4, 0.4, 5.0), world_from_poses)
    extras = {"poses_from_scene": poses_from_scene}
    _, vertices, _ = stage(*ball(0.5, resolution=64), scene_extras=extras, region=region)
    corners = world_from_poses.compose(poses_from_scene).apply(vertices.astype(float))
    np.testing.assert_allclose(corners.min(0), [9.6, -1.0, -0.2], atol=0.01)
    np.testing.assert_allclose(corners.max(0), [10.4, 0.4, 1.0], atol=0.01)


def test_stage_says_when_the_box_is_empty(stage):
    with pytest.raises(ReconstructionError, match="inside the box"):
        stage(*ball(), region=given_region("box", (0.7, 0.7, 0.7, 0.8, 0.8, 0.8), Similarity.identity()))


def test_a_mesh_that_the_region_cuts_is_warned_of_with_a_larger_region(stage):
    rod = extract_isosurface(lambda p: np.maximum(np.linalg.norm(p[:, :2], axis=1) - 0.15, -p[:, 2]), 64)
    above = capture(ring(np.array([0, 0, 0.7]), distance=2.25, pitch_deg=15))
    numbers, *_ = stage(rod.vertices, rod.faces, scene_extras={"cameras": above, "roi_scale": 0.5})
    [warning] = numbers["warnings"]
    assert "cuts what 12 photos have in their middle" in warning["sentence"]
    scale = float(warning["command"].split("--set undistort.roi_scale=")[1])
    assert 0.5 * (1 + GROWTH) - 0.02 < scale < 0.5 * (1 + GROWTH) + 0.05  # times the region that was found


def test_a_whole_mesh_is_not_warned_of(stage):
    assert stage(*ball())[0]["warnings"] == []
