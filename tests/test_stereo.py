"""Dense stereo: pairs, rectification, depths and how far they are trusted, against closed forms and slow loops."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter
from stereo_scene import around, camera, cameras, draw, first_hit, ring

from stages.geometry.cameras import PinholeCameras
from stages.stereo import depth_kernels
from stages.stereo.depths import _along, depth_maps, views_of
from stages.stereo.matching import evened
from stages.stereo.pairs import pairs_of, scores
from stages.stereo.rectification import View, comparable, rectify, tolerance_of
from stages.stereo.trust import _trust, normals_at, places, trust_of


def pair(rng: np.random.Generator) -> tuple[View, View, np.ndarray]:
    """Two photos of different sizes, focal lengths and roll, and points before both."""
    points = rng.normal(scale=0.3, size=(60, 3))
    azimuths = rng.uniform(0, 360) + np.array([0, rng.uniform(5, 25)])
    extrinsics = [camera(center, roll_deg=rng.uniform(-180, 180)) for center in around(azimuths, rng.uniform(2, 3))]
    sizes = [(160, 120), (110, 150)]
    left, right = views_of(cameras(extrinsics, sizes, list(rng.uniform(120, 220, 2))), 1000)
    return left, right, points


def project(view: View, points: np.ndarray) -> np.ndarray:
    in_camera = (points - view.center) @ view.rotation.T
    return (in_camera / in_camera[:, 2:]) @ view.matrix.T


@pytest.mark.parametrize("seed", range(10))
def test_a_point_lies_in_one_row_and_as_far_left_as_its_disparity(seed: int):
    left, right, points = pair(np.random.default_rng(seed))
    plane = rectify(left, right, points)
    assert plane is not None
    turned = []
    for view, is_right in ((left, False), (right, True)):
        there = project(view, points) @ np.linalg.inv(plane.homography(view, is_right)).T
        turned.append(there[:, :2] / there[:, 2:])
    z = ((points - left.center) @ plane.turn.T)[:, 2]
    disparity = plane.focal * plane.base / z + plane.shift
    np.testing.assert_allclose(turned[0][:, 1], turned[1][:, 1], atol=1e-6)
    np.testing.assert_allclose(turned[0][:, 0] - turned[1][:, 0], disparity, atol=1e-6)
    assert (disparity > plane.least).all()
    assert (disparity < plane.least + plane.count).all()
    # what both photos hold, the window holds
    both = np.ones(len(points), bool)
    for view in (left, right):
        at = project(view, points)[:, :2]
        both &= ((at > 0) & (at < view.size)).all(1)
    assert both.sum() > 5
    assert (turned[0][both] > -1).all()
    assert (turned[0][both] < np.array(plane.size) + 1).all()


def test_the_range_of_disparities_is_bounded_by_a_smaller_size():
    left, right, points = pair(np.random.default_rng(0))
    large = [
        View(np.diag([20, 20, 1]) @ v.matrix, v.rotation, v.center, (20 * v.size[0], 20 * v.size[1]))
        for v in (left, right)
    ]
    plane = rectify(*large, points)
    assert plane is not None
    assert plane.count <= 400
    assert np.prod(plane.size) <= 2.1 * np.prod(large[0].size)


def test_photos_that_cannot_be_turned_onto_one_plane():
    center = np.array([2.5, 0, 0.3])
    here, points = view_at(center), np.random.default_rng(0).normal(scale=0.3, size=(50, 3))
    assert comparable(here, view_at(np.array([2.5, 0.4, 0.3])))
    for other in (-center, 0.6 * center, center):  # from behind, further on, the same place
        assert not comparable(here, view_at(other))
        assert rectify(here, view_at(other), points) is None
    aside = view_at(np.array([2.5, 0.4, 0.3]))
    assert rectify(here, aside, points) is not None
    assert rectify(here, aside, points[:3]) is None
    assert rectify(here, aside, 10 * center + points) is None  # known points behind both
    away = View(aside.matrix, view_at(aside.center, np.array([3.0, 9, 0])).rotation, aside.center, aside.size)
    assert rectify(here, away, points) is None


def view_at(center: np.ndarray, target: np.ndarray | None = None) -> View:
    return views_of(cameras([camera(center, target)], [(160, 120)], [190.0]), 1000)[0]


def test_views_are_never_enlarged_and_keep_their_shape():
    cams = cameras([camera(center) for center in around(np.array([0, 9]))], [(160, 120), (60, 90)], [190.0, 80.0])
    small, same = views_of(cams, 100)
    assert small.size == (100, 75)
    assert same.size == (60, 90)
    points = np.random.default_rng(0).normal(scale=0.2, size=(20, 3))
    np.testing.assert_allclose(project(small, points)[:, :2], cams.project(0, points)[0] * 100 / 160, rtol=1e-9)


# ---------------------------------------------------------------- pairs
def test_scores_against_a_loop():
    cams = cameras([camera(c) for c in around(np.array([0, 10, 35, 180]))], [(160, 120)] * 4, [190.0, 380, 190, 190])
    views, rng = views_of(cams, 1000), np.random.default_rng(0)
    points = rng.normal(scale=0.3, size=(40, 3))
    seen = rng.uniform(size=(4, 40)) < 0.7
    found = scores(views, points, np.argwhere(seen))
    for i in range(4):
        for j in range(4):
            expected = 0.0
            for p in np.flatnonzero(seen[i] & seen[j]):
                a, b = points[p] - views[i].center, points[p] - views[j].center
                angle = np.degrees(np.arccos(min(a @ b / np.linalg.norm(a) / np.linalg.norm(b), 1)))
                r = (np.linalg.norm(a) / views[i].focal) / (np.linalg.norm(b) / views[j].focal)
                if 0.5 < angle < 60:
                    expected += min(r, 1 / r) * np.exp(-((angle - 10) ** 2) / (2 * (5 if angle < 10 else 10) ** 2))
            same = i == j or not comparable(views[i], views[j])
            assert found[i, j] == pytest.approx(0.0 if same else expected, rel=1e-9), (i, j)
    assert scores(views, points[:7], np.argwhere(seen[:, :7])).max() == 0  # too few shared


def test_frames_of_a_video_are_compared_with_others_apart():
    cams = cameras([camera(c) for c in around(np.arange(0, 40, 0.5))], [(160, 120)] * 80, [190.0] * 80)
    points = np.random.default_rng(0).normal(scale=0.3, size=(50, 3))
    pairs = pairs_of(views_of(cams, 1000), points, np.argwhere(np.ones((80, 50), bool)), 4)
    of_middle = sorted(0.5 * (j + i - 80) for i, j in pairs if 40 in (i, j))
    assert of_middle[0] <= -8  # to either side, at about ten degrees
    assert of_middle[-1] >= 8
    assert np.abs(of_middle).min() > 4
    assert max(of_middle[-1], -of_middle[0]) - 8 > 3  # and not four times the same


def test_a_neighbor_that_cannot_be_rectified_leaves_its_place_to_the_next():
    """Beside a photo of 75 degrees: two further on, 28 degrees off its axis, which suit best; four to its sides."""
    back, aside = np.array([1.0, 0, 0]), np.array([0, 1.0, 0])
    centers = [2.5 * back] + [2.5 * back - 0.5 * back + side * 0.4 * aside for side in (-1, 1)]
    centers += [2.5 * back + side * aside for side in (-1.2, -0.9, 0.9, 1.2)]
    views = views_of(cameras([camera(c) for c in centers], [(300, 200)] * 7, [200.0] * 7), 1000)
    points = np.random.default_rng(0).normal(scale=0.3, size=(50, 3))
    seen = np.argwhere(np.ones((7, 50), bool))
    suited = scores(views, points, seen)[0]
    assert set(suited.argsort()[-2:]) == {1, 2}
    assert comparable(views[0], views[1])
    assert rectify(views[0], views[1], points) is None
    pairs = pairs_of(views, points, seen, 2)
    assert len([pair for pair in pairs if 0 in pair]) >= 2
    assert not {(0, 1), (0, 2)} & set(pairs)


# ---------------------------------------------------------------- the compiled loops
def test_seen_from_right_against_a_loop():
    rng = np.random.default_rng(0)
    left = np.full((3, 40), np.nan, np.float32)
    left[:, 5:20], left[:, 20:36] = 2, -3
    left[1, rng.integers(0, 40, 8)] = np.nan
    expected = np.full((3, 40), np.nan)
    for y in range(3):
        for x in range(40):
            if not np.isnan(left[y, x]) and 0 <= x - left[y, x] < 40:
                at = int(x - left[y, x])
                expected[y, at] = np.nanmax([expected[y, at], left[y, x]])
    found = depth_kernels.seen_from_right(left)
    known = ~np.isnan(expected)
    np.testing.assert_array_equal(found[known], expected[known])
    # between its neighbours, no more than the gap of a pixel
    assert np.isnan(found[:, 22]).all()
    slope = np.float32(0.25) * np.arange(40, dtype=np.float32)[None]
    across = depth_kernels.seen_from_right(slope)[0]
    np.testing.assert_allclose(across[2:20], np.arange(2, 20) / 3, atol=1e-5)  # d = x / 4 lands at 3 x / 4


def test_agreed_against_a_loop():
    rng = np.random.default_rng(0)
    maps = (2 * (1 + 0.004 * rng.integers(-2, 3, (5, 6, 7)))).astype(np.float32)
    maps[rng.uniform(size=maps.shape) < 0.4] = 0
    needed = np.array([2, 2, 2, 2, 3, 3])
    found = np.zeros((6, 7), np.float32)
    depth_kernels.agreed(maps, 0.005, needed, found)
    some = 0
    for v in range(6):
        for u in range(7):
            known = maps[:, v, u][maps[:, v, u] > 0]
            groups = [known[np.abs(known - each) <= 0.005 * each] for each in known]
            best = max(groups, key=len, default=known)
            expected = best.mean() if len(best) >= needed[len(known)] and len(known) else 0
            some += expected > 0
            assert found[v, u] == pytest.approx(expected, rel=1e-6), (v, u)
    assert 5 < some < 42


def test_normals_of_a_ball():
    cams = ring(1)
    view = views_of(cams, 1000)[0]
    depth = draw(cams).depths[0].astype(np.float32)
    v, u = (each.ravel() for each in np.mgrid[40:80:5, 60:100:5])
    hit = first_hit(cams, 0, np.stack([u + 0.5, v + 0.5], 1))
    found = normals_at(view, depth, v, u)
    on_ball = np.abs(np.linalg.norm(hit, axis=1) - 0.5) < 1e-9
    assert on_ball.sum() > 30
    assert ((found * hit / 0.5).sum(1)[on_ball] > 0.995).all()
    lonely = np.where(np.arange(depth.size).reshape(depth.shape) % 5 == 0, depth, 0)
    assert (normals_at(view, lonely * (np.arange(120) % 5 == 0)[:, None], v, u) == 0).all()


def test_votes_against_a_loop():
    cams = ring(6, step_deg=14)
    drawn, rng = draw(cams), np.random.default_rng(0)
    depths = [
        np.where(rng.uniform(size=d.shape) < 0.7, d * rng.choice([0.9, 1, 1.005, 1.1], d.shape), 0)
        for d in drawn.depths
    ]
    points = drawn.scene.points[::4].astype(float)
    normals = np.where(
        rng.uniform(size=(len(points), 1)) < 0.5, points / np.linalg.norm(points, axis=1, keepdims=True), 0
    )
    known = [rng.choice(np.uint8([0, 0, 1, 2]), d.shape) for d in depths]
    found = np.zeros((len(points), 5), np.float32)
    flat = np.stack(depths).astype(np.float32).ravel()
    depth_kernels.votes(
        cams.centers[0], np.arange(1, 6), points, normals.astype(np.float32), cams.intrinsics @ cams.extrinsics,
        cams.centers, cams.sizes, 160 * 120 * np.arange(7), flat, np.stack(known).ravel(), np.full(6, 0.01), found,
    )  # fmt: skip
    for k, point in enumerate(points):
        expected = np.zeros(5)
        for j in range(1, 6):
            to_j, to_own = cams.centers[j] - point, cams.centers[0] - point
            to_j, to_own = to_j / np.linalg.norm(to_j), to_own / np.linalg.norm(to_own)
            behind = normals[k].any() and normals[k] @ to_j < 0.2
            if to_j @ to_own < 0.5 or behind or not cams.in_frame(j, point[None])[0]:
                continue
            pixel, z = cams.project(j, point[None])
            u, v = np.floor(pixel[0]).astype(int)
            d = depths[j][v, u]
            if 0 < d < 0.99 * z[0] and known[j][v, u]:
                continue
            apart = (d / z[0] - 1) / 0.01
            near = abs(apart) <= 1
            expected += [1, near, apart > 1, near * apart**2, near and known[j][v, u] == 2]
        np.testing.assert_allclose(found[k], expected, atol=1e-3)
    assert (found.sum(0) > 5).all()


# ---------------------------------------------------------------- depths and trust
@pytest.fixture(scope="module")
def measured():
    drawn = draw(ring())
    views = views_of(drawn.scene.cameras, 1000)
    return drawn, views, _depths(drawn, views)


def _depths(drawn, views, workers=1, greys=None):
    observations = drawn.scene.observations
    seen = [drawn.scene.points[observations[observations[:, 0] == k, 1]] for k in range(len(views))]
    pairs = pairs_of(views, drawn.scene.points, observations, 4)
    greys = [photo[..., 0].copy() for photo in drawn.photos] if greys is None else greys
    return depth_maps(views, greys, pairs, seen, workers, lambda done: None)


def _errors(drawn, depths) -> tuple[float, float]:
    """Median relative error of the depths, and the share of pixels that have one."""
    known = [depth > 0 for depth in depths]
    wrong = [np.abs(d - t)[k] / t[k] for d, t, k in zip(depths, drawn.depths, known, strict=True) if k.any()]
    return float(np.median(np.concatenate(wrong))), float(np.mean([k.mean() for k in known]))


def test_depths_of_a_ball_on_a_floor(measured):
    drawn, _, depths = measured
    error, covered = _errors(drawn, depths)
    assert error < 0.003
    assert covered > 0.5


def test_depths_from_photos_turned_and_of_two_sizes():
    centers = around(9.0 * np.arange(8), elevation_deg=25.0)
    sizes = [(160, 120), (120, 160), (160, 120), (240, 180)] * 2
    focals = [190.0, 190, 190, 285] * 2
    cams = cameras([camera(c, roll_deg=90.0 * (k % 4 == 1)) for k, c in enumerate(centers)], sizes, focals)
    drawn = draw(cams)
    error, covered = _errors(drawn, _depths(drawn, views_of(cams, 1000)))
    assert error < 0.003
    assert covered > 0.4


def test_workers_change_nothing(measured):
    drawn, views, depths = measured
    for one, two in zip(depths, _depths(drawn, views, workers=2), strict=True):
        np.testing.assert_array_equal(one, two)


def test_few_pairs_are_held_at_a_time_whatever_the_photos_are_called():
    rng = np.random.default_rng(0)
    named = rng.permutation(60)  # around the object, each compared with two to either side
    pairs = [tuple(sorted(named[[k, (k + step) % 60]].tolist())) for k in range(60) for step in (1, 2)]

    def most(order: np.ndarray) -> int:
        turn = np.argsort(order)
        starts, ends = np.sort(turn[np.array(pairs)], 1).T
        return max(int(((starts <= now) & (now <= ends)).sum()) for now in range(60))

    order = _along(pairs, 60)
    assert sorted(order) == list(range(60))
    assert most(np.arange(60)) > 50
    assert most(order) <= 20
    assert sorted(_along([], 3)) == [0, 1, 2]


def test_depths_are_held_once_and_trusted_as_before(measured):
    _, views, depths = measured
    own = [depth.copy() for depth in depths]
    trust = trust_of(views, own)
    assert all(each.base is own[0].base for each in own)
    for mine, before in zip(own, depths, strict=True):
        np.testing.assert_array_equal(mine, before)
    assert [t.shape for t in trust] == [d.shape for d in depths]


def test_a_surface_on_which_all_agree_is_trusted_and_one_that_moves_with_the_view_is_not():
    cams = ring()
    views, true = views_of(cams, 1000), [depth.astype(np.float32) for depth in draw(cams).depths]
    trust = trust_of(views, true)
    assert np.median(np.concatenate([t[d > 0] for t, d in zip(trust, true, strict=True)])) > 0.95
    # like a reflection: neighbours agree on it, those further aside do not
    assert 0.03 < 2 * tolerance_of(views[0]) < 0.06
    moving = [depth * np.float32(1 + 0.03 * k) for k, depth in enumerate(true)]
    trust = trust_of(views, moving)
    assert np.median(np.concatenate([t[d > 0] for t, d in zip(trust, moving, strict=True)])) < 0.2


def test_what_all_find_but_less_exactly_than_the_rest_is_not_trusted(monkeypatch):
    """Like a small convex mirror: what is seen in it lies, from everywhere, at nearly the same place behind it."""
    cams = ring()
    views, rng = views_of(cams, 1000), np.random.default_rng(0)
    tolerance = 2 * tolerance_of(views[0])
    true = [depth.astype(np.float32) for depth in draw(cams).depths]
    depths = [depth * (1 + 0.15 * tolerance * rng.standard_normal(depth.shape)).astype(np.float32) for depth in true]
    mirrors = [first_hit(cams, k, _pixels(views[k]))[:, 2].reshape(d.shape) > 0.2 for k, d in enumerate(true)]
    offset = 0.6 * tolerance * rng.permutation(np.linspace(-1, 1, len(true)))
    moving = [
        np.where(mirror, depth * np.float32(1 + shift), depth)
        for mirror, depth, shift in zip(mirrors, depths, offset, strict=True)
    ]

    def trusts(depths: list[np.ndarray]) -> tuple[float, float]:
        """Mean trust on the mirror, and elsewhere."""
        trust = trust_of(views, [depth.copy() for depth in depths])
        return tuple(
            float(np.concatenate([t[(d > 0) & (m == on)] for t, d, m in zip(trust, true, mirrors, strict=True)]).mean())
            for on in (True, False)
        )

    on_ball, elsewhere = trusts(depths)
    on_mirror, beside = trusts(moving)
    assert on_ball > 0.85
    assert on_mirror < 0.3 * on_ball
    assert beside > 0.95 * elsewhere
    with monkeypatch.context() as patch:
        patch.setattr("stages.stereo.trust.SCATTER", (98.0, 99.0))
        on_mirror_alone, _ = trusts(moving)
    assert on_mirror_alone > 0.7 * on_ball  # they do agree
    # nothing is unusual where photos are as inexact everywhere: poses, say, that are a little off
    everywhere = [depth * np.float32(1 + shift) for depth, shift in zip(depths, offset, strict=True)]
    assert min(trusts(everywhere)) > 0.85 * on_mirror_alone


@pytest.mark.parametrize("count", [2, 3, 12])
def test_noise_that_is_the_same_everywhere_costs_no_trust_however_few_photos_there_are(count, monkeypatch):
    """With two photos one is asked, and chance alone makes it twice as far off as usual over a whole window."""
    cams = cameras([camera(center) for center in around(5.0 * np.arange(count))], [(160, 120)] * count, [190.0] * count)
    views, rng = views_of(cams, 1000), np.random.default_rng(1)
    noises = [gaussian_filter(rng.standard_normal((120, 160)), 10) for _ in range(count)]  # over 5 cells of votes
    spread = 0.15 * 2 * tolerance_of(views[0])
    depths = [
        (depth * (1 + spread * noise / noise.std())).astype(np.float32)
        for depth, noise in zip(draw(cams).depths, noises, strict=True)
    ]

    def mean_trust() -> float:
        trust = trust_of(views, [depth.copy() for depth in depths])
        return float(np.concatenate([t[d > 0] for t, d in zip(trust, depths, strict=True)]).mean())

    noisy = mean_trust()
    monkeypatch.setattr("stages.stereo.trust.SCATTER", (98.0, 99.0))
    assert 0.95 * mean_trust() < noisy < mean_trust()


def test_what_most_that_agree_find_inexactly_is_not_trusted():
    def trust(doubted: int, apart: float = 0.04) -> float:
        counts = np.zeros((20, 20, 5), np.float32)
        counts[:] = 10, 8, 0, 8 * apart, doubted
        return float(_trust(counts, 0.2)[0][10, 10])

    assert trust(0) == 1
    assert trust(2) == 1
    assert 0.3 < trust(3) < 0.7
    assert trust(5) == pytest.approx(0, abs=1e-6)
    assert trust(0, apart=0.04 * 1.59**2) == 1
    assert trust(0, apart=0.04 * 1.83**2) == pytest.approx(0, abs=1e-3)


def _pixels(view: View) -> np.ndarray:
    """Centres [h * w, 2] of a photo's pixels."""
    v, u = np.mgrid[: view.size[1], : view.size[0]]
    return np.stack([u.ravel() + 0.5, v.ravel() + 0.5], 1)


