"""What libraries make of a mesh with fewer faces: seconds, soundness, distance to the mesh they were given.

python -m benchmarks.decimation MESH.ply ... [--faces 100000 30000]

Prints a Markdown table: CPU seconds; faces; edges + vertices not manifold; open edges once these are mended, of
a mesh that had none; mean and largest distance to the mesh / from it, in percent of its extent. Includes
fast-simplification where that is installed.
"""

from __future__ import annotations

import argparse
import importlib.util
import time
from pathlib import Path

import numpy as np
import open3d as o3d
import trimesh

from stages.surface.decimation import decimate
from stages.surface.triangle_mesh import mesh_state, raycaster, repair_manifold

Mesh = tuple[np.ndarray, np.ndarray]
SAMPLES = 300_000


def by_open3d(vertices: np.ndarray, faces: np.ndarray, target: int) -> Mesh:
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(vertices.astype(np.float64)), o3d.utility.Vector3iVector(faces)
    ).simplify_quadric_decimation(target)
    return np.asarray(mesh.vertices, dtype=np.float32), np.asarray(mesh.triangles)


def by_fast_simplification(vertices: np.ndarray, faces: np.ndarray, target: int) -> Mesh:
    import fast_simplification

    return fast_simplification.simplify(vertices, faces, target_count=target, agg=3)


METHODS = {"pymeshlab (ours)": decimate, "Open3D": by_open3d}
if importlib.util.find_spec("fast_simplification"):
    METHODS["fast-simplification"] = by_fast_simplification


def distances(of: Mesh, to: Mesh) -> np.ndarray:
    """Distance [SAMPLES] of points spread evenly over one mesh to the other."""
    points, _ = trimesh.sample.sample_surface(trimesh.Trimesh(*of, process=False), SAMPLES, seed=0)
    return raycaster(*to).compute_distance(o3d.core.Tensor(np.asarray(points, dtype=np.float32))).numpy()


def row(name: str, mesh: Mesh, target: int) -> str:
    started = time.process_time()
    light = METHODS[name](*mesh, target)
    seconds = time.process_time() - started
    state, percent = mesh_state(light[1]), 100 / np.ptp(mesh[0], axis=0).max()
    out, back = (distances(*pair) * percent for pair in ((light, mesh), (mesh, light)))
    holes = "-" if mesh_state(mesh[1]).open_edges else mesh_state(repair_manifold(*light)[1]).open_edges
    return (
        f"| {name} | {target} | {seconds:.2f} | {len(light[1])} | {state.bad_edges} + {state.bad_vertices} | {holes} "
        f"| {out.mean():.4f} / {back.mean():.4f} | {out.max():.2f} / {back.max():.2f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("meshes", nargs="+", type=Path)
    parser.add_argument("--faces", nargs="+", type=int, default=[100_000, 30_000])
    arguments = parser.parse_args()
    for path in arguments.meshes:
        loaded = trimesh.load(path, process=False)
        mesh = repair_manifold(np.asarray(loaded.vertices, np.float32), np.asarray(loaded.faces, np.int32))
        print(f"\n{path}: {len(mesh[1])} faces, {mesh_state(mesh[1]).open_edges} open edges\n")
        print("| by | target | s | faces | bad | holes | mean, % | largest, % |\n|---|---|---|---|---|---|---|---|")
        for target in arguments.faces:
            for name in METHODS:
                print(row(name, mesh, target), flush=True)


if __name__ == "__main__":
    main()
