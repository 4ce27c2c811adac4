"""The picture and the table of the rooms: up to date, and right on made-up rooms."""

from __future__ import annotations

import re
from itertools import combinations

import pytest

from benchmarks.pages import read_pages, with_tables

pytest.importorskip("grimp")
from docs import make_architecture as rooms


def test_the_picture_and_the_table_are_those_of_the_imports():
    table, svg = rooms.made()
    pages = read_pages()
    assert pages == with_tables(pages, {"rooms": table}), "run `make docs`"
    assert rooms.PICTURE.read_text(encoding="utf-8") == svg, "run `make docs`"


def test_every_layer_of_the_contract_has_a_row_and_a_stage_is_no_room_of_its_own():
    rows, room_of = rooms.rooms()
    assert len(rows) == len(rooms.layers())
    assert rows[0] == ["hineus_cli"]
    assert [rooms.STAGES] in rows
    assert room_of["stages.ingest"] == room_of["stages.bake"] == rooms.STAGES


def _reachable(edges, start):
    found, waiting = set(), [start]
    while waiting:
        for a, b in edges:
            if a == waiting[-1] and b not in found:
                found.add(b)
                waiting.insert(0, b)
        waiting.pop()
    return found


@pytest.mark.parametrize("seed", range(5))
def test_the_arrows_lead_wherever_imports_lead_and_none_can_be_spared(seed):
    edges = {(a, b) for i, (a, b) in enumerate(combinations("abcdefg", 2)) if (i * 7 + seed) % 3}
    kept = rooms.reduced(edges)
    assert kept < edges
    for node in "abcdefg":
        assert _reachable(kept, node) == _reachable(edges, node)
    for edge in kept:
        assert edge[1] not in _reachable(kept - {edge}, edge[0])


def test_a_package_outside_the_layers_stands_right_above_what_it_imports():
    rows = [["cli"], ["stages"], ["neural", "posing"], ["errors"]]
    edges = {("cli", "stages"), ("stages", "neural"), ("stages", "configs"), ("configs", "errors")}
    assert rooms.placed(rows, edges)[2] == ["neural", "posing", "configs"]


def test_an_import_that_does_not_go_down_is_an_error():
    with pytest.raises(ValueError, match="errors imports cli"):
        rooms.placed([["cli"], ["errors"]], {("cli", "errors"), ("errors", "cli")})
    with pytest.raises(ValueError, match="surface imports files"):
        rooms.placed([["files", "surface"]], {("surface", "files")})


def test_a_module_that_no_layer_names_is_an_error():
    _, room_of = rooms.rooms()
    del room_of["stages.texture"]
    with pytest.raises(ValueError, match=r"stages\.texture.* is in no layer"):
        rooms.imports(room_of)


def test_arrows_end_below_where_they_begin_and_boxes_do_not_overlap():
    _, svg = rooms.made()
    arrows = re.findall(r'<path d="M\S+ (\d+)C.*? (\d+)" fill="none"', svg)
    assert len(arrows) > 10
    assert all(int(begin) < int(end) for begin, end in arrows)
    found = re.findall(r'<rect x="(\d+)" y="(\d+)" width="(\d+)" height="\d+" rx', svg)
    boxes = [tuple(map(int, box)) for box in found]
    assert len(boxes) == sum(map(len, rooms.rooms()[0])) + len({"configs"})
    for (x, y, width), (other, level, _) in combinations(sorted(boxes), 2):
        assert y != level or x + width < other