def test_what_is_known_in_front_excuses_and_what_is_not_does_not():
    """A plate hides the floor's middle from half of the photos; they say nothing of it if the plate is known."""
    cams = ring()
    views, true = views_of(cams, 1000), [depth.astype(np.float32) for depth in draw(cams).depths]
    point = first_hit(cams, 0, np.array([[80.5, 100.5]]))
    assert point[0, 2] == pytest.approx(-0.5)

    def votes(in_front: float, known: bool) -> list[float]:
        depths = [true[0]] + [np.full_like(d, in_front * cams.project(k, point)[1][0]) for k, d in enumerate(true) if k]
        found = np.zeros((1, 5), np.float32)
        matrices = np.stack([v.matrix @ np.c_[v.rotation, -v.rotation @ v.center] for v in views])
        flat = np.concatenate([d.ravel() for d in depths])
        depth_kernels.votes(
            views[0].center, np.arange(1, 5), point, np.zeros((1, 3), np.float32), matrices, cams.centers, cams.sizes,
            160 * 120 * np.arange(13), flat, np.full(len(flat), known, np.uint8), np.full(12, 0.01), found,
        )  # fmt: skip
        return found[0, :3].tolist()

    assert votes(0.8, True) == [0, 0, 0]
    assert votes(0.8, False) == [4, 0, 0]
    assert votes(1.0, False) == [4, 4, 0]
    assert votes(1.2, True) == [4, 0, 4]  # seen through, known or not


