"""What outlines say of where the object is, and how far they are believed: on a ball, where all is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from ball_training import TINY, make_trainer
from sphere_scene import RADIUS, render, ring_of_cameras, sphere_cloud
from train_settings import changed

from stages import train
from stages.geometry.cameras import PinholeCameras
from stages.geometry.outlines import PIXEL, UNKNOWN, mask_depth, object_space, outline_errors
from stages.geometry.point_cloud import PointCloud
from stages.neural.silhouettes import Silhouettes, outline_loss

WALL = 1.2  # a background behind the ball: points on a cylinder of this radius


def cameras() -> PinholeCameras:
    return ring_of_cameras(24, 96, 80)


def with_background(cameras: PinholeCameras) -> PointCloud:
    """Points on the ball, and on a wall around it wherever a photo sees it past the ball."""
    ball = sphere_cloud(cameras)
    rng = np.random.default_rng(2)
    angle, height = rng.uniform(0, 2 * np.pi, 6000), rng.uniform(-0.6, 0.6, 6000)
    wall = np.stack([WALL * np.cos(angle), WALL * np.sin(angle), height], 1)
    lines = []
    for i, center in enumerate(cameras.centers):
        way = wall - center
        nearest = np.clip(-(way @ center) / (way**2).sum(1), 0, 1)
        free = (np.linalg.norm(center + nearest[:, None] * way, axis=1) > RADIUS) & (wall @ center < 0)
        lines.append(np.flatnonzero(free & cameras.in_frame(i, wall)))
    point = np.concatenate(lines)
    photo = np.repeat(np.arange(len(cameras)), [len(line) for line in lines])
    order = np.argsort(point, kind="stable")
    starts = np.concatenate([ball.starts, len(ball.photos) + np.searchsorted(point[order], np.arange(1, 6001))])
    return PointCloud(
        np.concatenate([ball.points, wall]).astype(np.float32), np.zeros((6500, 3), np.float32),
        np.zeros((6500, 3), np.uint8), np.ones(6500, np.float32), starts,
        np.concatenate([ball.photos, photo[order]]),
    )  # fmt: skip


def balls(cameras: PinholeCameras) -> list[np.ndarray]:
    return [render(cameras, i)[1] for i in range(len(cameras))]


def widened(mask: np.ndarray, pixels: int) -> np.ndarray:
    brush = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * abs(pixels) + 1,) * 2)
    return (cv2.dilate if pixels > 0 else cv2.erode)(mask, brush)


def errors(cameras: PinholeCameras, masks: list[np.ndarray]):
    return outline_errors(cameras, [mask_depth(mask) for mask in masks], with_background(cameras))


def test_depth_in_a_mask_counts_pixels_from_its_outline():
    mask = np.zeros((7, 9), np.uint8)
    mask[:, 4:] = 255
    assert mask_depth(mask)[3].tolist() == [-3.5, -2.5, -1.5, -0.5, 0.5, 1.5, 2.5, 3.5, 4.5]
    assert mask_depth(np.ones((4, 5), np.uint8)).min() > 5  # the frame is no outline


def test_true_outlines_are_off_by_a_pixel_of_their_own():
    found = errors(cameras(), balls(cameras()))
    assert found.outer.max() < 2.5
    assert found.inner.max() < 2.5


@pytest.mark.parametrize("pixels", [-2, 2])
def test_outlines_that_all_are_too_narrow_or_too_wide_are_told(pixels):
    found = errors(cameras(), [widened(mask, pixels) for mask in balls(cameras())])
    told = found.outer if pixels < 0 else found.inner
    assert 2 < np.median(told) < 4.5


def test_one_mask_in_five_that_is_shifted_white_or_black_says_less_and_the_others_no_less():
    views = cameras()
    good = np.arange(len(views)) % 5 != 0
    for spoil in (lambda m: np.roll(m, 10, axis=1), np.ones_like, np.zeros_like):
        masks = [mask if fine else spoil(mask) for mask, fine in zip(balls(views), good, strict=True)]
        found = errors(views, masks)
        assert found.outer[good].max() < 3
        assert found.inner[good].max() < 5
        spoilt = ~good
        if spoil is np.ones_like:
            assert np.isinf(found.inner[spoilt]).all()
        elif spoil is np.zeros_like:
            assert found.outer[spoilt].min() > 20
        else:
            assert min(found.outer[spoilt].min(), found.inner[spoilt].min()) > 5


def test_without_points_an_outline_may_be_off_by_a_few_pixels_and_photos_without_one_say_nothing():
    views = cameras()
    depths = [mask_depth(mask) if i else None for i, mask in enumerate(balls(views))]
    found = outline_errors(views, depths, PointCloud.empty())
    assert np.isinf([found.outer[0], found.inner[0]]).all()
    assert set(found.outer[1:]) == set(found.inner[1:]) == {UNKNOWN}


def test_the_object_may_be_where_its_outlines_meet_with_their_error_around_them():
    views = cameras()
    depths = [mask_depth(mask) for mask in balls(views)]
    space = object_space(views, depths, np.full(len(views), PIXEL), 64)
    centers = (np.indices(space.shape).reshape(3, -1).T + 0.5) * (2 / 64) - 1
    away = np.linalg.norm(centers, axis=1).reshape(space.shape)
    assert space[away < RADIUS].all()
    assert not space[(away > 1.45 * RADIUS)].any()
    # one mask that shows nothing there does not cut it
    depths[3] = mask_depth(np.zeros_like(balls(views)[3]))
    assert object_space(views, depths, np.full(len(views), PIXEL), 64)[away < RADIUS].all()


def lines_of(masks: list[np.ndarray] | None = None) -> Silhouettes:
    views = cameras()
    return Silhouettes.from_masks(views, masks or balls(views), with_background(views), "cpu")


def ball_sdf(radius: float):
    return lambda places: torch.linalg.vector_norm(places, dim=-1) - radius


def loss_of(silhouettes: Silhouettes, radius: float) -> float:
    drawn = silhouettes.draw(512, 0.01, ball_sdf(radius), torch.Generator().manual_seed(0))
    assert drawn.known.float().mean() > 0.9
    return float(outline_loss(ball_sdf(radius)(drawn.places), drawn.known, 0.0025))


def test_the_true_ball_is_free_before_and_met_within_and_others_are_not():
    silhouettes = lines_of()
    assert loss_of(silhouettes, RADIUS) < 2e-4
    assert loss_of(silhouettes, 0.7 * RADIUS) > 0.003
    assert loss_of(silhouettes, 1.6 * RADIUS) > 0.01


def test_a_thin_shell_is_found_on_the_lines():
    """Where a hollow thing's wall is met, nothing is asked for in its hollow."""
    silhouettes = lines_of()

    def shell(places):
        return (torch.linalg.vector_norm(places, dim=-1) - RADIUS + 0.02).abs() - 0.02

    drawn = silhouettes.draw(512, 0.01, shell, torch.Generator().manual_seed(0))
    assert outline_loss(shell(drawn.places), drawn.known, 0.0025) < 5e-4


