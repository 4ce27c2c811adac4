import numpy as np
import pytest
import torch
from sphere_scene import ring_of_cameras

from stages.neural.evidence import Evidence, at_places, large_parts


def towards_the_centre(cameras, trust: float):
    """Depth maps that all find the scene's centre in the middle of the photo."""
    maps = []
    for index, (width, height) in enumerate(cameras.sizes.tolist()):
        depth = np.zeros((height, width), np.float32)
        pixel, distance = cameras.project(index, np.zeros((1, 3)))
        column, row = pixel[0].astype(int)
        depth[max(row - 8, 0) : row + 8, max(column - 8, 0) : column + 8] = distance[0]
        maps.append((depth, np.full_like(depth, trust)))
    return maps


CENTRE_AND_ASIDE = torch.tensor([[0.0, 0, 0], [0.7, 0.0, 0.0]])


def test_what_photos_deny_is_shiny_there_and_nowhere_else():
    cameras = ring_of_cameras()
    denied = Evidence.of(towards_the_centre(cameras, trust=0.05), cameras, "cpu")
    assert at_places(denied.shiny, CENTRE_AND_ASIDE).tolist() == [1.0, 0.0]


def test_what_photos_agree_on_is_not_shiny_nor_is_what_they_say_nothing_of():
    cameras = ring_of_cameras()
    for maps in (towards_the_centre(cameras, trust=0.9), [None] * len(cameras)):
        assert at_places(Evidence.of(maps, cameras, "cpu").shiny, CENTRE_AND_ASIDE).tolist() == [0.0, 0.0]


def test_depth_maps_may_be_smaller_than_their_photos():
    cameras = ring_of_cameras()
    small = [(depth[::2, ::2], trust[::2, ::2]) for depth, trust in towards_the_centre(cameras, trust=0.05)]
    assert at_places(Evidence.of(small, cameras, "cpu").shiny, CENTRE_AND_ASIDE).tolist() == [1.0, 0.0]


def test_a_shiny_hole_is_none_and_what_is_beside_a_shiny_thing_belongs_to_it():
    grid = np.zeros((30, 30, 30))
    grid[3:7, 3:7, 3:7] = 1  # four cells a side
    assert large_parts(grid).max() == 0
    grid[12:19, 12:19, 12:19] = 0.8
    assert np.argwhere(large_parts(grid) == 0.8).min(axis=0).tolist() == [10, 10, 10]
    assert np.argwhere(large_parts(grid) > 0).max(axis=0).tolist() == [20, 20, 20]


def test_known_is_where_photos_agree():
    cameras = ring_of_cameras()
    agreed = Evidence.of(towards_the_centre(cameras, trust=0.9), cameras, "cpu")
    assert at_places(agreed.known, CENTRE_AND_ASIDE).tolist() == pytest.approx([1, 0])
    denied = Evidence.of(towards_the_centre(cameras, trust=0.05), cameras, "cpu")
    assert at_places(denied.known, CENTRE_AND_ASIDE)[0] < 0.5


def test_without_depth_maps_nothing_is_known():
    cameras = ring_of_cameras()
    for nothing in (Evidence.none("cpu"), Evidence.of([None] * len(cameras), cameras, "cpu")):
        assert nothing.known.abs().max() == nothing.shiny.abs().max() == 0