def test_photos_without_any_depth_are_not_asked():
    cams = ring(4)
    views, true = views_of(cams, 1000), [depth.astype(np.float32) for depth in draw(cams).depths]
    alone = trust_of(views[:3], true[:3])
    with_blind = trust_of(views, [*true[:3], np.zeros_like(true[3])])
    for a, b in zip(alone, with_blind, strict=False):
        np.testing.assert_array_equal(a, b)


def test_small_photos_agree_within_more():
    large, small = (
        views_of(cameras([camera(np.array([2.5, 0, 1]))], [(160, 120)], [f]), 1000)[0] for f in (900.0, 100.0)
    )
    assert tolerance_of(large) == 0.004
    assert tolerance_of(small) == pytest.approx(0.6 / (100 * np.tan(np.radians(10))))


def test_an_exposure_that_jumps_is_evened():
    rng = np.random.default_rng(0)
    photo = rng.uniform(20, 120, (60, 80)).astype(np.uint8)
    darker = np.uint8(0.5 * photo + 3)
    darker[:, :9] = 0
    same, brighter = evened(photo, darker)
    assert same is photo
    assert np.abs(brighter[:, 9:].astype(int) - photo[:, 9:]).max() <= 2
    assert (brighter[:, :9] == 0).all()
    back, same = evened(darker, photo)
    assert same is photo
    np.testing.assert_array_equal(back, brighter)
    flat = np.full((60, 80), 9, np.uint8)
    assert evened(flat, photo)[0] is flat


def test_places_lie_on_what_the_pixels_show():
    cams = ring(1)
    v, u = np.array([60, 100]), np.array([80, 20])
    found = places(views_of(cams, 1000)[0], draw(cams).depths[0], v, u)
    np.testing.assert_allclose(found, first_hit(cams, 0, np.stack([u + 0.5, v + 0.5], 1)), atol=1e-9)


def test_no_photos_in_common_give_no_pairs():
    cams: PinholeCameras = ring(3)
    drawn = draw(cams)
    lonely = replace(drawn.scene, observations=drawn.scene.observations[:3])
    assert pairs_of(views_of(cams, 1000), lonely.points, lonely.observations, 4) == []
