"""How far GPS lies from the cameras, as the report tells it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from report_inputs import bare_inputs, full_inputs, page

from stages import artifacts
from stages.artifacts import ImageRecord, ImageSet
from stages.geometry.earth import from_east_north_up
from stages.geometry.place import ControlPoint, Place
from stages.geometry.similarity import Similarity
from stages.reporting.gps import MOST_ROWS, describe_gps
from stages.reporting.photo_table import PhotoResult

ORIGIN = (47.0, 8.5, 400.0)
PLACE = Place(Similarity.identity(), True, "GPS", 0.01, ORIGIN, 1.2)


def results(positions: np.ndarray | None, count: int) -> list[PhotoResult]:
    return [
        PhotoResult(
            ImageRecord(f"{i}.jpg", f"{i}.jpg", 40, 30, None, "0", 5.0, False, "00", gps=gps),
            "",
            None,
            i,
            False,
            None,
        )
        for i, gps in enumerate([None] * count if positions is None else map(tuple, positions.tolist()))
    ]


def test_misses_are_those_of_gps_east_north_and_up():
    centers = np.array([[0.0, 0, 50], [30, 0, 50], [0, 40, 52]])
    misses = np.array([[1.0, 0, -2], [0, -3.0, -2], [0, 0, -2]])
    shown = describe_gps(results(from_east_north_up(centers + misses, ORIGIN), 3), centers, PLACE)
    assert shown is not None
    assert [row["name"] for row in shown["photos"]] == ["1.jpg", "0.jpg", "2.jpg"]  # the worst first
    assert shown["photos"][0] == {"name": "1.jpg", "miss": "+0.00 -3.00 -2.00", "distance": "3.61 m"}
    assert "0.58 m east, 1.73 m north and 2.00 m up (root mean square)" in shown["sentence"]
    assert "and by +0.33 -1.00 -2.00 m on average" in shown["sentence"]
    assert "GPS of 3 photos" in shown["sentence"]
    control = ControlPoint("A", (0, 0, 0), False, True, None, None, ())
    beside = describe_gps(results(from_east_north_up(centers, ORIGIN), 3), centers, replace(PLACE, control=(control,)))
    assert beside is not None
    assert "the control points, without GPS" in beside["sentence"]


def test_on_a_map_they_are_the_same():
    pytest.importorskip("pyproj")
    from stages.posing.coordinates import to_grid

    positions = from_east_north_up(np.array([[0.0, 0, 50], [30, 0, 50]]), ORIGIN)
    grid = to_grid(positions, "EPSG:32632")
    offset = (461000.0, 5205000.0, 400.0)
    place = replace(PLACE, origin=None, crs="EPSG:32632", offset=offset)
    shown = describe_gps(results(positions, 2), grid - offset - [0.5, 0, 0], place)
    assert shown is not None
    assert {row["miss"] for row in shown["photos"]} == {"+0.50 +0.00 +0.00"}


def test_nothing_is_said_where_nothing_is_known():
    centers = np.zeros((2, 3))
    assert describe_gps(results(None, 2), centers, PLACE) is None
    positions = np.tile(ORIGIN, (2, 1))
    assert describe_gps(results(positions, 2), centers, replace(PLACE, origin=None)) is None
    assert describe_gps(results(positions, 2), centers, replace(PLACE, origin=None, crs="?", offset=(0, 0, 0))) is None
    assert describe_gps([replace(each, camera=None) for each in results(positions, 2)], centers, PLACE) is None


def test_of_many_photos_the_worst_are_listed():
    count = MOST_ROWS + 5
    centers = np.zeros((count, 3))
    positions = from_east_north_up(centers + np.arange(count)[:, None] * [0.1, 0, 0], ORIGIN)
    shown = describe_gps(results(positions, count), centers, PLACE)
    assert shown is not None
    assert (len(shown["photos"]), shown["left_out"]) == (MOST_ROWS, 5)
    assert shown["photos"][0]["name"] == f"{count - 1}.jpg"


def test_the_page_has_it(tmp_path):
    full = full_inputs(bare_inputs(tmp_path))
    assert "<h2>GPS</h2>" not in page(full)
    found = artifacts.IMAGE_SET.load(full.inputs["ingest"])
    first = replace(found.images[0], gps=ORIGIN)
    artifacts.IMAGE_SET.save(full.inputs["ingest"], ImageSet((first, *found.images[1:]), found.skipped))
    artifacts.WORLD_PLACE.save(full.inputs["place"], PLACE)
    text = page(full)
    assert "<h2>GPS</h2>" in text
    assert "GPS of 1 photo against" in text
    assert "+0.00 +0.00 +3.00" in text  # the camera is 3 below
