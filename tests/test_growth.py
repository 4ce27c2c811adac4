"""How time and memory grow: the photos a row takes, and its table."""

from __future__ import annotations

import numpy as np
import pytest
from PIL import Image

from benchmarks import growth
from benchmarks.run_sets import GIB


def test_photos_are_chosen_evenly_and_enlarged_with_their_exif(tmp_path):
    source = tmp_path / "photos"
    source.mkdir()
    exif = Image.Exif()
    exif[0x010F] = "maker"
    for index in range(6):
        Image.fromarray(np.full((6, 8, 3), 40 * index, np.uint8)).save(source / f"{index}.jpg", exif=exif)
    assert growth.make_photos(source, 3, 2, tmp_path / "few") == (3, 16 * 12)
    names = sorted(path.name for path in (tmp_path / "few").iterdir())
    assert names == ["0.jpg", "2.jpg", "4.jpg"]
    with Image.open(tmp_path / "few" / "2.jpg") as photo:
        assert photo.size == (16, 12)
        assert photo.getexif()[0x010F] == "maker"
        assert np.asarray(photo).mean() == pytest.approx(80, abs=2)
    assert growth.make_photos(source, None, 1, tmp_path / "all") == (6, 8 * 6)
    assert (tmp_path / "all" / "0.jpg").read_bytes() == (source / "0.jpg").read_bytes()


def test_the_table_has_a_column_a_stage_and_the_peaks():
    seconds = dict.fromkeys(growth.STAGES, 1.0)
    memory = {stage: GIB for stage in growth.STAGES} | {"bake": 3 * GIB, "train": 2 * GIB}
    rows = [
        growth.Row("all photos", "set", 47, 300_000, seconds, memory, 1234, {}),
        growth.Row(growth.BIG, "", 300, 2_000_000, {"train": 30.0}, {"train": 2 * GIB}, None, {}),
    ]
    lines = growth.growth_table(rows).splitlines()
    assert len({line.count("|") for line in lines}) == 1
    assert lines[2] == "| 47 photos | 0.3 | 1234 | " + "1.0 | " * len(growth.STAGES) + "3.00 | 2.00 |"
    assert lines[3].endswith("| 2.00 | 2.00 |")
