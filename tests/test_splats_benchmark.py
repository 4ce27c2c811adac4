"""The tables of splats: what is scored, and what they cost."""

from __future__ import annotations

from benchmarks import splats
from stages.evaluation.suites.registry import SUITES
from stages.evaluation.suites.tables import views_table

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


def test_a_suite_has_columns_of_splats_where_a_run_has_some():
    mean = {"field": {"whole": {"psnr": 20.0, "ssim": 0.5}}, "mesh": {}}
    run = {"scene": "ship", "method": "peer", "seed": 0, "scores": {"views": {"counted": 2, "mean": mean}}}
    assert "splats, object" not in views_table(SUITES["nerf-synthetic"], [run]).header
    mean["splats"] = {"object": {"psnr": 31.5, "ssim": 0.9}}
    table = views_table(SUITES["nerf-synthetic"], [run])
    assert table.rows[0][table.header.index("splats, object")] == "31.50 / 0.900"
    assert table.rows[0][table.header.index("field, whole")] == "20.00 / 0.500"
