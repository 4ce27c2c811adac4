"""What levels of detail lose, how well convex pieces fit, and whether a mesh is a solid, of finished workspaces.

python -m benchmarks.engine_files WORKSPACE ... [--levels 4] [--pieces 16]

Prints two Markdown tables. Distances are in percent of the mesh's largest extent. Seconds are CPU time, that of the
whole export with and without the files.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from configs.params import ExportParams
from stages import artifacts
from stages.drawing.view_scores import draw_view, psnr, silhouette
from stages.engine.stage import StageContext
from stages.evaluation.surfaces import Surface, Target
from stages.export import EXPORT
from stages.reporting.pictures import read_rgb
from stages.surface.levels_of_detail import levels_of_detail

VIEWS = 6  # photos, evenly spread, from where levels are drawn


def export(workspace: Path, out: Path, **settings: Any) -> tuple[dict[str, Any], float]:
    """Numbers of an export with these settings, and its CPU seconds."""
    started = time.process_time()
    inputs = {name: workspace / name for name in EXPORT.needs}
    params = ExportParams(formats=("glb", "ply"), **settings)
    numbers = EXPORT.run(StageContext(inputs=inputs, sources={}, out=out, scratch=out, params=params))
    return numbers, time.process_time() - started


def level_rows(workspace: Path, out: Path, count: int) -> list[str]:
    atlas = artifacts.ATLAS_MESH.load(workspace / "atlas")
    cameras = artifacts.CAMERAS.load(workspace / "train")
    texture = read_rgb(artifacts.BASE_COLOR.load(workspace / "bake"))
    views = np.linspace(0, len(cameras), VIEWS, endpoint=False).astype(int).tolist()
    full = [draw_view(atlas, texture, cameras, view) for view in views]
    masks = [silhouette(atlas.vertices, atlas.faces, cameras, view) for view in views]
    extent = np.ptp(atlas.vertices, axis=0).max()
    _, alone = export(workspace, out)
    numbers, seconds = export(workspace, out, lods=count)
    rows = [f"| {workspace.name}, 0 | {len(atlas.faces)} | {numbers['bytes']['glb'] / 1e6:.1f} | - | - | - | - |"]
    for level, mesh in enumerate(levels_of_detail(atlas, count), 1):
        away = 100 * Target(Surface(mesh.vertices, mesh.faces)).nearest(atlas.vertices).distances / extent
        scores = [
            psnr(draw_view(mesh, texture, cameras, view), image, mask)
            for view, image, mask in zip(views, full, masks, strict=True)
        ]
        cost = f"{seconds - alone:.1f}" if level == count else ""
        rows.append(
            f"| {workspace.name}, {level} | {len(mesh.faces)} | {numbers['bytes'][f'lod{level}'] / 1e6:.1f} "
            f"| {away.mean():.3f} | {away.max():.2f} | {np.mean(scores):.1f} | {cost} |"
        )
    return rows


def shape_row(workspace: Path, out: Path, count: int) -> str:
    """Soundness of the PLY as two other programs see it, and the fit of its convex pieces."""
    import open3d as o3d
    import trimesh

    _, alone = export(workspace, out)
    _, seconds = export(workspace, out, collision="hulls", collision_pieces=count)
    mesh = trimesh.load(artifacts.asset_path(out, "ply"), process=False)
    other = o3d.io.read_triangle_mesh(str(artifacts.asset_path(out, "ply")))
    sound = {
        "closed": mesh.is_watertight,
        "winding": mesh.is_winding_consistent,
        "edges": other.is_edge_manifold(allow_boundary_edges=True),
        "vertices": other.is_vertex_manifold(),
    }
    glb = trimesh.load(artifacts.asset_path(out, "glb"), force="mesh", process=False)  # in the frame of the pieces
    pieces = list(trimesh.load(artifacts.collision_path(out)).geometry.values())
    outside = np.full(len(glb.vertices), np.inf)
    for piece in pieces:
        offsets = (piece.face_normals * piece.triangles[:, 0]).sum(1)
        outside = np.minimum(outside, (glb.vertices @ piece.face_normals.T - offsets).max(1))
    outside = 100 * np.maximum(outside, 0) / glb.extents.max()
    volume = f"{sum(piece.volume for piece in pieces) / mesh.volume:.2f}" if mesh.is_watertight else "-"
    words = " | ".join("yes" if value else "no" for value in sound.values())
    return (
        f"| {workspace.name} | {len(mesh.faces)} | {words} | {len(pieces)} | {all(p.is_convex for p in pieces)} "
        f"| {outside.mean():.3f} | {outside.max():.2f} | {volume} | {seconds - alone:.1f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspaces", nargs="+", type=Path)
    parser.add_argument("--levels", type=int, default=4)
    parser.add_argument("--pieces", type=int, default=16)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="engine-") as folder:
        out = Path(folder)
        print("| set, level | faces | GLB MB | mean distance % | largest % | PSNR dB | s for all |")
        print("| --- | ---: | ---: | ---: | ---: | ---: | ---: |")
        for workspace in asked.workspaces:
            print("\n".join(level_rows(workspace, out, asked.levels)), flush=True)
        print(
            "\n| set | faces | closed | winding | edges manifold | vertices manifold | pieces | convex "
            "| mean outside % | largest % | volume of pieces / mesh | s |"
        )
        print("| --- | ---: | --- | --- | --- | --- | ---: | --- | ---: | ---: | ---: | ---: |")
        for workspace in asked.workspaces:
            print(shape_row(workspace, out, asked.pieces), flush=True)


if __name__ == "__main__":
    main()
