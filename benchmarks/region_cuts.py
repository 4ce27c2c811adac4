"""Whether a region that cuts the subject is found out, and no other: `stages.surface.border` on true surfaces.

python -m benchmarks.region_cuts                    the captures of `benchmarks.regions`, made-up ones and the suite's
python -m benchmarks.region_cuts --only "trophy;pair"   these, a line a region
python -m benchmarks.region_cuts --table-only       only rewrite the table of docs/benchmarks/regions.md

Each capture is looked at in the region that is found, in larger and smaller ones, and in one that is moved up. The mesh
is its true surface within the region.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass

import numpy as np

from benchmarks.captures import kinds, suite
from benchmarks.captures.model import Capture, joined
from benchmarks.captures.subject import seen_points
from benchmarks.captures.tracks import simulate
from benchmarks.pages import NOT_MEASURED, markdown_table, write_tables
from benchmarks.run_sets import RESULTS as ALL_RESULTS
from benchmarks.synthetic.scenes import RECIPES
from stages import artifacts
from stages.geometry.layout import find_layout
from stages.geometry.normalisation import into_frame, scene_frame
from stages.geometry.similarity import Similarity
from stages.surface.border import border_cut, region_without_cut
from stages.surface.triangle_mesh import compact

RESULTS = ALL_RESULTS / "regions" / "cuts.json"
# The found region's radius times this, moved up by this part of it.
REGIONS = ((1.3, 0.0), (1.0, 0.0), (0.8, 0.0), (0.6, 0.0), (0.4, 0.0), (0.7, 0.3))
WHOLE = 99.5  # percent of the subject's seen surface inside
LONGEST_EDGE = 0.06  # of the mesh, in radii of the region


@dataclass(frozen=True)
class Row:
    """A capture in a region.

    Attributes:
        scale, moved: as in `REGIONS`.
        inside: percent of the subject's seen surface. photos: that show the cut, 0 where none was found.
        radius: of the region that goes on there, in this one's; inside_then: of the subject in it.
    """

    name: str
    scale: float
    moved: float
    inside: float
    photos: int
    radius: float
    inside_then: float


def look(name: str) -> Iterator[Row]:
    """The rows of a capture."""
    capture = kinds.make(name) if name in kinds.KINDS else suite.make(name)
    posed, subject = simulate(capture, np.random.default_rng(0)), seen_points(capture)
    region, ground, up = find_layout(posed.cameras, posed.points, posed.observations)
    for scale, moved in REGIONS:
        frame = scene_frame(region.center + moved * region.radius * up.direction, scale * region.radius, up.direction)
        mesh, points = surface_in(capture, frame), frame.inverse().apply(subject)
        cut = border_cut(*mesh, into_frame(posed.cameras, frame), ground and ground.within(frame))
        center, radius = region_without_cut(cut) if cut else (np.zeros(3), 1.0)
        inside, then = _percent_inside(points, np.zeros(3), 1.0), _percent_inside(points, center, radius)
        yield Row(name, scale, moved, inside, cut.photos if cut else 0, round(radius, 2), then)


def _percent_inside(points: np.ndarray, center: np.ndarray, radius: float) -> float:
    return round(100 * float((np.linalg.norm(points - center, axis=1) < radius).mean()), 2)


def surface_in(capture: Capture, frame: Similarity) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces, with both sides, of all that lies within the unit sphere of a frame; edges are short."""
    import trimesh

    mesh = joined(capture.subject + capture.surroundings)
    vertices, faces = frame.inverse().apply(mesh.vertices.astype(np.float64)), mesh.faces
    while True:
        low, high = vertices[faces].min(1), vertices[faces].max(1)
        vertices, faces = compact(vertices, faces[((low < 1) & (high > -1)).all(1)])
        edges = np.linalg.norm(vertices[faces] - vertices[np.roll(faces, 1, 1)], axis=2)
        long = edges.max(1) > LONGEST_EDGE
        if not long.any():
            break
        finer, parts = trimesh.remesh.subdivide(*compact(vertices, faces[long]))
        faces = np.concatenate([faces[~long], parts + len(vertices)])
        vertices = np.concatenate([vertices, finer])
    inside = (np.linalg.norm(vertices, axis=1) < 1)[faces].all(1)
    vertices, faces = compact(vertices, faces[inside])
    return np.concatenate([vertices, vertices]), np.concatenate([faces, faces[:, ::-1] + len(vertices)])


# ---------------------------------------------------------------- table
def cuts_table(rows: Sequence[Row]) -> str:
    """A row a region: what was found where the subject is cut, and where it is whole."""
    header = ["region", "subject cut", "found", "whole in the grown one", "subject whole", "wrongly found"]
    return markdown_table(header, [_cells(scale, moved, rows) for scale, moved in REGIONS])


def _cells(scale: float, moved: float, rows: Sequence[Row]) -> list[str]:
    chosen = [row for row in rows if (row.scale, row.moved) == (scale, moved)]
    cut = [row for row in chosen if row.inside < WHOLE]
    found = [row for row in cut if row.radius > 1]
    whole = [row for row in chosen if row.inside >= WHOLE]
    counts = [cut, found, [row for row in found if row.inside_then >= WHOLE], whole, [r for r in whole if r.radius > 1]]
    return [f"{scale} of the radius{', moved up' if moved else ''}", *(str(len(part)) for part in counts)]


def load_rows() -> list[Row]:
    return [Row(**row) for row in artifacts.read_json(RESULTS)] if RESULTS.exists() else []


def tables() -> dict[str, str]:
    """The table, from the result file."""
    rows = load_rows()
    return {"region cuts": cuts_table(rows) if rows else NOT_MEASURED}


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="names, with semicolons between; default: all")
    parser.add_argument("--table-only", action="store_true", help="only rewrite the table")
    arguments = parser.parse_args(argv)
    names = [name for name in arguments.only.split(";") if name] or [*kinds.KINDS, *RECIPES]
    if not arguments.table_only:
        rows = [row for row in load_rows() if row.name not in names]
        for name in names:
            for row in look(name):
                rows.append(row)
                print(row, file=sys.stderr, flush=True)
        artifacts.write_json(RESULTS, [asdict(row) for row in rows])
    write_tables(tables())
    return 0


if __name__ == "__main__":
    sys.exit(main())