def test_what_is_before_the_object_is_pushed_away_and_what_is_missing_pulled_in():
    known = torch.tensor([True, False])
    sdf = torch.full((6,), 0.3, requires_grad=True)
    loss = outline_loss(sdf, known, 0.1)
    assert loss.item() == pytest.approx(0.3 / 2)  # free; but nothing within on the first line
    loss.backward()
    assert sdf.grad is not None
    assert sdf.grad.tolist() == [0, 0, 0, 0, 0.5, 0]
    solid = torch.full((6,), -0.3, requires_grad=True)
    outline_loss(solid, known, 0.1).backward()
    assert solid.grad is not None
    assert solid.grad.tolist() == [-0.5, 0, -0.5, 0, 0, 0]


@pytest.mark.slow
def test_outlines_shrink_what_is_too_large():
    """The term reaches the shape: with nothing else to say where the ball ends, f grows before its outlines."""
    views = ring_of_cameras()
    silhouettes = Silhouettes.from_masks(views, balls(views), PointCloud.empty(), "cpu")

    def after(weight: float) -> tuple[float, float]:
        settings = {"losses.silhouette": weight, "losses.dense": 0.0, "losses.sparse": 0.0, "field.sphere_radius": 0.9}
        trainer = make_trainer(changed(TINY, settings))
        trainer.silhouettes = silhouettes
        losses = [float(trainer.step(i / 120)["silhouette"]) for i in range(60)]
        drawn = silhouettes.draw(256, 0.01, trainer.cache.lookup, torch.Generator().manual_seed(0))
        with torch.no_grad():
            return losses[0], float(trainer.fields.sdf.sdf(drawn.places, 4)[:512].mean())

    (first, pushed), (_, left) = after(3.0), after(0.0)
    assert first > 0.05
    assert pushed > left + 0.1


@pytest.mark.slow
def test_training_starts_from_the_outlines_where_it_is_told_to():
    views = ring_of_cameras()
    trainer = make_trainer(changed(TINY, {"field.sphere_radius": 0.8, "field.init": "hull"}))
    trainer.silhouettes = Silhouettes.from_masks(views, balls(views), PointCloud.empty(), "cpu")
    train._start_from_shape(trainer, views)
    ways = torch.nn.functional.normalize(torch.randn(200, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    with torch.no_grad():
        levels = trainer.moment(0.0).levels
        assert trainer.fields.sdf.sdf((RADIUS - 0.1) * ways, levels).max() < 0
        # the outlines are believed to 6 pixels, half of the ball's radius
        assert trainer.fields.sdf.sdf(0.95 * ways, levels).median() > 0.1


def test_photos_without_masks_have_no_lines():
    silhouettes = Silhouettes.from_masks(cameras(), [None] * 24, PointCloud.empty(), "cpu")
    drawn = silhouettes.draw(128, 0.01, ball_sdf(RADIUS), torch.Generator())
    assert len(silhouettes) == len(drawn.places) == len(drawn.known) == 0
    assert outline_loss(drawn.places[:, 0], drawn.known, 0.1) == 0
