"""The table of charts, and what is measured of one mesh."""

from __future__ import annotations

import numpy as np
import trimesh

from benchmarks import charts
from stages import artifacts
from stages.drawing.rendering import look_at

WAY = {
    "charts": 16, "fill": 0.601, "seam_length": 7.63, "stretch": 1.0836, "mirrored": 0.0, "faces": 99999,
    "vertices": 1.03, "size": 1024, "texels_a_pixel": 1.29, "cpu_s": 25.5, "child_gib": 0.29,
}  # fmt: skip


def test_a_way_that_failed_has_a_row():
    result = {"name": "bird", "ways": {"uvatlas": WAY, "xatlas": {"failed": "xatlas ended with code -11"}}}
    lines = charts.chart_table([result]).splitlines()
    assert lines[2] == "| bird | uvatlas | 16 | 60 % | 7.6 | 1.084 | 0 % | 1.03 | 1024 | 1.29 | 25.5 | 0.29 |"
    assert lines[3].startswith("| bird | xatlas | failed |")
    assert len({line.count("|") for line in lines}) == 1


def test_a_texel_a_pixel_is_told(tmp_path):
    ball = trimesh.creation.icosphere(3)
    for name in ("cleanup", "train"):
        (tmp_path / name).mkdir()
    mesh = np.asarray(ball.vertices, np.float32), np.asarray(ball.faces, np.int32)
    artifacts.CLEAN_MESH.save(tmp_path / "cleanup", mesh)
    artifacts.CAMERAS.save(
        tmp_path / "train", look_at(np.array([0, -4.0, 0]), np.zeros(3), np.array([0, 0, 1.0]), 2000, 2000)
    )
    way = charts.measure_way(tmp_path, "xatlas")
    assert way["charts"] > 1
    assert way["cpu_s"] > 0
    # the texture is the smallest or has a texel for nearly each pixel
    assert way["size"] == 1024 or 0.8 < way["texels_a_pixel"] < 2.5
