"""Components of a synthetic capture: those that share points become one model, others stay apart."""

from __future__ import annotations

import shutil
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from configs.params import SfmParams
from stages import artifacts
from stages.artifacts import ImageRecord, ImageSet
from stages.posing.joining import align, common_points, join_models, verified_matches
from stages.posing.workbench import Base, Workbench

FIRST, SECOND = range(7), range(7, 12)  # photos of the one component and the other
TURNED = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])


class Capture:
    """Photos of 300 points, the features with noise; only photos of the same part match."""

    def __init__(self, path: Path, *parts: range) -> None:
        import pycolmap

        self.path = path
        pycolmap.set_random_seed(1)
        options = pycolmap.SyntheticDatasetOptions()
        options.num_rigs, options.num_cameras_per_rig = 1, 1
        options.num_frames_per_rig, options.num_points3D = sum(map(len, parts)), 300
        noise = pycolmap.SyntheticNoiseOptions()
        noise.point2D_stddev = 0.5
        with pycolmap.Database.open(path) as database:
            self.truth = pycolmap.synthesize_dataset(options, database)
            pycolmap.synthesize_noise(noise, self.truth, database)
            self.ids = sorted(self.truth.reg_image_ids())
            for (i, first), (j, second) in combinations(enumerate(self.ids), 2):
                if not any(i in part and j in part for part in parts):
                    database.delete_two_view_geometry(first, second)

    def link(self, i: int, j: int, count: int, skip: int = 0, mixed: bool = False) -> None:
        """Let photos i and j match with `count` features of points after the first `skip`; mixed: with wrong ones."""
        import pycolmap

        first, second = (
            {feature.point3D_id: k for k, feature in enumerate(self.truth.images[self.ids[n]].points2D)} for n in (i, j)
        )
        points = [point for point in sorted(first.keys() & second.keys()) if self.truth.exists_point3D(point)]
        points = points[skip:][:count]
        others = points[1:] + points[:1] if mixed else points
        matches = [(first[point], second[other]) for point, other in zip(points, others, strict=True)]
        geometry = pycolmap.TwoViewGeometry()
        geometry.config = pycolmap.TwoViewGeometryConfiguration.UNCALIBRATED
        geometry.inlier_matches = np.array(matches, dtype=np.uint32)
        with pycolmap.Database.open(self.path) as database:
            database.write_two_view_geometry(self.ids[i], self.ids[j], geometry)

    @property
    def centers(self) -> np.ndarray:
        return np.array([self.truth.images[i].projection_center() for i in self.ids])

    def part(self, photos: range):
        """A model of these photos only, in a frame of its own."""
        import pycolmap

        model = pycolmap.Reconstruction(self.truth)
        for i, image_id in enumerate(self.ids):
            if i not in photos:
                model.deregister_frame(model.images[image_id].frame_id)
        model.transform(pycolmap.Sim3d(0.5 + len(photos), pycolmap.Rotation3d(TURNED), np.arange(3.0)))
        return model


def two_parts(path: Path, links: int, mixed: bool = False) -> Capture:
    """Each photo of the second part matches one of the first: too few of its points to be placed there alone."""
    capture = Capture(path, FIRST, SECOND)
    for place, j in enumerate(SECOND):
        if links:
            capture.link(place, j, links, skip=links * place, mixed=mixed)
    return capture


def options():
    import pycolmap

    made = pycolmap.IncrementalPipelineOptions()
    made.num_threads, made.random_seed = 1, 0
    return made


def largest_error(capture: Capture, model) -> float:
    """Of the camera centres, as part of the mean distance to their middle."""
    import pycolmap

    assert sorted(model.reg_image_ids()) == capture.ids
    found = np.array([model.images[i].projection_center() for i in capture.ids])
    true = capture.centers
    distances = np.linalg.norm(pycolmap.estimate_sim3d(found, true) * found - true, axis=1)
    return float(distances.max() / np.linalg.norm(true - true.mean(0), axis=1).mean())


def test_components_that_share_points_become_one_model(tmp_path: Path):
    capture = two_parts(tmp_path / "a.db", links=16)
    (joint,) = join_models([capture.part(FIRST), capture.part(SECOND)], capture.path, options())
    assert largest_error(capture, joint) < 0.002
    assert joint.compute_mean_reprojection_error() < 1
    last = capture.ids[FIRST[-1]]
    seen_by = [{element.image_id for element in point.track.elements} for point in joint.points3D.values()]
    assert sum(min(images) <= last < max(images) for images in seen_by) > 50


