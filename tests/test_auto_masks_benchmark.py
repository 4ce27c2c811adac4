"""The tables of the masks that a network makes."""

from __future__ import annotations

from benchmarks import auto_masks

COST = {"network_cpu_s": 2.0, "agreement_cpu_s": 0.4}
KNOWN = {
    "name": "known", "photos": 4, "agreement": [0.9, 0.85, 0.5, None], "used": 0, "iou": [0.97, 0.91, 0.4, 0.0],
    "cut": [[2.0, 1.0], [0.0, 1.5], [0.0, 9.0]], "cut_by_truth": [[0.0, 1.0], [0.0, 1.0], [0.0, 8.0]], **COST,
}  # fmt: skip
REAL = {"name": "real", "photos": 2, "agreement": [0.9, 0.9], "used": 2, **COST}


def test_the_table_tells_good_masks_from_those_that_fit():
    lines = auto_masks.agreement_table([KNOWN, REAL]).splitlines()
    assert lines[2] == "| known | 4 | 2 | 0 | 0.66 | 0.91 | 0.40 | 0.60 |"
    assert lines[3] == "| real | 2 | 2 | 2 | - | - | - | 1.20 |"


def test_the_cut_is_shown_for_made_and_true_masks_where_the_truth_is_known():
    lines = auto_masks.cut_table([KNOWN, REAL]).splitlines()
    assert lines[2:] == [
        "| known, made, all of them | 2.0 / 1.0 | 0.0 / 1.5 | 0.0 / 9.0 |",
        "| known, true | 0.0 / 1.0 | 0.0 / 1.0 | 0.0 / 8.0 |",
    ]
