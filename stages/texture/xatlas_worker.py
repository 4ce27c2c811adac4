"""xatlas in a process of its own, so that a time limit can end it: `python -m stages.texture.xatlas_worker IN OUT`.

IN (.npz): vertices [V, 3] float32, faces [F, 3], max_chart_area, resolution and padding in texels.
OUT (.npz): source [W] vertex of the input that each output vertex copies, faces [F, 3], texels [W, 2].
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np

# xatlas takes the resolution as a wish and mostly exceeds it, by a tenth with some hundred charts.
FIRST_WISH = 0.9
# Twice xatlas's own: a fifth fewer charts, and so less padding, on bumpy surfaces in the same time.
MAX_COST = 4.0
# Attempts at charts that fit the texture.
MAX_PACKINGS = 5


def main(source: Path, target: Path) -> None:
    import xatlas

    with np.load(source) as data:
        job = {key: data[key] for key in data.files}
    resolution = int(job["resolution"])
    request = int(FIRST_WISH * resolution)
    for _ in range(MAX_PACKINGS):
        atlas = xatlas.Atlas()
        atlas.add_mesh(job["vertices"].astype(np.float32), job["faces"].astype(np.uint32))
        charts = xatlas.ChartOptions()
        charts.max_chart_area = float(job["max_chart_area"])
        charts.max_cost = MAX_COST
        pack = xatlas.PackOptions()
        pack.resolution = request
        pack.padding = int(job["padding"])
        pack.bilinear = True
        atlas.generate(charts, pack)
        largest = max(atlas.width, atlas.height)
        if largest <= resolution:
            break
        # Scaling the result down instead would eat the padding.
        request = max(int(request * 0.995 * resolution / largest), 16)
    mapping, faces, uvs = atlas[0]
    texels = uvs * np.array([atlas.width, atlas.height]) * (max(1.0, resolution / largest))
    partial = target.with_name(target.name + ".part")
    with partial.open("wb") as file:
        np.savez(file, source=mapping, faces=faces, texels=texels)
    os.replace(partial, target)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
