"""Microsoft's UVAtlas, which Open3D brings along, in a process of its own so that a time limit can end it: IN and OUT.

It grows charts until stretch reaches a bound and cuts where that costs least (Zhou et al., "Iso-charts: Stretch-driven
Mesh Parameterization using Spectral Analysis", 2004). It is used with one partition and so one thread: more would cut
charts along straight planes, differently for each number of threads.

IN (.npz): vertices [V, 3] float32, faces [F, 3] of an oriented manifold, resolution and padding in texels.
OUT (.npz): texels [F, 3, 2] float32 of each face's corners, in [0, resolution].
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np

from stages.texture.random_device import answer_always_one

# Of 0 (none allowed) to 1: UVAtlas's own default.
MAX_STRETCH = 1 / 6


def main(source: Path, target: Path) -> None:
    with np.load(source) as data:
        job = {key: data[key] for key in data.files}
    texels = _charts(job["vertices"], job["faces"], int(job["resolution"]), int(job["padding"]))
    partial = target.with_name(target.name + ".part")
    with partial.open("wb") as file:
        np.savez(file, texels=texels)
    os.replace(partial, target)


def _charts(vertices: np.ndarray, faces: np.ndarray, resolution: int, padding: int) -> np.ndarray:
    answer_always_one()  # UVAtlas looks for better places of vertices at random
    import open3d as o3d

    mesh = o3d.t.geometry.TriangleMesh(
        o3d.core.Tensor(np.ascontiguousarray(vertices, np.float32)),
        o3d.core.Tensor(np.ascontiguousarray(faces, np.int64)),
    )
    mesh.compute_uvatlas(size=resolution, gutter=float(padding), max_stretch=MAX_STRETCH)
    return np.asarray(mesh.triangle.texture_uvs.numpy() * np.float32(resolution))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
