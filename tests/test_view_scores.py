"""Drawings of a textured mesh against photos."""

from __future__ import annotations

import numpy as np
import pytest

from stages.artifacts import AtlasMesh
from stages.drawing.rendering import look_at
from stages.drawing.view_scores import draw_view, psnr, score_views, silhouette, ssim
from stages.geometry.cameras import PinholeCameras

MASK = np.zeros((32, 32), bool)
MASK[8:24, 8:24] = True


def _noise(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(40, 200, (32, 32, 3)).astype(np.uint8)


def test_psnr_has_its_closed_form_and_counts_the_mask_alone():
    truth = _noise(0)
    image = truth + np.uint8(51)  # a fifth of the range: 20 log10(5)
    image[~MASK] = 0
    assert psnr(image, truth, MASK) == pytest.approx(20 * np.log10(5))
    assert psnr(truth, truth, MASK) == pytest.approx(100)
    with pytest.raises(ValueError, match="empty"):
        psnr(image, truth, ~np.ones((32, 32), bool))


def test_ssim_is_one_for_equal_images_and_falls_with_noise_whatever_lies_outside():
    truth = _noise(0)
    image = truth.copy()
    image[~MASK] = 0
    assert ssim(image, truth, MASK) == pytest.approx(1)
    assert ssim(_noise(1), truth, MASK) < 0.6
    with pytest.raises(ValueError, match="empty"):
        ssim(image, truth, ~np.ones((32, 32), bool))


@pytest.fixture
def board() -> tuple[AtlasMesh, np.ndarray, PinholeCameras]:
    """A square with four colours in its quarters, seen from the front by two cameras."""
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 0.5
    vertices = np.stack([square[:, 0], np.zeros(4), square[:, 1]], 1).astype(np.float32)
    normals = np.tile(np.float32([0, -1, 0]), (4, 1))
    atlas = AtlasMesh(vertices, normals, (square + 0.5).astype(np.float32), np.int32([[0, 1, 2], [0, 2, 3]]), 64)
    texture = np.zeros((64, 64, 3), np.uint8)
    texture[:32, :32], texture[:32, 32:], texture[32:, :32] = (250, 0, 0), (0, 250, 0), (0, 0, 250)
    views = [look_at(np.array([x, -2.5, 0.2]), np.zeros(3), np.array([0.0, 0, 1]), 48, 40, 40) for x in (-0.5, 0.6)]
    cameras = PinholeCameras(
        ("one.png", "two.png"),
        np.concatenate([view.sizes for view in views]),
        np.concatenate([view.intrinsics for view in views]),
        np.concatenate([view.extrinsics for view in views]),
    )
    return atlas, texture, cameras


def test_a_mesh_meets_photos_of_itself_within_the_mask_or_its_silhouette(board):
    atlas, texture, cameras = board
    photos = [draw_view(atlas, texture, cameras, i) for i in range(2)]
    covered = [silhouette(atlas.vertices, atlas.faces, cameras, i) for i in range(2)]
    mask = covered[1].copy()
    mask[:, :24] = False
    masks = [None, mask]
    scores = list(score_views(atlas, texture, cameras, lambda i: (photos[i], masks[i]), cameras.names))
    assert [score.name for score in scores] == ["one.png", "two.png"]
    assert [score.counted.sum() for score in scores] == [covered[0].sum(), mask.sum()]
    assert all(score.psnr == pytest.approx(100) and score.ssim == pytest.approx(1) for score in scores)
    (turned,) = score_views(atlas, texture[::-1], cameras, lambda i: (photos[i], None), ["one.png"])
    assert turned.psnr < 8
    assert list(score_views(atlas, texture, cameras, lambda i: (photos[i], np.zeros_like(mask)), cameras.names)) == []


def test_selected_cameras_keep_what_is_theirs(board):
    cameras = board[2]
    second = cameras.select([1])
    assert second.names == ("two.png",)
    assert np.array_equal(second.centers, cameras.centers[1:])
