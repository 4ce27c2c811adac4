"""The last adjustment: lenses that mapping has not found come out, those it has stay, and errors are as expected."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from configs.params import SfmParams
from stages.artifacts import Registration
from stages.geometry.place import Place
from stages.geometry.similarity import Similarity, align_points
from stages.posing import adjustment
from stages.posing.adjustment import (
    K2,
    KEPT_VIEWS,
    PRINCIPAL_POINT,
    adjust_last,
    bundle_adjust,
    distortion_grows,
    hold_out,
    refuse_by_errors,
    refuse_by_lens,
)
from stages.posing.precision import estimate_precision, free_parameters, observations_of
from stages.reporting.poses import describe_poses

WIDTH, HEIGHT, FOCAL, NOISE_PX = 1024, 768, 900.0, 0.25
SHIFT = np.array([80.0, -50.0])


def capture(shift=(0.0, 0.0), k=(0.05,), photos=12, points=400, cameras=1, noise=NOISE_PX, seed=1):
    """A pycolmap model whose cameras are true, and whose features have noise.

    Args:
        shift: of the first camera's principal point, pixels. k: radial terms of all, one or two.
        cameras: which take turns in the photos of a capture (so many rigs).
    """
    import pycolmap

    pycolmap.set_random_seed(seed)
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = cameras, 1, photos
    options.num_points3D, options.num_points2D_without_point3D, options.track_length = points, 0, min(photos, 8)
    options.camera_width, options.camera_height = WIDTH, HEIGHT
    options.camera_model_id = pycolmap.CameraModelId.RADIAL if len(k) == 2 else pycolmap.CameraModelId.SIMPLE_RADIAL
    options.camera_params = [FOCAL, WIDTH / 2, HEIGHT / 2, *k]
    model = pycolmap.synthesize_dataset(options)
    move_center(model.cameras[min(model.cameras)], shift)
    draw = np.random.default_rng(seed)
    for image_id in sorted(model.reg_image_ids()):
        image = model.images[image_id]
        for feature in filter(lambda feature: feature.has_point3D(), image.points2D):
            place = image.cam_from_world() * model.points3D[feature.point3D_id].xyz
            feature.xy = model.cameras[image.camera_id].img_from_cam(place[None])[0] + draw.normal(0, noise, 2)
    return model


def move_center(camera, shift) -> None:
    params = np.array(camera.params)
    params[camera.principal_point_idxs()] += shift
    camera.params = params


def mapped(truth):
    """The model as mapping leaves it: the principal point in the middle, one radial term, all else adjusted."""
    import pycolmap

    model = pycolmap.Reconstruction(truth)
    for camera in model.cameras.values():
        params = [FOCAL, WIDTH / 2, HEIGHT / 2, camera.params[camera.extra_params_idxs()[0]]]
        camera.model, camera.params = pycolmap.CameraModelId.SIMPLE_RADIAL, params
    return bundle_adjust(model, dict.fromkeys(model.cameras, frozenset()), 1)


def center_error(model, truth) -> float:
    """Median distance of the centres after alignment."""
    ids = sorted(truth.reg_image_ids())
    found, true = (np.array([each.images[i].projection_center() for i in ids]) for each in (model, truth))
    return float(np.median(np.linalg.norm(align_points(found, true).apply(found) - true, axis=1)))


# ---------------------------------------------------------------- what is freed
def test_a_principal_point_off_the_middle_is_found_and_makes_poses_better():
    truth = capture(SHIFT)
    model = mapped(truth)
    last = adjust_last(model, SfmParams(), 1)
    (lens,) = last.lenses
    assert lens.freed == (PRINCIPAL_POINT,)
    found = np.array([lens.params["cx"] - WIDTH / 2, lens.params["cy"] - HEIGHT / 2])
    errors = np.array([lens.standard_errors["cx"], lens.standard_errors["cy"]])
    assert (np.abs(found - SHIFT) < 4 * errors).all()
    assert (errors < 2).all()
    before, after = center_error(model, truth), center_error(last.model, truth)
    assert after < before / 3
    assert last.pose_error.residual_px == pytest.approx(NOISE_PX, rel=0.1)
    assert after == pytest.approx(last.pose_error.center, rel=0.5)
    assert model.cameras[1].principal_point_x == WIDTH / 2  # what was given stays as it is


def test_a_principal_point_in_the_middle_stays_there():
    model = mapped(capture())
    last = adjust_last(model, SfmParams(), 1)
    assert last.model is model
    (lens,) = last.lenses
    assert lens.freed == ()
    assert [trial.freedom for trial in lens.trials] == [PRINCIPAL_POINT, K2]
    assert all(trial.refused for trial in lens.trials)


def test_a_second_radial_term_is_found():
    truth = capture(k=(-0.8, 3.0), noise=0.1)  # the points are near the middle of the frames
    model = mapped(truth)
    last = adjust_last(model, SfmParams(), 1)
    (lens,) = last.lenses
    assert lens.freed == (K2,)
    assert lens.model == "RADIAL"
    assert lens.params["k2"] == pytest.approx(3.0, abs=4 * lens.standard_errors["k2"])
    assert center_error(last.model, truth) < center_error(model, truth)


def test_each_camera_has_its_own():
    last = adjust_last(mapped(capture(SHIFT, cameras=2, photos=8)), SfmParams(), 1)
    first, second = last.lenses
    assert (first.freed, second.freed) == ((PRINCIPAL_POINT,), ())
    assert (second.params["cx"], second.params["cy"]) == (WIDTH / 2, HEIGHT / 2)


@pytest.mark.parametrize("few", [{"photos": 4}, {"points": 60}])
def test_with_few_photos_or_observations_nothing_is_freed(few):
    model = mapped(capture(SHIFT, **few))
    last = adjust_last(model, SfmParams(), 1)
    assert last.model is model
    assert last.lenses[0].trials == ()


def test_very_many_photos_keep_their_lens(monkeypatch, caplog):
    monkeypatch.setattr(adjustment, "MOST_PHOTOS", 11)
    model = mapped(capture(SHIFT))
    with caplog.at_level("INFO"):
        assert adjust_last(model, SfmParams(), 1).model is model
    assert "up to 11 photos" in caplog.text


def test_a_point_seen_once_leaves_the_others_their_errors():
    import pycolmap

    model = mapped(capture(points=100))
    free = {1: free_parameters(model.cameras[1], True)}
    whole = estimate_precision(model, free)
    point = next(iter(model.points3D.values()))
    element = point.track.elements[0]
    image = model.images[element.image_id]
    image.points2D.append(pycolmap.Point2D(image.points2D[element.point2D_idx].xy))
    model.add_point3D(point.xyz, pycolmap.Track([pycolmap.TrackElement(image.image_id, len(image.points2D) - 1)]))
    assert estimate_precision(model, free).centers == pytest.approx(whole.centers, rel=0.02)


def test_off_leaves_the_lens_and_still_tells_the_error():
    model = mapped(capture(SHIFT))
    last = adjust_last(model, SfmParams(refine_lens="off"), 1)
    assert last.model is model
    assert last.lenses[0].trials == ()
    assert last.pose_error is not None


def test_the_same_seed_gives_the_same_model():
    model = mapped(capture(SHIFT))
    first, second = (adjust_last(model, SfmParams(), 1) for _ in range(2))
    assert first.lenses == second.lenses
    assert (first.model.cameras[1].params == second.model.cameras[1].params).all()


# ---------------------------------------------------------------- how it is judged
def test_points_keep_their_views():
    seen = observations_of(capture(photos=5, points=100))
    out = hold_out(seen, 0)
    assert len(np.unique(out)) == len(out) == round(0.2 * len(seen.point))
    left = np.bincount(np.delete(seen.point, out), minlength=len(seen.points))
    assert left.min() >= KEPT_VIEWS
    assert (hold_out(seen, 0) == out).all()
    assert not np.array_equal(hold_out(seen, 1), out)


def test_a_gain_must_be_large_and_even():
    old, photo = np.ones(100), np.repeat(np.arange(10), 10)
    assert refuse_by_errors(old, old * 0.9, photo) == ""
    assert "0.00 %" in refuse_by_errors(old, old, photo)
    assert "+20.00 %" in refuse_by_errors(old, old * 1.2, photo)
    uneven = np.where(photo == 0, 0.1, 1.0)
    assert "-0.10 %" in refuse_by_errors(old, old * 0.999, photo)
    assert "1 of 10 photos" in refuse_by_errors(old, uneven, photo)


def test_an_implausible_lens_is_refused():
    before = mapped(capture(points=50)).cameras[1]
    good = {0: 1.0, 1: 1.0, 2: 1.0, 3: 0.01}

    def verdict(shift, errors=good, factor=1.0) -> str:
        after = mapped(capture(points=50)).cameras[1]
        move_center(after, shift)
        after.params = after.params * np.array([factor, 1, 1, 1])
        return refuse_by_lens(PRINCIPAL_POINT, before, after, errors)

    assert verdict(SHIFT) == ""
    assert "300 px off the middle" in verdict([300, 0])
    assert "within 5 standard errors" in verdict([3, 3])
    assert "standard error is 8.0 px" in verdict([100, 0], {**good, 2: 8.0})
    assert "factor of 1.40" in verdict(SHIFT, factor=1.4)
    assert "undetermined" in verdict(SHIFT, None)


def test_a_distortion_that_turns_back_within_the_frame_is_refused():
    import pycolmap

    def camera(k1: float, k2: float):
        return pycolmap.Camera(model="RADIAL", width=WIDTH, height=HEIGHT, params=[FOCAL, 512, 384, k1, k2])

    assert distortion_grows(camera(-0.3, 0.15))
    assert distortion_grows(camera(0.0, 0.0))
    assert not distortion_grows(camera(-0.9, 0.0))
    before, after = camera(-0.3, 0.0), camera(-0.9, -0.1)
    errors = dict.fromkeys(range(5), 0.01)
    assert "turns back" in refuse_by_lens(K2, before, after, errors)
    assert "zero within" in refuse_by_lens(K2, before, after, {**errors, 4: 0.1})


# ---------------------------------------------------------------- how exact it is
def test_the_covariance_is_that_of_the_whole_problem(monkeypatch):
    """With the pseudo-inverse of all unknowns at once, points included, in place of the Schur complement."""
    from stages.posing import precision

    model = mapped(capture(photos=5, points=60))
    free = {1: free_parameters(model.cameras[1], True)}
    parts = []

    def caught(by_camera, by_point):
        parts.append(np.concatenate([by_camera.todense(), by_point.todense()], 1))
        return precision_without(by_camera, by_point)

    precision_without = precision._without_points
    monkeypatch.setattr(precision, "_without_points", caught)
    found = estimate_precision(model, free)
    (jacobian,) = parts
    whole = np.linalg.pinv(np.asarray(jacobian), rcond=1e-9)
    covariance = found.residual_px**2 * whole @ whole.T
    assert list(found.intrinsics[1].values()) == pytest.approx(np.sqrt(np.diag(covariance)[30:34]).tolist(), rel=1e-3)
    back = [model.images[i].cam_from_world().rotation.matrix().T for i in sorted(model.reg_image_ids())]
    draws = np.random.default_rng(0).multivariate_normal(np.zeros(30), covariance[:30, :30], 500)
    centers = np.array([model.images[i].projection_center() for i in sorted(model.reg_image_ids())])
    moved = centers - 1e-3 * np.einsum("nij,dnj->dni", back, draws.reshape(-1, 5, 6)[:, :, 3:])
    errors = [((align_points(each, centers).apply(each) - centers) ** 2).sum(1) for each in moved]
    assert found.centers == pytest.approx(1e3 * np.sqrt(np.mean(errors, 0)), rel=0.1)


@pytest.mark.slow
def test_the_expected_errors_are_those_of_many_captures():
    truth = capture(noise=0.0)
    ids, draw = sorted(truth.reg_image_ids()), np.random.default_rng(0)
    true = np.array([truth.images[i].projection_center() for i in ids])
    free = {1: free_parameters(truth.cameras[1], True)}
    errors, params, expected = [], [], []
    for _ in range(40):
        noisy = capture(noise=0.0)
        for image_id in ids:
            for feature in noisy.images[image_id].points2D:
                feature.xy = feature.xy + draw.normal(0, NOISE_PX, 2)
        model = bundle_adjust(noisy, {1: frozenset({PRINCIPAL_POINT})}, 1)
        found = np.array([model.images[i].projection_center() for i in ids])
        errors.append(((align_points(found, true).apply(found) - true) ** 2).sum(1))
        params.append(model.cameras[1].params.copy())
        expected.append(estimate_precision(model, free))
    centers = np.mean([each.centers for each in expected], 0)
    assert np.sqrt(np.mean(errors)) == pytest.approx(np.sqrt(np.mean(centers**2)), rel=0.15)
    for place in free[1]:
        stated = np.mean([each.intrinsics[1][place] for each in expected])
        assert np.std(params, 0)[place] == pytest.approx(stated, rel=0.35)


def test_what_is_undetermined_has_no_error():
    model = mapped(capture(photos=5, points=60))
    for point_id in sorted(model.points3D)[3:]:
        model.delete_point3D(point_id)
    assert estimate_precision(model, {1: free_parameters(model.cameras[1], True)}) is None


# ---------------------------------------------------------------- what the report says
def test_the_report_says_what_was_freed_and_how_exact_poses_are():
    last = adjust_last(mapped(capture(SHIFT)), SfmParams(), 1)
    registration = Registration(lenses=last.lenses, pose_error=last.pose_error)
    assert Registration.model_validate_json(registration.model_dump_json()) == registration
    place = Place(Similarity.identity())
    freed, exact = describe_poses(registration, place)
    before, after = last.lenses[0].trials[0].held_out_px
    assert freed.startswith("Freed of the lens: principal point, 9")
    assert f"{before:.3f} -> {after:.3f} px" in freed
    assert "% of the distance, from" in exact
    assert " m), from" in describe_poses(registration, replace(place, metric=True))[1]
    last = adjust_last(mapped(capture()), SfmParams(), 1)
    registration = Registration(lenses=last.lenses, pose_error=last.pose_error)
    assert describe_poses(registration, place)[0].startswith("Nothing more of the lens was freed (principal point: ")
    assert describe_poses(Registration(), place) == describe_poses(None, place) == []


def test_the_freedoms_are_tried_in_order():
    assert adjustment.FREEDOMS == (PRINCIPAL_POINT, K2)
