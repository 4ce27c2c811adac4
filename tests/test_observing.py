"""The compiled loops of baking, on numbers made by hand."""

from __future__ import annotations

import numpy as np

from stages.texture.observing import STEPS_SIGNED, STEPS_UNSIGNED, blend_texels


def _blend(weights: list[float], lows: list[float], highs: list[float], **options: object) -> np.ndarray:
    """The colour of one texel whose views have these weights (one more than count), low and high bands, all grey."""
    best_lows = np.repeat(np.array(lows)[None, :, None] * STEPS_UNSIGNED, 3, 2).astype(np.uint16)
    best_highs = np.repeat(np.array(highs)[None, :, None] * STEPS_SIGNED, 3, 2).astype(np.int16)
    colors = np.zeros((1, 3), np.uint8)
    settings = {"detail": True, "robust_sigma": 1e6, "diffuse": False} | options
    blend_texels(np.float32([weights]), best_lows, best_highs, colors=colors, **settings)
    return colors[0]


def test_the_low_band_takes_many_photos_and_the_high_band_the_best():
    # weights 4 and 1: the low band counts 2 : 1, the high band 4 : 1
    assert _blend([4, 1, 0], [100, 112, 0], [0, 0, 0])[0] == 104
    assert _blend([4, 1, 0], [100, 100, 0], [10, 0, 0])[0] == 108
    assert _blend([4, 1, 0], [100, 100, 0], [10, 0, 0], detail=False)[0] == 100
    assert (_blend([0, 0, 0], [0, 0, 0], [0, 0, 0]) == 0).all()


def test_a_view_fades_out_before_it_leaves_the_set():
    assert _blend([4, 1, 1], [100, 160, 0], [0, 0, 0])[0] in (100, 101)
    assert _blend([1, 1, 1], [100, 120, 0], [0, 0, 0])[0] == 110  # equal ones: all the same


def test_an_outlier_counts_nothing_and_takes_its_detail_with_it():
    assert _blend([1, 1, 1, 1, 0], [100, 100, 100, 250, 0], [0, 0, 0, 80, 0], robust_sigma=10.0)[0] == 100


def test_a_brighter_view_counts_less_where_the_diffuse_colour_is_asked_for():
    weights, none = [1.0, 1, 1, 1, 0], [0.0] * 5

    def grey(odd: float, diffuse: bool) -> int:
        lows = [100.0, 100, 100, odd, 0]
        return int(_blend(weights, lows, none, robust_sigma=10.0, diffuse=diffuse)[0])

    assert 102 <= grey(120, False) <= 104
    assert grey(120, True) < grey(120, False)
    assert grey(80, True) == grey(80, False)
