"""What Gaussians should look like: the part of a photo that shows the mesh."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from stages.artifacts import AtlasMesh
from stages.gaussians.placing import free_gaussians
from stages.gaussians.targets import MARGIN, target, where_drawn
from stages.geometry.cameras import PinholeCameras

WIDTH, HEIGHT = 90, 70


def square() -> AtlasMesh:
    corners = np.array([[-0.5, -0.5, 0], [0.5, -0.5, 0], [0.5, 0.5, 0], [-0.5, 0.5, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return AtlasMesh(corners, np.tile([0, 0, -1.0], (4, 1)), corners[:, :2] + 0.5, faces, 64)


def camera() -> PinholeCameras:
    """The square is 40 pixels wide, its middle at (41, 33)."""
    K = np.array([[80.0, 0, 41], [0, 80, 33], [0, 0, 1]])
    pose = np.concatenate([np.eye(3), [[0], [0], [2]]], 1)
    return PinholeCameras(("a",), np.array([[WIDTH, HEIGHT]]), K[None], pose[None])


def some_photo() -> np.ndarray:
    return np.random.default_rng(0).integers(0, 200, (HEIGHT, WIDTH, 3)).astype(np.uint8)


def test_inside_is_the_photo_and_beyond_a_margin_the_background() -> None:
    photo = some_photo()
    found = target(square(), camera(), 0, photo, None, np.array([1.0, 0.5, 1.2]))
    assert found.shown.shape == (40 + 2 * MARGIN, 40 + 2 * MARGIN, 3)
    background, drawn = np.array([0.1, 0.2, 0.3], np.float32), np.full(found.shown.shape, 0.7, np.float32)
    seen = found.over(background, drawn)
    inner = seen[MARGIN:-MARGIN, MARGIN:-MARGIN]
    np.testing.assert_allclose(inner, photo[13:53, 21:61] * np.array([1.0, 0.5, 1.2]) / 255, atol=1e-6)
    assert (seen[0, 0] == background).all()  # a corner of the window
    assert (seen[1, 20] == np.float32(0.7)).all()  # in the margin


def test_a_mask_says_where_the_object_ends() -> None:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[:, :41] = True
    found = target(square(), camera(), 0, some_photo(), mask, np.ones(3))
    assert found.inside[20, 10]
    assert not found.inside[20, 30]
    assert not found.outside[20, 30]  # the mesh is there: which of both is wrong is not known
    assert target(square(), camera(), 0, some_photo(), np.zeros((HEIGHT, WIDTH), bool), np.ones(3)) is None


def test_what_something_else_hides_is_neither_inside_nor_outside() -> None:
    before = square().vertices * [0.5, 0.5, 1] - [0, 0, 0.5]
    alone = target(square(), camera(), 0, some_photo(), None, np.ones(3))
    found = target(square(), camera(), 0, some_photo(), None, np.ones(3), others=(before, square().faces))
    assert alone is not None
    assert found is not None
    lost = alone.inside & ~found.inside
    assert 0.1 < lost.sum() / alone.inside.sum() < 0.6
    assert not found.inside[lost.shape[0] // 2, lost.shape[1] // 2]
    np.testing.assert_array_equal(found.outside, alone.outside)


def test_with_the_background_all_of_the_photo_counts() -> None:
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[:, :41] = True
    found = target(square(), camera(), 0, some_photo(), mask, np.ones(3), background=True)
    np.testing.assert_array_equal(found.shown, some_photo())
    assert found.inside.all()
    assert not found.outside.any()
    spots = free_gaussians(
        np.array([[x, 0.0, 0.0] for x in (-0.5, 0, 0.5, 1)]), np.zeros((4, 3)), np.ones((9, 3)), 4, 0
    )
    spots = replace(
        spots, log_scales=np.full((4, 3), np.log(0.05), np.float32), opacity_logits=np.full(4, 9, np.float32)
    )
    told = where_drawn(found, spots).inside
    assert told[33, 41]
    assert told[33, 21]
    assert not told[33, 31]
    assert 20 < told.sum() < 150


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_a_photo_finer_than_the_gaussians_is_shrunk_with_its_camera(factor) -> None:
    photo = some_photo()
    found = target(square(), camera(), 0, photo, None, np.ones(3), spacing=1.35 * factor / 40)
    assert found.camera.focal[0] == pytest.approx(80 / factor)
    assert found.shown.shape[:2] == (found.camera.height, found.camera.width)
    # The middle of the square in the shrunk photo shows what it shows in the photo.
    column, row = (int(each) for each in found.camera.middle)
    left, top = 41 - found.camera.middle[0] * factor, 33 - found.camera.middle[1] * factor
    x, y = round(left + column * factor), round(top + row * factor)
    truth = photo[y : y + factor, x : x + factor].mean((0, 1))
    np.testing.assert_allclose(found.shown[row, column], truth, atol=0.51)