def test_components_that_share_photos_become_one_model_without_any_match_between_them(tmp_path: Path):
    capture = two_parts(tmp_path / "a.db", links=0)
    (joint,) = join_models([capture.part(range(8)), capture.part(range(6, 12))], capture.path, options())
    assert largest_error(capture, joint) < 0.002


def test_a_component_whose_photos_are_all_in_another_is_dropped(tmp_path: Path):
    capture = two_parts(tmp_path / "a.db", links=0)
    whole = capture.part(FIRST)
    assert join_models([capture.part(range(2, 5)), whole], capture.path, options()) == [whole]


@pytest.mark.parametrize(("links", "mixed"), [(0, False), (4, False), (16, True)])
def test_components_with_no_few_or_wrong_matches_between_them_stay_apart(tmp_path: Path, links: int, mixed: bool):
    capture = two_parts(tmp_path / "a.db", links, mixed)
    models = join_models([capture.part(SECOND), capture.part(FIRST)], capture.path, options())
    assert [model.num_reg_images() for model in models] == [len(FIRST), len(SECOND)]


def test_common_points_are_those_of_features_that_match(tmp_path: Path):
    import pycolmap

    capture = two_parts(tmp_path / "a.db", links=16)
    first, second = capture.part(FIRST), capture.part(SECOND)
    with pycolmap.Database.open(capture.path) as database:
        matches = verified_matches(database, 15)
        assert len(matches) - len(verified_matches(database, 17)) == len(SECOND)
    common = common_points(first, second, matches)
    # the parts of one model keep the ids of its points
    assert (common[:, 0] == common[:, 1]).all()
    assert len(common) == 16 * len(SECOND)
    assert np.array_equal(common_points(second, first, matches)[:, ::-1], common)
    first_from_second, agreeing = align(first, second, common)
    assert agreeing.mean() > 0.9
    assert first_from_second.scale == pytest.approx((0.5 + len(FIRST)) / (0.5 + len(SECOND)), rel=0.01)
    # a third of the pairs wrong: they are told apart
    wrong = common.copy()
    wrong[::3, 1] = np.roll(wrong[::3, 1], 1)
    _, agreeing = align(first, second, wrong)
    assert agreeing[1::3].mean() > 0.9
    assert not agreeing[::3].any()


def bench_of(capture: Capture, root: Path) -> Workbench:
    """A workbench whose database is that of the capture; its photos are black."""
    names = [capture.truth.images[i].name for i in capture.ids]
    for name in names:
        artifacts.write_png(artifacts.Pictures(root).path(name), np.zeros((768, 1024), np.uint8))
    records = tuple(ImageRecord(name, name, 1024, 768, None, "camera", 1.0, False, name) for name in names)
    (root / "work").mkdir()
    bench = Workbench(
        root / "work", root / artifacts.IMAGES, root / artifacts.MASKS, ImageSet(records), SfmParams(), threads=1,
        workers=1, cuda=False, progress=lambda done, total, note: None,
    )  # fmt: skip
    shutil.copyfile(capture.path, bench.database(Base()))
    return bench


@pytest.mark.parametrize(("links", "sizes"), [(16, [12]), (0, [7, 5])])
def test_an_attempt_joins_its_components(tmp_path: Path, links: int, sizes: list[int]):
    found = bench_of(two_parts(tmp_path / "a.db", links), tmp_path)._solve(Base(), "incremental")
    assert found is not None
    assert [len(found.registered), *map(len, found.others)] == sizes


def test_a_photo_that_needs_both_components_is_placed_once_they_are_joined(tmp_path: Path):
    capture = Capture(tmp_path / "a.db", FIRST, SECOND, range(12, 13))
    for place, j in enumerate(SECOND):
        capture.link(place, j, 16, skip=16 * place)
    capture.link(1, 12, 22)
    capture.link(8, 12, 22, skip=200)
    found = bench_of(capture, tmp_path)._solve(Base(), "incremental")
    assert found is not None
    assert len(found.registered) == 13
    assert found.others == ()
