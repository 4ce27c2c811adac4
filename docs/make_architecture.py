"""Draw the rooms of the code from its imports: docs/images/rooms.svg, and the table of docs/architecture.md.

python -m docs.make_architecture

A room is what the layers in pyproject.toml name: a package or a module. The files of the pipeline's stages make one
room. A package outside the layers (the settings) stands right above what it imports.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from statistics import fmean

import grimp

from benchmarks.pages import markdown_table, write_tables
from stages.pipeline import PIPELINE

if sys.version_info >= (3, 11):
    import tomllib
else:  # import-linter brings it
    import tomli as tomllib

ROOT = Path(__file__).parent.parent
PICTURE = ROOT / "docs" / "images" / "rooms.svg"
STAGES = "the stages"

Room = str
Edge = tuple[Room, Room]

# Sizes of the picture in pixels.
ROW, BOX, CHAR, PAD, GAP, MARGIN = 58, 32, 7.6, 24, 22, 16
SWEEPS = 24


# ---------------------------------------------------------------- rooms and imports
def layers() -> list[list[str]]:
    """The layers of the contract in pyproject.toml, from the top; each a list of modules."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = project["tool"]["importlinter"]["contracts"]
    contract = next(contract for contract in contracts if contract["type"] == "layers")
    return [[name.strip(" ()") for name in layer.replace(":", "|").split("|")] for layer in contract["layers"]]


def source_of(module: str) -> Path:
    """The file of a module or package."""
    path = ROOT / module.replace(".", "/")
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


def rooms() -> tuple[list[list[Room]], dict[str, Room]]:
    """Rows of rooms from the top, and the room of each module that the contract names.

    Modules that the contract names but that are not there (its optional layers) are left out.
    """
    stages = {f"stages.{stage.name}" for stage in PIPELINE}
    rows: list[list[Room]] = []
    room_of: dict[str, Room] = {}
    for layer in layers():
        modules = [module for module in layer if source_of(module).exists()]
        names = {module: STAGES if module in stages else module for module in modules}
        rows += [list(dict.fromkeys(names.values()))] if names else []
        room_of |= names
    return rows, room_of


def imports(room_of: dict[str, Room]) -> set[Edge]:
    """Which room imports which, over all modules of the packages.

    Raises:
        ValueError: a module of a package that the contract cuts into layers is in none of them.
    """
    packages = sorted(path.parent.name for path in ROOT.glob("*/__init__.py") if path.parent.name in _packages())
    graph = grimp.build_graph(*packages, cache_dir=None)
    divided = {module.split(".")[0] for module in room_of if "." in module}

    def room(module: str) -> Room | None:
        parts = module.split(".")
        for length in range(len(parts), 0, -1):
            if found := room_of.get(".".join(parts[:length])):
                return found
        if parts[0] in divided:
            if len(parts) == 1:
                return None  # the package's own file belongs to no room
            raise ValueError(f"{module} is in no layer of pyproject.toml")
        return parts[0]

    found = set()
    for module in graph.modules:
        found |= {(room(module), room(other)) for other in graph.find_modules_directly_imported_by(module)}
    return {(a, b) for a, b in found if a is not None and b is not None and a != b}


def _packages() -> list[str]:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    return project["tool"]["importlinter"]["root_packages"]


def placed(rows: Sequence[Sequence[Room]], edges: Iterable[Edge]) -> list[list[Room]]:
    """The rows with every room that imports or is imported: new ones right above what they import.

    Raises:
        ValueError: an import does not go down.
    """
    edges = sorted(edges)
    made = [list(row) for row in rows]
    for new in sorted({room for edge in edges for room in edge} - {room for row in rows for room in row}):
        below = [i for i, row in enumerate(made) for room in row if (new, room) in edges]
        made[max(min(below, default=len(made)) - 1, 0)].append(new)
    height = {room: i for i, row in enumerate(made) for room in row}
    if upward := [f"{a} imports {b}" for a, b in edges if height[a] >= height[b]]:
        raise ValueError(f"imports that do not go down: {'; '.join(upward)}")
    return made


def reduced(edges: Iterable[Edge]) -> set[Edge]:
    """The edges that no other path replaces."""
    edges = set(edges)
    after: dict[Room, set[Room]] = {}
    for a, b in edges:
        after.setdefault(a, set()).add(b)

    def reach(room: Room) -> set[Room]:
        return after.get(room, set()).union(*(reach(other) for other in after.get(room, ())))

    return {(a, b) for a, b in edges if not any(b in reach(other) for other in after[a] - {b})}


# ---------------------------------------------------------------- table
def said(module: str) -> str:
    """The first sentence of a module's docstring."""
    text = ast.get_docstring(ast.parse(source_of(module).read_text(encoding="utf-8"))) or ""
    sentence = " ".join(text.split("\n\n")[0].split())
    return sentence.split(". ")[0].rstrip(".") + "."


def short(room: Room) -> str:
    return room.removeprefix("stages.")


