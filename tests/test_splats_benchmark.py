"""The tables of splats: what is scored, and what they cost."""

from __future__ import annotations

from benchmarks import splats

SCORES = {
    "field": {"psnr": 27.281, "ssim": 0.8561},
    "mesh": {"psnr": 26.85, "ssim": 0.897},
    "least squares": {"psnr": 28.92, "ssim": 0.904},
    "refined": {"psnr": 30.456, "ssim": 0.9254},
}
COST = {"gaussians": 149040, "cpu_s": 20.4, "wall_s": 22.0, "gib": 0.781, "bytes": {"ply": 37e6, "spz": 5.49e6}}


def test_each_way_has_its_scores_and_its_cost():
    result = {"name": "helmet", "photos": 6, "scores": SCORES, "costs": {"least squares": COST, "refined": COST}}
    row = splats.score_table([result]).splitlines()[2]
    assert row == "| helmet | 6 | 27.28 / 0.856 | 26.85 / 0.897 | 28.92 / 0.904 | 30.46 / 0.925 |"
    lines = splats.cost_table([result]).splitlines()[2:]
    assert lines[0] == "| helmet | least squares | 149,040 | 20 | 0.78 | 37.0 | 0.0 | 5.5 |"
    assert lines[1].startswith("| helmet | refined |")
