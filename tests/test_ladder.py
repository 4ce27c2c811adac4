"""The ladder's decisions with stubbed attempts, and what its rungs do on databases and small captures."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, product
from pathlib import Path

import numpy as np
import pytest

from configs.params import SfmParams
from stages.artifacts import ImageSet
from stages.errors import ReconstructionError
from stages.posing.ladder import Rung, Solution, Step, better, climb, describe, photos_wanted
from stages.posing.pairs import EXHAUSTIVE, PREEMPTIVE
from stages.posing.turning import Depth
from stages.posing.workbench import Base, Workbench, forget_focal_priors, has_still_background


def solution(count: int, error: float = 0.5) -> Solution:
    return Solution(frozenset(f"{i}.jpg" for i in range(count)), 100 * count, error)


class Stub:
    """Rungs that find models of the sizes given (None: no model), and remember what they were handed."""

    def __init__(self, *found: int | Exception | None, applies=lambda best: True):
        self.handed: list[int | None] = []
        self.rungs = [Rung(f"rung {i}", self._attempt(each), applies) for i, each in enumerate(found)]

    def _attempt(self, found):
        def attempt(best):
            self.handed.append(None if best is None else len(best.registered))
            if isinstance(found, Exception):
                raise found
            return None if found is None else solution(found)

        return attempt


# ---------------------------------------------------------------- decisions
def test_a_set_that_is_whole_at_the_first_rung_takes_no_other():
    stub = Stub(20, 20, 20)
    best, steps = climb(stub.rungs, 20, 6)
    assert len(best.registered) == 20
    assert [step.rung for step in steps] == ["rung 0"]


def test_rungs_are_taken_until_enough_photos_are_placed_and_each_gets_the_best_so_far():
    stub = Stub(None, 9, 4, 19, 20)
    best, steps = climb(stub.rungs, 19, 6)
    assert stub.handed == [None, None, 9, 9]
    assert len(best.registered) == 19
    assert [step.kept for step in steps] == [False, True, False, True]
    assert [step.registered for step in steps] == [0, 9, 4, 19]
    assert steps[0].error_px is None


def test_three_fruitless_rungs_end_the_climb_where_enough_is_placed_and_only_there():
    _, steps = climb(Stub(12, 12, 11, 12, 20).rungs, 20, 10)
    assert len(steps) == 4
    best, steps = climb(Stub(8, 8, 7, 8, 20).rungs, 20, 10)
    assert len(steps) == 5
    assert len(best.registered) == 20
    # one that places a photo begins the count anew
    _, steps = climb(Stub(12, 12, 13, 13, 13, 13, 20).rungs, 20, 10)
    assert len(steps) == 6


def test_no_rung_finds_anything():
    best, steps = climb(Stub(None, None).rungs, 5, 3)
    assert best is None
    assert len(steps) == 2


def test_a_rung_that_does_not_apply_is_left_out_and_asked_with_the_best_so_far():
    stub = Stub(5, 9)
    asked = []
    stub.rungs[1] = Rung("other", stub.rungs[1].attempt, lambda best: asked.append(best) or False)
    best, steps = climb(stub.rungs, 9, 3)
    assert len(best.registered) == 5
    assert len(steps) == 1
    assert asked == [best]


def test_a_later_rung_that_breaks_is_noted_and_the_first_one_is_not_hidden():
    best, steps = climb(Stub(5, RuntimeError("Check failed:\n x"), 9).rungs, 9, 3)
    assert len(best.registered) == 9
    assert steps[1].note == "Check failed: x"
    assert describe(steps[1]) == "rung 1: Check failed: x"
    with pytest.raises(RuntimeError):
        climb(Stub(RuntimeError("broken"), 9).rungs, 9, 3)


def test_none_wanted_takes_the_first_rung_only():
    _, steps = climb(Stub(None, 9).rungs, 0, 3)
    assert len(steps) == 1


def test_photos_come_before_error():
    assert better(solution(5, 0.9), solution(4, 0.1))
    assert better(solution(5, 0.4), solution(5, 0.5))
    assert not better(solution(5, 0.5), solution(5, 0.5))
    assert not better(None, solution(1))
    assert better(solution(1), None)


@pytest.mark.parametrize(("total", "wanted"), [(3, 3), (16, 16), (20, 19), (47, 45), (49, 47), (100, 95)])
def test_photos_wanted(total: int, wanted: int):
    assert photos_wanted(total, 0.95) == wanted
    assert photos_wanted(total, 0) == 0


def test_what_a_step_did_says_nothing_of_the_clock_which_is_for_the_log(caplog: pytest.LogCaptureFixture):
    caplog.set_level("INFO")
    _, steps = climb(Stub(5).rungs, 5, 3)
    assert steps == [Step("rung 0", 5, 500, 0.5, True)]
    assert caplog.messages == ["rung 0: 5 photos, 500 points, 0.50 px (0.0 s)"]


# ---------------------------------------------------------------- databases
def database(path: Path, places: dict[str, np.ndarray], pairs: list[tuple[int, int]]) -> Path:
    """Photos of one camera whose k-th features all match."""
    import pycolmap

    with pycolmap.Database.open(path) as opened:
        camera = pycolmap.Camera.create_from_model_name(0, "SIMPLE_RADIAL", 900.0, 640, 480)
        camera.has_prior_focal_length = True
        camera_id = opened.write_camera(camera)
        ids = []
        for name, keypoints in places.items():
            ids.append(opened.write_image(pycolmap.Image(name=name, camera_id=camera_id)))
            opened.write_keypoints(ids[-1], keypoints.astype(np.float32))
        matches = np.stack([np.arange(len(keypoints))] * 2, 1).astype(np.uint32)
        for first, second in pairs:
            opened.write_matches(ids[first], ids[second], matches)
    return path


def turntable(shift: float) -> dict[str, np.ndarray]:
    """20 features that stand still, and 20 that move by `shift` pixels from photo to photo."""
    still, moving = np.random.default_rng(0).uniform(0, 400, (2, 20, 2))
    return {f"a photo {i}.jpg": np.concatenate([still, moving + np.array([shift * i, 0])]) for i in range(4)}


def test_a_background_that_stands_still_is_seen_and_one_that_moves_along_is_not(tmp_path: Path):
    neighbours, all_pairs = [(0, 1), (1, 2), (2, 3)], [(i, j) for j in range(4) for i in range(j)]
    assert has_still_background(database(tmp_path / "a.db", turntable(30), all_pairs))
    moved = {name: places + 30 * i for i, (name, places) in enumerate(turntable(30).items())}
    assert not has_still_background(database(tmp_path / "b.db", moved, all_pairs))
    # one pair of photos that are nearly the same is no turntable
    moved["a photo 1.jpg"] = moved["a photo 0.jpg"] + 1
    assert not has_still_background(database(tmp_path / "c.db", moved, neighbours))
    assert not has_still_background(database(tmp_path / "d.db", turntable(30), []))


@pytest.mark.parametrize(("asked", "taken"), [("auto", EXHAUSTIVE), ("preemptive", PREEMPTIVE)])
def test_views_of_360_degree_pictures_are_matched_with_all_unless_asked_for_less(
    tmp_path: Path, monkeypatch, asked: str, taken: str
):
    from stages.artifacts import ImageRecord

    views = ImageSet(tuple(ImageRecord(f"{i}.jpg", "", 64, 64, 50.0, "c", 1.0, False, "", frame="a") for i in "12"))
    monkeypatch.setattr(Workbench, "_import", lambda bench, base: None)
    bench = Workbench(
        tmp_path, tmp_path, tmp_path, views, SfmParams(matcher=asked), 1, 1, False, lambda done, total, note: None
    )  # fmt: skip
    assert bench.matcher == taken


def test_focal_priors_are_forgotten(tmp_path: Path):
    import pycolmap

    path = database(tmp_path / "a.db", turntable(30), [])
    forget_focal_priors(path, "SIMPLE_RADIAL")
    with pycolmap.Database.open(path) as opened:
        (camera,) = opened.read_all_cameras()
    assert not camera.has_prior_focal_length
    assert camera.mean_focal_length() == pytest.approx(1.2 * 640)


def test_names_with_spaces_survive_a_list_of_pairs(tmp_path: Path):
    import pycolmap

    from stages.posing.pairs import _named_by_number

    path = database(tmp_path / "a.db", turntable(30), [])
    with _named_by_number(path), pycolmap.Database.open(path) as opened:
        assert sorted(image.name for image in opened.read_all_images()) == ["1", "2", "3", "4"]
    with pycolmap.Database.open(path) as opened:
        assert sorted(image.name for image in opened.read_all_images()) == sorted(turntable(30))


def test_every_base_has_a_database_of_its_own():
    bases = [Base(*flags) for flags in product((False, True), repeat=5) if flags[:2] != (True, True)]
    assert len({base.file for base in bases}) == 24
    assert all(Base.of_file(base.file) == base for base in bases)


def test_always_inside_the_masks_needs_masks(tmp_path: Path):
    from stages.artifacts import ImageRecord, ImageSet
    from stages.errors import InputError
    from stages.sfm import _check_masks

    images = ImageSet((ImageRecord("a.jpg", "a.jpg", 64, 64, None, "c", 1.0, False, "0"),))
    with pytest.raises(InputError, match=r"1 of 1 photos have no mask, e\.g\. a\.jpg"):
        _check_masks(images, SfmParams(masks="always"))
    _check_masks(images, SfmParams())


# ---------------------------------------------------------------- the workbench
def workbench(tmp_path: Path, focal: float | None = None, names=("a b.png", "c.png", "d.png"), **params: object):
    """Photos of noise, the object in the left half of each."""
    import cv2

    from stages import artifacts
    from stages.artifacts import ImageRecord, ImageSet
    from stages.posing.workbench import Workbench

    records, noise = [], np.random.default_rng(0)
    mask = np.zeros((120, 160), np.uint8)
    mask[:, :80] = 255
    for name in names:
        grey = noise.integers(0, 256, (30, 40), dtype=np.uint8)
        artifacts.write_png(artifacts.Pictures(tmp_path).path(name), cv2.resize(grey, (160, 120)))
        artifacts.write_png(artifacts.Pictures(tmp_path).mask_path(name), mask)
        records.append(ImageRecord(name, name, 160, 120, focal, "camera", 1.0, True, name))
    work = tmp_path / "work"
    work.mkdir()
    return Workbench(
        work,
        tmp_path / artifacts.IMAGES,
        tmp_path / artifacts.MASKS,
        ImageSet(tuple(records)),
        SfmParams(**params),  # type: ignore[arg-type]
        threads=1,
        workers=1,
        cuda=False,
        progress=lambda done, total, note: None,
    )


def keypoints(path: Path) -> np.ndarray:
    import pycolmap

    with pycolmap.Database.open(path) as opened:
        return np.concatenate([opened.read_keypoints(image.image_id)[:, :2] for image in opened.read_all_images()])


FOUR = tuple(turntable(30))


def matching_all(bench: Workbench, places: dict[str, np.ndarray], monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """All features of a bench match, of neighbours or of all pairs, by its matcher; what was matched is remembered."""
    import pycolmap

    matched = []

    def match(base: Base) -> None:
        matched.append(bench.matcher)
        indices = np.stack([np.arange(len(next(iter(places.values()))))] * 2, 1).astype(np.uint32)
        with pycolmap.Database.open(bench.database(base)) as opened:
            ids = [opened.read_image_with_name(name).image_id for name in FOUR]
            for image_id, keypoints in zip(ids, places.values(), strict=True):
                if not opened.exists_keypoints(image_id):
                    opened.write_keypoints(image_id, keypoints.astype(np.float32))
            for i, j in combinations(range(len(ids)), 2):
                likely = j == i + 1 or bench.matcher == EXHAUSTIVE
                if likely and not opened.exists_matches(ids[i], ids[j]):
                    opened.write_matches(ids[i], ids[j], indices)

    monkeypatch.setattr(bench, "_extract", lambda base: None)
    monkeypatch.setattr(bench, "_match", match)
    return matched


@pytest.mark.parametrize("of_all", [True, False])
def test_a_background_stands_still_only_if_it_does_between_all_pairs(tmp_path: Path, monkeypatch, of_all: bool):
    """Neighbours on a dense walk have matches on the axis that hardly move, and photos further apart have none."""
    places = turntable(30)
    if not of_all:
        places = {name: at + 2.5 * i for i, (name, at) in enumerate(places.items())}
    bench = workbench(tmp_path, names=FOUR)
    matched = matching_all(bench, places, monkeypatch)
    bench._features_and_matches(Base(), None)
    assert matched == [PREEMPTIVE, EXHAUSTIVE]
    assert bench.matcher == EXHAUSTIVE
    assert bench.stands_still is of_all


def test_a_background_that_moves_along_needs_no_second_match(tmp_path: Path, monkeypatch):
    bench = workbench(tmp_path, names=FOUR)
    places = {name: at + 30 * i for i, (name, at) in enumerate(turntable(30).items())}
    assert matching_all(bench, places, monkeypatch) == []
    bench._features_and_matches(Base(), None)
    assert (bench.matcher, bench.stands_still) == (PREEMPTIVE, False)


@pytest.mark.parametrize("one_place", [True, False])
def test_photos_are_of_one_place_only_if_all_pairs_say_so(tmp_path: Path, monkeypatch, one_place: bool):
    bench = workbench(tmp_path, names=FOUR)
    matched = matching_all(
        bench, {name: at + 30 * i for i, (name, at) in enumerate(turntable(30).items())}, monkeypatch
    )

    def depth(path: Path) -> Depth:
        far = 0.02 if bench.matcher == EXHAUSTIVE and not one_place else 0.001
        return Depth({("000.png", "001.png"): 0.001, ("000.png", "003.png"): far})

    monkeypatch.setattr("stages.posing.workbench.judge_depth", depth)
    monkeypatch.setattr(bench, "_solve", lambda *arguments: solution(4))
    if one_place:
        with pytest.raises(ReconstructionError, match="taken from one place"):
            bench.first(None)
    else:
        assert bench.first(None) == solution(4)
        assert bench.depth.parallaxes["000.png", "003.png"] == 0.02
    assert matched == [PREEMPTIVE, EXHAUSTIVE]


def test_features_are_found_inside_the_masks_where_asked(tmp_path: Path):
    bench = workbench(tmp_path, masks="always")
    bench._extract(Base(masked=True))
    inside = keypoints(bench.database(Base(masked=True)))
    bench._import(Base())
    bench._extract(Base())
    everywhere = keypoints(bench.database(Base()))
    assert len(inside) > 20
    assert inside[:, 0].max() <= 81
    assert everywhere[:, 0].max() > 120


def test_the_rungs_are_those_that_the_capture_allows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("stages.posing.workbench.learned_available", lambda: True)
    bench = workbench(tmp_path)
    names = [rung.name for rung in bench.rungs() if rung.applies(None)]
    assert names == [
        "preemptive matching", "features inside the masks", "affine features", "all pairs",
        "corners with learned descriptors", "guided matching", "global mapper", "relaxed thresholds",
    ]  # fmt: skip
    guessed = tuple(replace(record, made_mask="salient") for record in bench.image_set.images)
    bench.image_set = ImageSet(guessed)
    names = [rung.name for rung in bench.rungs() if rung.applies(None)]
    assert names[1:3] == ["affine features", "features inside the masks"]
    (tmp_path / "other").mkdir()
    bench = workbench(tmp_path / "other", focal=180.0, matcher="sequential", mapper="global", masks="never")
    names = [rung.name for rung in bench.rungs() if rung.applies(None)]
    assert names == [
        "sequential matching", "all pairs", "no focal priors", "affine features",
        "corners with learned descriptors", "guided matching", "incremental mapper", "relaxed thresholds",
    ]  # fmt: skip


def test_of_many_photos_only_pairs_that_may_show_the_same_are_ever_matched(tmp_path: Path, monkeypatch):
    asked = []

    def candidates(path: Path, positions: object, seed: int) -> list[tuple[int, int]]:
        asked.append(path.name)
        return [(1, 2), (2, 4)]

    monkeypatch.setattr("stages.posing.workbench.candidate_pairs", candidates)
    bench = workbench(tmp_path, names=FOUR, preemptive_max=3)
    assert (bench.matcher, bench._match_all(Base())) == (PREEMPTIVE, False)
    assert "all pairs that may show the same" in [rung.name for rung in bench.rungs()]
    placed = Solution(frozenset(FOUR[:3]), 10, 0.5, base=Base())
    assert bench._pairs_to_try(Base(), None) == [(1, 2), (2, 4)]
    assert bench._pairs_to_try(Base(), placed) == [(2, 4)]
    assert bench._pairs_with(Base(), FOUR[:1]) == [(1, 2)]
    compared = []
    monkeypatch.setattr("stages.posing.workbench.likely_pairs", lambda path, among: compared.append(among) or [])
    bench._match(Base())
    assert compared == [[(1, 2), (2, 4)]]
    assert asked == ["plain.db"]  # once for these features
    (tmp_path / "few").mkdir()
    few = workbench(tmp_path / "few", names=FOUR, preemptive_max=4)
    assert few._among(Base()) is None
    assert len(few._pairs_to_try(Base(), None)) == 6


def test_a_focal_length_that_the_poses_contradict_is_noticed(tmp_path: Path):
    import pycolmap

    bench = workbench(tmp_path, focal=180.0)

    def found(focal: float, count: int) -> Solution:
        model = pycolmap.Reconstruction()
        model.add_camera(pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", focal, 160, 120))
        return Solution(frozenset(sorted(bench.names)[:count]), 10, 0.5, model=model)

    assert bench.contradicted(found(200.0, 3)) == []
    assert bench.contradicted(found(360.0, 3)) == [(pytest.approx(180.0), pytest.approx(360.0))]
    assert bench.contradicted(found(90.0, 3))
    assert bench.priors_are_doubtful(None)
    assert bench.priors_are_doubtful(found(360.0, 3))
    assert bench.priors_are_doubtful(found(180.0, 1))
    assert not bench.priors_are_doubtful(found(180.0, 2))


def test_few_photos_left_out_are_helped_and_many_are_not(tmp_path: Path):
    bench = workbench(tmp_path)
    bench.names = frozenset(f"{i}.jpg" for i in range(10))
    assert bench.few_are_left_out(replace(solution(8), base=Base(masked=True)))
    assert not bench.few_are_left_out(replace(solution(7), base=Base()))
    assert not bench.few_are_left_out(replace(solution(8), base=Base(affine=True)))
    assert not bench.few_are_left_out(None)


@pytest.mark.parametrize(("wrong", "kept"), [(1, "ab"), (0, "abc")])
def test_a_photo_that_matches_nothing_from_its_own_pose_is_given_up(wrong: int, kept: str):
    bench = object.__new__(Workbench)
    outcomes = iter([(Solution(frozenset("ab"), 9, 0.5), wrong), (None, 0)])
    bench._corners_and_matches = lambda base: None
    bench._solve = lambda base, mapper: Solution(frozenset("abc"), 9, 0.5)
    bench._matched_by_poses = lambda *arguments: next(outcomes)
    found = bench._by_corners(Base(corners=True))
    assert found.registered == frozenset(kept)
