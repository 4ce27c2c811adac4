"""Suites of benchmarks: scenes found in their published layouts, split as published, and what is lacking said."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from sphere_scene import RADIUS
from suite_layouts import COUNT, LAYOUTS, write_mipnerf360, write_neus, write_suite, write_urban_photos

from benchmarks.suites import beyond_rounding
from stages.errors import InputError
from stages.evaluation.protocols.blendedmvs import true_points
from stages.evaluation.suites.paper import paper_tables
from stages.evaluation.suites.registry import SUITES, find_scenes, find_suite
from stages.evaluation.suites.scene import SuiteScene, Wanted
from stages.posing.known import match_photos
from stages.posing.reading import read_poses


def the_scene(suite: str, data: Path, **wanted: object) -> SuiteScene:
    scenes = find_scenes(SUITES[suite], data, Wanted(**wanted))  # type: ignore[arg-type]
    assert len(scenes) == 1
    return scenes[0]


# ---------------------------------------------------------------- layouts
@pytest.mark.parametrize("suite", LAYOUTS)
@pytest.mark.parametrize("inside", [False, True])
def test_a_scene_is_found_in_the_suite_s_folder_and_by_its_own(tmp_path: Path, suite: str, inside: bool):
    place = write_suite(suite, tmp_path)
    (tmp_path / "notes").mkdir()
    scene = the_scene(suite, place if inside else tmp_path)
    assert scene.name == ("24" if suite == "dtu" else place.name)
    assert scene.photos.is_dir()
    assert scene.masks is None
    assert (scene.poses is None) == (suite == "known")


@pytest.mark.parametrize(
    ("suite", "tests", "left_out"),
    [
        ("nerf-synthetic", ["r_0.png", "r_1.png"], 0),
        ("mipnerf360", ["DSC00000.JPG"], 1),
        ("urbanscene3d", ["000006.jpg", "000007.jpg"], 0),
    ],
)
def test_published_splits(tmp_path: Path, suite: str, tests: list[str], left_out: int):
    write_suite(suite, tmp_path)
    scene = the_scene(suite, tmp_path)
    assert scene.views is not None
    assert list(scene.views.names) == tests
    assert len(match_photos(read_poses(scene.views.poses), scene.views.names)) == len(tests)
    # photos of the tests either lie elsewhere, or are named to be left out
    assert len(scene.left_out) == left_out
    assert set(scene.left_out) <= set(scene.views.names)
    assert scene.views.background == ("white" if suite == "nerf-synthetic" else "photo")


@pytest.mark.parametrize("suite", ["dtu", "glossy-synthetic", "blendedmvs", "known"])
def test_suites_without_test_photos_keep_back_every_nth_where_asked(tmp_path: Path, suite: str):
    write_suite(suite, tmp_path)
    assert the_scene(suite, tmp_path).views is None
    assert the_scene(suite, tmp_path).left_out == ()
    scene = the_scene(suite, tmp_path, hold_out=4)
    assert scene.views is not None
    assert scene.left_out == scene.views.names
    assert len(scene.left_out) == COUNT // 4
    assert len(match_photos(read_poses(scene.views.poses), scene.views.names)) == COUNT // 4


@pytest.mark.parametrize("suite", ["dtu", "glossy-synthetic", "known"])
def test_masks_are_used_where_wanted(tmp_path: Path, suite: str):
    write_suite(suite, tmp_path)
    masks = the_scene(suite, tmp_path, masks=True).masks
    assert masks is not None
    assert masks.is_dir()


def test_mipnerf360_has_indoor_scenes_at_half_size_and_says_where_it_takes_another(tmp_path: Path):
    (tmp_path / "room").mkdir()
    write_mipnerf360(tmp_path / "room")
    scene = the_scene("mipnerf360", tmp_path)
    assert scene.photos.name == "images"
    assert scene.lacking == ("photos of images: the papers' figures are of images_2",)
    (tmp_path / "room" / "images_4").rename(tmp_path / "room" / "images_2")
    scene = the_scene("mipnerf360", tmp_path)
    assert (scene.photos.name, scene.lacking) == ("images_2", ())


def test_dtu_s_evaluation_data_is_looked_for_beside_the_scans_and_where_it_is_said_to_be(tmp_path: Path):
    write_suite("dtu", tmp_path / "scans")
    scene = the_scene("dtu", tmp_path / "scans")
    assert scene.truth is None
    assert "ObsMask/ObsMask24_10.mat" in scene.lacking[0]
    for data, given in ((tmp_path / "SampleSet" / "MVS Data", None), (tmp_path / "elsewhere", tmp_path / "elsewhere")):
        for name in ("ObsMask/ObsMask24_10.mat", "Points/stl/stl024_total.ply"):
            (data / name).parent.mkdir(parents=True)
            (data / name).touch()
        truth = the_scene("dtu", tmp_path / "scans", truth=given).truth
        assert truth is not None
        assert (truth.folder, truth.scan) == (data, 24)


def test_blendedmvs_as_neus_gives_it(tmp_path: Path):
    (tmp_path / "bmvs_bear").mkdir()
    write_neus(tmp_path / "bmvs_bear")
    scene = the_scene("blendedmvs", tmp_path, masks=True)
    assert scene.masks == tmp_path / "bmvs_bear" / "mask"
    assert scene.truth is None
    assert "comes without a surface" in scene.lacking[0]


def test_depth_maps_are_points_on_the_surface(tmp_path: Path):
    place = write_suite("blendedmvs", tmp_path)
    points = true_points(place)
    assert len(points) > 50
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), RADIUS, atol=2e-3)


def test_urban_photos_without_poses(tmp_path: Path):
    write_urban_photos(tmp_path / "Residence")
    scene = the_scene("urbanscene3d", tmp_path)
    assert (scene.name, scene.photos, scene.poses) == ("Residence", tmp_path / "Residence" / "photos", None)
    assert any("no view synthesis" in sentence for sentence in scene.lacking)


def test_glossy_scene_without_depth_has_no_truth(tmp_path: Path):
    place = write_suite("glossy-synthetic", tmp_path)
    (place / "3-depth.png").unlink()
    scene = the_scene("glossy-synthetic", tmp_path, masks=True)
    assert (scene.truth, scene.masks) == (None, None)
    assert "lacks depth images" in scene.lacking[0]


def test_nero_s_test_views_are_used_where_its_split_is_there(tmp_path: Path):
    write_suite("glossy-synthetic", tmp_path)
    assert the_scene("glossy-synthetic", tmp_path).lacking[0].startswith("distance over all views")
    (tmp_path / "code").mkdir()
    (tmp_path / "code" / "synthetic_split_128.pkl").touch()
    scene = the_scene("glossy-synthetic", tmp_path, truth=tmp_path / "code")
    assert scene.truth is not None
    assert (scene.truth.split, scene.lacking) == (tmp_path / "code" / "synthetic_split_128.pkl", ())


def test_what_is_not_there_is_said(tmp_path: Path):
    with pytest.raises(InputError, match="There is no suite 'dtuu'") as caught:
        find_suite("dtuu")
    assert "Did you mean `hineus bench dtu`?" in caught.value.hint
    with pytest.raises(InputError, match="There is no folder"):
        find_scenes(SUITES["dtu"], tmp_path / "nothing", Wanted())
    with pytest.raises(InputError, match="holds no scene of DTU") as caught:
        find_scenes(SUITES["dtu"], tmp_path, Wanted())
    assert "dtu_scan24/{image,mask,cameras_sphere.npz}" in caught.value.hint
    write_suite("dtu", tmp_path)
    with pytest.raises(InputError, match="has no scene 37") as caught:
        find_scenes(SUITES["dtu"], tmp_path, Wanted(), ["37"])
    assert "there are 24" in caught.value.hint


# ---------------------------------------------------------------- the paper's figures
# Printed averages that do not follow from the figures beside them, and whether rounding may be the reason.
DEVIATING = {
    ("nerf-synthetic", "Mip-NeRF"): ("33.60", True),
    ("nerf-synthetic", "HiNeuS, plain Eikonal term"): ("32.80", True),
    ("glossy-synthetic", "RefNeuS"): ("0.0050", True),
    ("glossy-synthetic", "HiNeuS"): ("0.0039", True),
    ("glossy-synthetic", "HiNeuS, no ambiguity weight"): ("0.0045", True),
    ("glossy-synthetic", "HiNeuS, no self-reflection"): ("0.0042", False),
    ("mipnerf360", "HF-NeuS"): ("26.79", False),
    ("mipnerf360", "HiNeuS"): ("29.38", True),
    ("mipnerf360", "HiNeuS, visibility as RefNeuS"): ("28.83", True),
    ("mipnerf360", "HiNeuS, plain Eikonal term"): ("28.31", True),
    ("dtu", "MVSDF"): ("0.89", False),
    ("dtu", "NeuS2"): ("0.69", False),
}


def test_the_paper_s_averages_are_what_its_figures_say_but_for_those_that_are_listed():
    found = {}
    for suite, table in paper_tables().items():
        decimals = SUITES[suite].decimals
        for row in table.rows:
            slow = 0.0
            for scene in table.scenes:
                slow += row.scores[scene]
            assert row.average == pytest.approx(slow / len(table.scenes))
            if row.deviates(decimals):
                found[suite, row.method] = (f"{row.average:.{decimals}f}", beyond_rounding(row, decimals))
    assert found == DEVIATING


def test_the_paper_s_tables_are_whole():
    sizes = {suite: (len(table.scenes), len(table.rows)) for suite, table in paper_tables().items()}
    assert sizes == {"dtu": (15, 18), "nerf-synthetic": (7, 10), "mipnerf360": (9, 13), "glossy-synthetic": (8, 7)}
    assert paper_tables()["dtu"].rows[13].scores["24"] == 0.28
    assert all(len({row.method for row in table.rows}) == len(table.rows) for table in paper_tables().values())
