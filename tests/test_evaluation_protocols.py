"""The benchmarks' own protocols, against slow loops and closed forms on made-up data."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from stages.drawing.rendering import look_at
from stages.evaluation.protocols import dtu
from stages.evaluation.protocols.dtu import DtuTruth, dtu_score, lattice
from stages.evaluation.protocols.glossy import VOXEL, drawn_depth, glossy_score, visible_points
from stages.evaluation.protocols.tanks import TAU, CropVolume, refined, tanks_score
from stages.evaluation.surfaces import Surface
from stages.geometry.cameras import PinholeCameras


def flat(height: float, low: float, high: float) -> Surface:
    """A square over [low, high]^2."""
    corners = np.array([[low, low, height], [high, low, height], [high, high, height], [low, high, height]])
    return Surface(corners, np.array([[0, 1, 2], [0, 2, 3]]))


# ---------------------------------------------------------------- DTU
def scan(points: np.ndarray) -> DtuTruth:
    """Cells of 1 mm over [0, 10] x [0, 10] x [-5, 5], observed where x < 5.5; all above z = -100."""
    observed = np.zeros((11, 11, 11), bool)
    observed[:6] = True
    box = np.array([[0.0, 0, -5], [10, 10, 5]])
    return DtuTruth(points, observed, box, 1.0, np.array([0, 0, 1.0, 100]))


def grid(height: float, step: float = 0.1) -> np.ndarray:
    x, y = np.meshgrid(np.arange(0, 10 + step / 2, step), np.arange(0, 10 + step / 2, step))
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], 1)


def test_dtu_a_plane_half_a_millimetre_off_scores_half_a_millimetre():
    found = dtu_score(flat(0.5, 0, 10), scan(grid(0)))
    assert found.accuracy == pytest.approx(0.5, abs=0.01)
    assert found.completeness == pytest.approx(0.5, abs=0.03)  # the predicted points are 0.2 apart and more
    assert found.overall == pytest.approx(0.5 * (found.accuracy + found.completeness))
    assert (found.predicted_far, found.true_far) == (0, 0)


def test_dtu_looks_at_observed_cells_only_and_caps_what_is_far():
    wild = np.array([[8.0, 5, 3], [3, 3, 30], [300, 0, 0]])  # not observed; out of all cells; out of the patch
    cloud = Surface(np.concatenate([grid(0.5, 0.25), wild]))
    with_wild, alone = dtu_score(cloud, scan(grid(0))), dtu_score(Surface(grid(0.5, 0.25)), scan(grid(0)))
    assert (with_wild.accuracy, with_wild.predicted_points) == (alone.accuracy, alone.predicted_points)
    far = dtu_score(Surface(grid(0.5, 0.25)), scan(np.concatenate([grid(0), grid(40)])))
    assert far.completeness == pytest.approx(alone.completeness)
    assert far.true_far == pytest.approx(50)
    below = scan(np.concatenate([grid(0), grid(-200)]))  # under the table: asked nothing of
    assert dtu_score(Surface(grid(0.5, 0.25)), below).true_points == len(grid(0))
    with pytest.raises(ValueError, match="no predicted point lies in the observed part"):
        dtu_score(flat(0.5, 500, 510), scan(grid(0)))


def test_dtu_agrees_with_the_published_steps_as_a_slow_loop():
    rng = np.random.default_rng(5)
    cloud = np.concatenate([rng.uniform([-2, -2, -2], [12, 12, 2], (300, 3)), rng.uniform(-90, 150, (40, 3))])
    truth = scan(rng.uniform([-1, -1, -3], [11, 11, 3], (150, 3)))
    truth = DtuTruth(truth.points, rng.random((11, 11, 11)) < 0.5, truth.box, 1.0, np.array([0, 0, 1.0, 1.5]))
    kept: list[np.ndarray] = []
    for point in np.random.default_rng(0).permutation(cloud):
        if all(np.linalg.norm(point - other) > 0.2 for other in kept):
            kept.append(point)
    low, high = truth.box
    near = [p for p in kept if all(low[k] - 60 <= p[k] < high[k] + 120 for k in range(3))]
    measured = []
    for p in near:
        cell = [int(np.around(p[k] - low[k])) for k in range(3)]
        if all(0 <= cell[k] < 11 for k in range(3)) and truth.observed[tuple(cell)]:
            measured.append(p)
    above = [q for q in truth.points if q[2] + 1.5 > 0]
    d2s = [min(np.linalg.norm(p - q) for q in truth.points) for p in measured]
    s2d = [min(np.linalg.norm(p - q) for p in near) for q in above]
    found = dtu_score(Surface(cloud), truth)
    assert (found.predicted_points, found.true_points) == (len(measured), len(above))
    assert found.accuracy == pytest.approx(np.mean([d for d in d2s if d < 20]))
    assert found.completeness == pytest.approx(np.mean([d for d in s2d if d < 20]))


def test_dtu_turns_triangles_into_a_lattice_as_published():
    mesh = trimesh.creation.icosphere(1, 1.3)
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    expected = list(vertices)
    for face in faces:
        a, b, c = vertices[face]
        first, second = b - a, c - a
        lengths = np.linalg.norm(first), np.linalg.norm(second)
        step = 0.2 * np.sqrt(lengths[0] * lengths[1] / np.linalg.norm(np.cross(first, second)))
        n1, n2 = (int(np.floor(length / step)) for length in lengths)
        for i in range(n1 + 1):
            for j in range(n2 + 1):
                u, v = (i + 0.5) / n1, (j + 0.5) / n2
                if u + v < 1:
                    expected.append(a + u * first + v * second)
    found = lattice(vertices, faces, 0.2)
    order = np.lexsort(np.round(found, 9).T)
    expected_array = np.array(expected)
    np.testing.assert_allclose(found[order], expected_array[np.lexsort(np.round(expected_array, 9).T)], atol=1e-9)
    small = lattice(0.01 * vertices, faces, dtu.DENSITY)  # triangles smaller than the spacing: their corners alone
    assert len(small) == len(vertices)


# ---------------------------------------------------------------- GlossySynthetic
def ring(count: int = 6, size: int = 96) -> PinholeCameras:
    angles = 2 * np.pi * np.arange(count) / count
    eyes = [3 * np.array([np.cos(a), np.sin(a), 0.4 * (-1) ** i]) for i, a in enumerate(angles)]
    found = [look_at(eye, np.zeros(3), np.array([0.0, 0, 1]), size, size) for eye in eyes]
    return PinholeCameras(
        tuple(f"{i}.png" for i in range(count)),
        *(np.concatenate([getattr(one, name) for one in found]) for name in ("sizes", "intrinsics", "extrinsics")),
    )


def ball(radius: float) -> Surface:
    mesh = trimesh.creation.icosphere(5, radius)
    return Surface(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def depths(surface: Surface, cameras: PinholeCameras) -> list[np.ndarray]:
    return [drawn_depth(cameras, i, surface.points, surface.faces) for i in range(len(cameras))]


def test_glossy_the_truth_itself_scores_nothing_and_a_percent_of_the_radius_one_percent():
    cameras = ring()
    truth = visible_points(cameras, depths(ball(0.8), cameras))
    assert glossy_score(ball(0.8), cameras, truth).chamfer == 0
    found = glossy_score(ball(0.84), cameras, truth)
    assert found.accuracy == pytest.approx(0.04, rel=0.1)
    assert found.chamfer == pytest.approx(0.5 * (found.accuracy + found.completeness))
    assert found.true_points == len(truth)
    with pytest.raises(ValueError, match="none of 6 cameras"):
        glossy_score(Surface(ball(0.8).points + 50, ball(0.8).faces), cameras, truth)
    with pytest.raises(ValueError, match="no faces"):
        glossy_score(Surface(truth), cameras, truth)


def test_glossy_what_no_camera_sees_asks_nothing():
    cameras = ring()
    truth = visible_points(cameras, depths(ball(0.8), cameras))
    shell, core = ball(0.8), ball(0.3)
    both = Surface(
        np.concatenate([shell.points, core.points]), np.concatenate([shell.faces, core.faces + len(shell.points)])
    )
    assert glossy_score(both, cameras, truth).chamfer == 0


def test_glossy_points_are_those_of_a_loop_over_pixels():
    cameras = ring(2, 24)
    maps = [np.where(depth < 14.5, depth, 0) for depth in depths(ball(0.8), cameras)]
    expected = []
    for i, depth in enumerate(maps):
        pose = np.vstack([cameras.extrinsics[i], [0, 0, 0, 1]])
        for y in range(24):
            for x in range(24):
                if depth[y, x] > 0:
                    in_cam = depth[y, x] * np.linalg.inv(cameras.intrinsics[i]) @ [x, y, 1]
                    expected.append((np.linalg.inv(pose) @ [*in_cam, 1])[:3])
    found = visible_points(cameras, maps)
    # one a cube of 0.01, and pixels are some 0.07 apart: nearly all stay
    distances = np.linalg.norm(found[:, None] - np.array(expected)[None], axis=2)
    assert distances.min(1).max() < VOXEL
    assert 0.95 * len(expected) < len(found) <= len(expected)


# ---------------------------------------------------------------- Tanks and Temples
BOX = CropVolume(2, -1.0, 1.0, np.array([[0.0, 0], [2, 0], [2, 1], [0, 1]]))


def plate(step: float = 0.004) -> np.ndarray:
    x, y = np.meshgrid(np.arange(-0.5, 2.5, step), np.arange(-0.5, 1.5, step))
    return np.stack([x.ravel(), y.ravel(), 0.1 * np.sin(3 * x.ravel()) * np.cos(2 * y.ravel())], 1)


def test_tanks_a_surface_within_tau_has_all_and_one_beyond_has_nothing():
    truth = plate()
    near, far = (
        tanks_score(Surface(truth + np.array([0, 0, d])), truth, BOX, 0.02, refine=False) for d in (0.01, 0.06)
    )
    assert (near.precision, near.recall, near.f_score) == pytest.approx((100, 100, 100))
    assert (far.precision, far.recall, far.f_score) == (0, 0, 0)
    left = truth[truth[:, 0] < 1]
    half = tanks_score(Surface(left), truth, BOX, 0.02, refine=False)
    assert (half.precision, half.recall) == pytest.approx((100, 50), abs=1.5)
    assert half.f_score == pytest.approx(2 * half.precision * half.recall / (half.precision + half.recall))
    with pytest.raises(ValueError, match="crop volume"):
        tanks_score(Surface(truth + 50), truth, BOX, 0.02)


def test_tanks_rounds_of_icp_undo_a_small_motion_with_scale():
    truth = plate(0.01)
    matrix = trimesh.transformations.rotation_matrix(np.radians(2), (0.2, 0.1, 1), (1, 0.5, 0))
    matrix[:3, :3] *= 1.02
    matrix[:3, 3] += 0.02
    moved = truth @ matrix[:3, :3].T + matrix[:3, 3]
    given = tanks_score(Surface(moved), truth, BOX, 0.02, np.linalg.inv(matrix), refine=False)
    assert given.f_score == pytest.approx(100)
    assert tanks_score(Surface(moved), truth, BOX, 0.02, refine=False).f_score < 80
    found = tanks_score(Surface(moved), truth, BOX, 0.02)
    assert found.f_score > 98
    assert np.abs(found.matrix @ matrix - np.eye(4)).max() < 0.5 * np.abs(matrix - np.eye(4)).max()
    np.testing.assert_allclose(refined(truth, truth, BOX, 0.02), np.eye(4), atol=1e-6)


def test_tanks_a_mesh_is_sampled_densely_enough_for_its_own_points():
    mesh = Surface(np.array([[-1.0, -1, 0], [3, -1, 0], [3, 2, 0], [-1, 2, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
    grid_points = np.stack(np.meshgrid(np.arange(-0.5, 2.5, 0.02), np.arange(-0.5, 1.5, 0.02), [0.0]), -1)
    found = tanks_score(mesh, grid_points.reshape(-1, 3), BOX, 0.04, refine=False)
    assert found.f_score == pytest.approx(100)


def test_the_crop_volume_holds_what_open3d_says():
    import open3d as o3d

    polygon = np.array([[0.0, 0, 0], [2, 0, 0.3], [1.4, 0, 1], [2, 0, 2], [0.2, 0, 1.8], [0.7, 0, 1]])
    theirs = o3d.visualization.SelectionPolygonVolume()
    theirs.orthogonal_axis = "Y"
    theirs.axis_min, theirs.axis_max = -0.5, 0.7
    theirs.bounding_polygon = o3d.utility.Vector3dVector(polygon)
    points = np.random.default_rng(0).uniform(-1, 3, (3000, 3))
    cropped = theirs.crop_point_cloud(o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points)))
    ours = points[CropVolume(1, -0.5, 0.7, polygon[:, [0, 2]]).holds(points)]
    np.testing.assert_array_equal(ours, np.asarray(cropped.points))
    assert len(ours) > 100


def test_the_scenes_of_the_toolbox_have_its_thresholds():
    assert TAU["Ignatius"] == 0.003
    assert len(TAU) == 7
