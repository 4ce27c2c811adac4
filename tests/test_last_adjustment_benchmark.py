"""The benchmark of the last adjustment: truth, one row on a made-up model, result files and the table."""

from __future__ import annotations

import numpy as np
import pytest
from test_adjustment import SHIFT, capture, mapped

from benchmarks import last_adjustment as bench
from stages import artifacts
from stages.posing.adjustment import PRINCIPAL_POINT


@pytest.fixture
def facade(tmp_path, monkeypatch):
    """A surveyed set and its model as mapping leaves it, the world turned and in metres of a hundredth of its unit."""
    monkeypatch.setattr(bench, "ROWS", tmp_path / "rows")
    truth = capture(SHIFT)
    folder = tmp_path / "data" / "facade"
    for name in ("images", bench.SURVEYED):
        (folder / name).mkdir(parents=True)
    for image in truth.images.values():
        center = 0.01 * image.projection_center()[[1, 2, 0]]
        lines = ["900 0 512", "0 900 384", "0 0 1", "0 0 0", "1 0 0", "0 1 0", "0 0 1", " ".join(map(str, center))]
        (folder / bench.SURVEYED / f"{image.name}.camera").write_text("\n".join([*lines, "1024 768"]))
    model = artifacts.MODEL.load(tmp_path / "models" / "facade" / "sfm")
    model.mkdir(parents=True)
    mapped(truth).write(str(model))
    return tmp_path


def test_a_row_has_the_errors_before_and_after_in_millimetres(facade):
    row = bench.run_row("facade", facade / "data", facade / "models")
    assert row.freed == (PRINCIPAL_POINT,)
    assert (row.unit, row.photos) == ("mm", 12)
    assert row.error["with"][0] < row.error["without"][0] / 3
    assert row.expected == pytest.approx(row.error["with"][0], rel=0.5)
    assert row.gain_percent[PRINCIPAL_POINT] > 10
    bench.save_row(row)
    (line,) = bench.tables()["last-adjustment"].splitlines()[2:]
    assert line.startswith(f"| facade | {row.error['without'][0]:.3g} mm | {row.error['with'][0]:.3g} mm |")


def test_a_set_without_known_cameras_says_so(facade):
    (facade / "data" / "plain" / "images").mkdir(parents=True)
    with pytest.raises(ValueError, match="cameras of plain are not known"):
        bench.known_centers("plain", facade / "data", [])


def test_surveyed_centers_are_the_last_line_but_one(facade):
    centers = bench.surveyed_centers(facade / "data" / "facade")
    assert len(centers) == 12
    assert all(np.linalg.norm(center) < 0.2 for center in centers.values())
