"""xatlas in a process of its own, so that a time limit can end it, given IN and OUT.

Nearly all its time goes into the charts, so they are made once; then they are packed again and again at other scales
until they fill the texture.

IN (.npz): vertices [V, 3] float32, faces [F, 3], max_chart_area, resolution and padding in texels.
OUT (.npz): source [W] vertex of the input that each output vertex copies, faces [F, 3], texels [W, 2].
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

# Twice xatlas's own: a fifth fewer charts, and so less padding, on bumpy surfaces in the same time.
MAX_COST = 4.0
# xatlas stretches each chart's sides to whole texels whenever it packs. The first time the texels are finer than the
# texture's, within these bounds: finer ones take longer than the charts.
FINER = 2
FINEST = 4096
COARSEST = 2048
# Attempts at a scale of the charts at which they fit the texture.
MAX_PACKINGS = 6
# Full enough: of the texture's side.
FULL = 0.99
# What xatlas calls the chart of a vertex that is in none.
NO_CHART = 2**32 - 1


@dataclass(frozen=True)
class _Charts:
    """A mesh cut into charts.

    Attributes:
        source: [W] vertex that each split one copies.
        faces: [F, 3] split vertices.
        texels: [W, 2] where they lie in the plane, in texels of the first packing.
        count: number of charts.
    """

    source: np.ndarray
    faces: np.ndarray
    texels: np.ndarray
    count: int


def main(source: Path, target: Path) -> None:
    with np.load(source) as data:
        job = {key: data[key] for key in data.files}
    resolution, padding = int(job["resolution"]), int(job["padding"])
    fine_resolution = min(max(FINER * resolution, COARSEST), FINEST)
    charts = _charts(job["vertices"], job["faces"], float(job["max_chart_area"]), fine_resolution)
    texels = _fitted(charts, resolution, padding)
    partial = target.with_name(target.name + ".part")
    with partial.open("wb") as file:
        np.savez(file, source=charts.source, faces=charts.faces, texels=texels)
    os.replace(partial, target)


def _charts(vertices: np.ndarray, faces: np.ndarray, max_chart_area: float, resolution: int) -> _Charts:
    import xatlas

    atlas = xatlas.Atlas()
    atlas.add_mesh(vertices.astype(np.float32), faces.astype(np.uint32))
    options = xatlas.ChartOptions()
    options.max_chart_area = max_chart_area
    options.max_cost = MAX_COST
    packing = xatlas.PackOptions()
    packing.resolution = resolution
    packing.padding = 1  # charts that touch would be taken for one when they are packed again
    atlas.generate(options, packing)
    source, new_faces, uvs = atlas[0]
    return _Charts(source, new_faces, uvs * np.array([atlas.width, atlas.height]), atlas.chart_count)


def _fitted(charts: _Charts, resolution: int, padding: int) -> np.ndarray:
    """Texels [W, 2] of the charts at the largest scale found at which they fit `resolution` texels a side."""
    best, largest = None, 0.0
    # As if charts were squares of one size; small ones lose more to padding.
    in_a_row = np.sqrt(charts.count)
    scale = max(resolution / in_a_row - 2 * padding, 1.0) / (float(charts.texels.max()) / in_a_row)
    for _ in range(MAX_PACKINGS):
        texels, side = _packed(charts, scale, padding)
        if side <= resolution and scale > largest:
            best, largest = texels, scale
            if side >= FULL * resolution:
                break
        scale *= (1 + FULL) / 2 * resolution / side
    # More charts than have room with their padding: the last attempt as it is, its padding shrunk.
    return texels * (resolution / side) if best is None else best


def _packed(charts: _Charts, scale: float, padding: int) -> tuple[np.ndarray, float]:
    """Texels [W, 2] of the charts at this scale, without overlaps, and the side that they need."""
    import xatlas

    atlas, faces = xatlas.Atlas(), charts.faces
    atlas.add_uv_mesh(charts.texels.astype(np.float32), faces.astype(np.uint32))
    packing = xatlas.PackOptions()
    packing.texels_per_unit = scale
    packing.padding = padding
    packing.bilinear = True
    atlas.generate(xatlas.ChartOptions(), packing)
    _, _, uvs = atlas[0]
    texels = uvs * np.array([atlas.width, atlas.height])
    # Vertices of nothing but faces without area are in no chart, and were not moved with one.
    lost = atlas.get_mesh_vertex_assignment(0)[1] == NO_CHART
    for corner in range(3):
        stray = lost[faces[:, corner]]
        for other in ((corner + 1) % 3, (corner + 2) % 3):
            rows = stray & ~lost[faces[:, other]]
            texels[faces[rows, corner]] = texels[faces[rows, other]]
            stray &= ~rows
        texels[faces[stray, corner]] = 0
    return texels, float(max(atlas.width, atlas.height))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