def rooms_table(rows: Sequence[Sequence[Room]], edges: Iterable[Edge]) -> str:
    """A row a room, from the top: where it is, what it says of itself, what it imports."""
    order = [room for row in rows for room in row]
    lines = []
    for room in order:
        if room == STAGES:
            where = "`stages/*.py`"
            what = f"One file a stage: {', '.join(stage.name for stage in PIPELINE)}."
        else:
            file = source_of(room)
            where = f"`{(file.parent if file.name == '__init__.py' else file).relative_to(ROOT)}`"
            where = where[:-1] + "/`" if file.name == "__init__.py" else where
            what = said(room)
        lines.append([where, what, ", ".join(short(b) for b in order if (room, b) in edges) or "-"])
    return markdown_table(["room", "what is in it", "imports"], lines).replace("---:", "---")


# ---------------------------------------------------------------- picture
def picture(rows: Sequence[Sequence[Room]], edges: Iterable[Edge]) -> str:
    """An SVG: rooms in rows, an arrow for each import that no other path replaces."""
    height = {room: i for i, row in enumerate(rows) for room in row}
    ways = [_way(edge, height) for edge in sorted(reduced(edges))]
    labels = {room: short(room) for room in height}
    labels[STAGES] = " · ".join(stage.name for stage in PIPELINE)
    widths = {room: len(label) * CHAR + PAD for room, label in labels.items()}
    x = _columns(rows, ways, widths)
    left = min(x[room] - widths.get(room, 0) / 2 for room in x) - MARGIN
    right = max(x[room] + widths.get(room, 0) / 2 for room in x) + MARGIN
    width, tall = round(right - left), len(rows) * ROW - (ROW - BOX) + 2 * MARGIN

    def top(row: int) -> int:
        return MARGIN + row * ROW

    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {tall}" width="{width}" height="{tall}" '
        'font-family="system-ui, sans-serif" font-size="14">',
        "<title>The rooms of the code and who imports whom</title>",
        '<defs><marker id="tip" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        '<path d="M0 0L8 4L0 8z" fill="#8a94a3"/></marker></defs>',
        f'<rect width="{width}" height="{tall}" fill="#fff"/>',
    ]
    for way in ways:
        d = f"M{x[way[0]] - left:.0f} {top(height[way[0]]) + BOX}"
        for i, node in enumerate(way[1:], start=height[way[0]] + 1):
            here, before = x[node] - left, x[way[i - height[way[0]] - 1]] - left
            middle = top(i) - (ROW - BOX) / 2
            d += f"C{before:.0f} {middle:.0f} {here:.0f} {middle:.0f} {here:.0f} {top(i)}"
            d += f"V{top(i) + BOX}" if node != way[-1] else ""
        lines.append(f'<path d="{d}" fill="none" stroke="#8a94a3" marker-end="url(#tip)"/>')
    for room, row in height.items():
        box, y = widths[room], top(row)
        fill = "#fdf1dc" if room == STAGES else "#e8eef7"
        lines.append(
            f'<rect x="{x[room] - left - box / 2:.0f}" y="{y}" width="{box:.0f}" height="{BOX}" rx="6" fill="{fill}" '
            f'stroke="#5b6b82"/><text x="{x[room] - left:.0f}" y="{y + BOX / 2 + 5:.0f}" text-anchor="middle">'
            f"{labels[room]}</text>"
        )
    return "\n".join([*lines, "</svg>"]) + "\n"


def _way(edge: Edge, height: dict[Room, int]) -> list[str]:
    """The edge's ends and, for each row between them, a place that it passes."""
    a, b = edge
    return [a, *(f"{a} -> {b} @{row}" for row in range(height[a] + 1, height[b])), b]


def _columns(
    rows: Sequence[Sequence[Room]], ways: Sequence[Sequence[str]], widths: dict[Room, float]
) -> dict[str, float]:
    """The middle of each room, and of each place that an arrow passes: near to what it is joined to."""
    height = {room: i for i, row in enumerate(rows) for room in row}
    levels = [list(row) for row in rows]
    near: dict[str, list[list[str]]] = {}
    for way in ways:
        for row, node in enumerate(way, start=height[way[0]]):
            if node not in height:
                levels[row].append(node)
        for above, below in pairwise(way):
            near.setdefault(below, [[], []])[0].append(above)
            near.setdefault(above, [[], []])[1].append(below)
    x = {node: float(place) for level in levels for place, node in enumerate(level)}
    for sweep in range(SWEEPS):
        side = sweep % 2  # down by what lies above, then up by what lies below
        for level in levels if side == 0 else reversed(levels):
            wanted = {node: fmean([x[n] for n in near.get(node, [[], []])[side]] or [x[node]]) for node in level}
            level.sort(key=lambda node: (wanted[node], node))
            right = float("-inf")
            for node in level:
                half = widths.get(node, 0) / 2
                x[node] = max(wanted[node], right + GAP + half)
                right = x[node] + half
            shift = fmean(wanted[node] - x[node] for node in level)
            x |= {node: x[node] + shift for node in level}
    return x


def made() -> tuple[str, str]:
    """The table and the picture."""
    rows, room_of = rooms()
    edges = imports(room_of)
    rows = placed(rows, edges)
    return rooms_table(rows, edges), picture(rows, edges)


if __name__ == "__main__":
    table, svg = made()
    write_tables({"rooms": table})
    PICTURE.write_text(svg, encoding="utf-8")
