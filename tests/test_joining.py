"""Components of a synthetic capture: those that share points become one model, others stay apart."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from configs.params import SfmParams
from stages.posing.joining import align, common_points, join_models, verified_matches
from stages.posing.workbench import Base, Workbench

PHOTOS, FIRST = 12, 7  # the first seven are one component, the other five the other
TURNED = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1.0]])


class Capture:
    """Twelve photos of 300 points, the features with noise; photo k matches photo k + 7 with `links` features.

    So every photo of the second component sees too few points of the first to be placed there alone.
    """

    def __init__(self, path: Path, links: int, mixed: bool = False) -> None:
        import pycolmap

        self.path = path
        pycolmap.set_random_seed(1)
        options = pycolmap.SyntheticDatasetOptions()
        options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 1, 1, PHOTOS
        options.num_points3D = 300
        noise = pycolmap.SyntheticNoiseOptions()
        noise.point2D_stddev = 0.5
        random = np.random.default_rng(0)
        with pycolmap.Database.open(path) as database:
            self.truth = pycolmap.synthesize_dataset(options, database)
            pycolmap.synthesize_noise(noise, self.truth, database)
            self.ids = sorted(self.truth.reg_image_ids())
            for i, j in combinations(self.ids, 2):
                if (i in self.ids[:FIRST]) == (j in self.ids[:FIRST]):
                    continue
                geometry = database.read_two_view_geometry(i, j)
                database.delete_two_view_geometry(i, j)
                if links and self.ids.index(j) - self.ids.index(i) == FIRST:
                    matches = geometry.inlier_matches[random.permutation(len(geometry.inlier_matches))[:links]]
                    if mixed:
                        matches[:, 1] = random.permutation(matches[:, 1])
                    geometry.inlier_matches = matches
                    database.write_two_view_geometry(i, j, geometry)

    @property
    def centers(self) -> np.ndarray:
        return np.array([self.truth.images[i].projection_center() for i in self.ids])

    def part(self, ids: list[int]):
        """A model of these photos only, in a frame of its own."""
        import pycolmap

        model = pycolmap.Reconstruction(self.truth)
        for image in self.truth.images.values():
            if image.image_id not in ids:
                model.deregister_frame(image.frame_id)
        model.transform(pycolmap.Sim3d(0.5 + len(ids), pycolmap.Rotation3d(TURNED), np.arange(3.0)))
        return model

    def halves(self):
        return [self.part(self.ids[:FIRST]), self.part(self.ids[FIRST:])]


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
    capture = Capture(tmp_path / "a.db", links=16)
    (joint,) = join_models(capture.halves(), capture.path, options())
    assert largest_error(capture, joint) < 0.002
    assert joint.compute_mean_reprojection_error() < 1
    seen_by = [{element.image_id for element in point.track.elements} for point in joint.points3D.values()]
    assert sum(max(images) > capture.ids[FIRST - 1] >= min(images) for images in seen_by) > 50


def test_components_that_share_photos_become_one_model_without_any_match_between_them(tmp_path: Path):
    capture = Capture(tmp_path / "a.db", links=0)
    parts = [capture.part(capture.ids[: FIRST + 1]), capture.part(capture.ids[FIRST - 1 :])]
    (joint,) = join_models(parts, capture.path, options())
    assert largest_error(capture, joint) < 0.002


@pytest.mark.parametrize(("links", "mixed"), [(0, False), (4, False), (16, True)])
def test_components_with_no_few_or_wrong_matches_between_them_stay_apart(tmp_path: Path, links: int, mixed: bool):
    capture = Capture(tmp_path / "a.db", links, mixed)
    models = join_models(capture.halves()[::-1], capture.path, options())
    assert [model.num_reg_images() for model in models] == [FIRST, PHOTOS - FIRST]


def test_common_points_are_those_of_features_that_match(tmp_path: Path):
    import pycolmap

    capture = Capture(tmp_path / "a.db", links=16)
    first, second = capture.halves()
    with pycolmap.Database.open(capture.path) as database:
        matches = verified_matches(database, 15)
        across = [pair for pair in matches if (pair[0] in capture.ids[:FIRST]) != (pair[1] in capture.ids[:FIRST])]
        assert len(across) == PHOTOS - FIRST
        assert not verified_matches(database, 17).keys() & set(across)
    common = common_points(first, second, matches)
    # the halves of one model keep the ids of its points
    assert (common[:, 0] == common[:, 1]).all()
    assert 16 < len(common) <= 5 * 16
    assert np.array_equal(common_points(second, first, matches)[:, ::-1], common)
    first_from_second, agreeing = align(first, second, common)
    assert agreeing.mean() > 0.9
    assert first_from_second.scale == pytest.approx((0.5 + FIRST) / (0.5 + PHOTOS - FIRST), rel=0.01)
    # a third of the pairs wrong: they are told apart
    wrong = common.copy()
    wrong[::3, 1] = np.roll(wrong[::3, 1], 1)
    _, agreeing = align(first, second, wrong)
    assert agreeing[1::3].mean() > 0.9
    assert not agreeing[::3].any()


@pytest.mark.parametrize(("links", "sizes"), [(16, [PHOTOS]), (0, [FIRST, PHOTOS - FIRST])])
def test_an_attempt_joins_its_components(tmp_path: Path, links: int, sizes: list[int]):
    import shutil

    from stages import artifacts
    from stages.artifacts import ImageRecord, ImageSet

    capture = Capture(tmp_path / "a.db", links)
    names = [capture.truth.images[i].name for i in capture.ids]
    for name in names:
        artifacts.write_png(artifacts.image_path(tmp_path, name), np.zeros((768, 1024), np.uint8))
    records = tuple(ImageRecord(name, name, 1024, 768, None, "camera", 1.0, False, name) for name in names)
    work = tmp_path / "work"
    work.mkdir()
    bench = Workbench(
        work, tmp_path / artifacts.IMAGES, tmp_path / artifacts.MASKS, ImageSet(records), SfmParams(), threads=1,
        workers=1, cuda=False, progress=lambda done, total, note: None,
    )  # fmt: skip
    shutil.copyfile(capture.path, bench.database(Base()))
    found = bench._solve(Base(), "incremental")
    assert found is not None
    assert [len(found.registered), *map(len, found.others)] == sizes
