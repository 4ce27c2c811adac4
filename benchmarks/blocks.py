"""A made-up town reconstructed in blocks, or in one: distance to the truth, and steps across the blocks' borders.

python -m benchmarks.synthetic DATA --scenes town4 --photos 100 --size 320x240 --spp 8
hineus run DATA/town4/images --workspace WHOLE --blocks 4        and another without `--blocks`
python -m benchmarks.blocks TRUTH WHOLE ...                      TRUTH is DATA/town4

A line of JSON for each workspace. Step: of places along a border, the difference between the errors of the height on
either side, `APART` of the truth's extent away from it; inside: the same along lines through the middles of the blocks.
Tint: of each of these lines the median of the colours' ratio on either side, in percent, mean over channels.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stages import artifacts
from stages.artifacts.blocks import BlockPlan, block_folder, read_plan
from stages.engine.workspace import Workspace
from stages.evaluation.protocols.known_object import KnownObject, load_known_object, score_surface, truth_from_model
from stages.evaluation.suites.scores import Part, joined_mesh
from stages.geometry.similarity import Similarity
from stages.surface.triangle_mesh import raycaster

APART = 0.002
PLACES = 2000  # along a border
FEWEST_BOTH = 0.3  # part of a line that must have surface on both sides
Mesh = tuple[np.ndarray, np.ndarray]


def measure(root: Path, truth: Path) -> dict[str, Any]:
    """Scores of one workspace, and what its stages took."""
    whole, known = Workspace.open(root), load_known_object(truth)
    truth_from_poses = truth_from_model(known, artifacts.MODEL.load(whole.stage_folder("sfm")), truth)
    plan = read_plan(root)
    parts = [whole] if plan is None else [Workspace.open(block_folder(root, block.name)) for block in plan.blocks]
    truth_from_parts = truth_from_poses
    if plan is not None:
        truth_from_parts = truth_from_poses.compose(plan.plan_from_poses.similarity().inverse())
    mesh = joined_mesh([Part(part, truth_from_parts) for part in parts])
    spent = [made for part in {whole.root: whole, **{p.root: p for p in parts}}.values() for made in manifests(part)]
    photos = len(artifacts.IMAGE_SET.load(whole.stage_folder("ingest")).images)
    return {
        "workspace": root.resolve().name,
        "blocks": len(parts) if plan else 0,
        "photos": photos,
        **score_surface(*mesh, known).as_dict(),
        **({} if plan is None else steps(plan, truth_from_parts, mesh, known)),
        **({} if plan is None else tints(plan, parts, APART * known.surface.extent / truth_from_parts.scale)),
        "cpu_s_a_photo": round(sum(made["cpu_s"] for made in spent) / photos, 2),
        "gib": round(max(made["peak_rss"] for made in spent) / 2**30, 2),
        "faces": len(mesh[1]),
    }


def manifests(workspace: Workspace) -> list[dict[str, Any]]:
    """What each stage of a workspace took."""
    return [artifacts.read_json(file) for file in sorted(workspace.root.glob("*/manifest.json"))]


def steps(plan: BlockPlan, truth_from_plan: Similarity, mesh: Mesh, known: KnownObject) -> dict[str, float]:
    """Mean steps (the largest 5 % left out) across borders and inside, in percent of the extent, and their ratio."""
    apart = APART * known.surface.extent / truth_from_plan.scale
    found = {}
    for name, pieces in lines(plan).items():
        errors = [
            heights(mesh, known, truth_from_plan, np.concatenate([at + side * apart * across for at, across in pieces]))
            for side in (-1, 1)
        ]
        step = np.abs(errors[0] - errors[1])
        step = np.sort(step[np.isfinite(step)])
        found[f"step_{name}"] = 100 * float(step[: int(0.95 * len(step))].mean()) / known.surface.extent
    return {
        **{name: round(value, 4) for name, value in found.items()},
        "ratio": round(found["step_border"] / found["step_inside"], 3),
    }


def tints(plan: BlockPlan, parts: list[Workspace], apart: float) -> dict[str, float]:
    """Mean tints across borders and inside, in percent; `apart`: distance from the line, in the plan's units."""
    tiles = [_Textured.of(part) for part in parts]
    found = {}
    for name, pieces in lines(plan).items():
        tint = []
        for at, across in pieces:
            left, right = (np.log(seen_from_above(tiles, at + side * apart * across)) for side in (-1, 1))
            both = np.isfinite(left + right).all(1)
            if both.mean() > FEWEST_BOTH:
                tint.append(np.abs(np.median((left - right)[both], axis=0)).mean())
        found[f"tint_{name}"] = round(100 * float(np.mean(tint)), 3)
    return found


@dataclass(frozen=True)
class _Textured:
    """A tile in the plan's frame: what casts rays at it, its highest place, faces, texture coordinates of the vertices,
    texture [S, S, 3]."""

    caster: Any
    top: float
    faces: np.ndarray
    uvs: np.ndarray
    texture: np.ndarray

    @staticmethod
    def of(workspace: Workspace) -> _Textured:
        from PIL import Image

        atlas = artifacts.ATLAS_MESH.load(workspace.stage_folder("atlas"))
        scene = artifacts.SCENE.load(workspace.stage_folder("train"))
        texture = np.asarray(Image.open(artifacts.BASE_COLOR.load(workspace.stage_folder("bake"))).convert("RGB"))
        vertices = scene.poses_from_scene.apply(atlas.vertices.astype(np.float64))
        caster, top = raycaster(vertices, atlas.faces), float(vertices[:, 2].max())
        return _Textured(caster, top, atlas.faces, atlas.uvs, texture)


def seen_from_above(tiles: list[_Textured], places: np.ndarray) -> np.ndarray:
    """Colours [P, 3], 1..255, of the highest surface over places in the plan's frame; NaN where there is none."""
    import open3d as o3d

    above = max(tile.top for tile in tiles) + 1
    start = np.column_stack([places[:, :2], np.full(len(places), above)])
    rays = np.concatenate([start, np.broadcast_to([0.0, 0.0, -1.0], start.shape)], 1).astype(np.float32)
    nearest, colors = np.full(len(places), np.inf), np.full((len(places), 3), np.nan)
    for tile in tiles:
        hit = tile.caster.cast_rays(o3d.core.Tensor(rays))
        away, corner = hit["t_hit"].numpy(), hit["primitive_uvs"].numpy()
        closer = away < nearest
        corners = tile.uvs[tile.faces[hit["primitive_ids"].numpy()[closer].astype(np.int64)]]
        weights = np.column_stack([1 - corner.sum(1), corner])[closer]
        size = len(tile.texture)
        column, row = (np.einsum("pc,pcd->dp", weights, corners) * [[1], [-1]] + [[0], [1]]) * size
        pixels = [np.clip(axis, 0, size - 1).astype(np.int64) for axis in (row, column)]
        colors[closer] = np.maximum(tile.texture[tuple(pixels)], 1)
        nearest[closer] = away[closer]
    return colors


def lines(plan: BlockPlan) -> dict[str, list[Any]]:
    """Lines along the blocks' upper borders, of which the outermost have nothing beyond, and through their middles."""
    found: dict[str, list[Any]] = {"border": [], "inside": []}
    for block in plan.blocks:
        (x0, y0, _), (x1, y1, _) = block.core
        for axis, at in ((0, x1), (1, y1)):
            along = np.linspace((y0, x0)[axis], (y1, x1)[axis], PLACES)
            found["border"].append(line(axis, at, along))
            found["inside"].append(line(axis, ((x0 + x1) / 2, (y0 + y1) / 2)[axis], along))
    return found


def line(axis: int, at: float, along: np.ndarray) -> Any:
    """Places [P, 3] on the ground plan with coordinate `at` of an axis, and the unit direction across them."""
    places, across = np.zeros((len(along), 3)), np.zeros(3)
    places[:, axis], places[:, 1 - axis], across[axis] = at, along, 1.0
    return places, across


def heights(mesh: Mesh, known: KnownObject, truth_from_plan: Similarity, places: np.ndarray) -> np.ndarray:
    """Error [P] of the height of the highest surface over places in the plan's frame; NaN where one has none."""
    import open3d as o3d

    down = truth_from_plan.rotation @ np.array([0, 0, -1.0])
    start = truth_from_plan.apply(places)
    start = start - down * (start @ down + 10 * known.surface.extent)[:, None]
    rays = np.concatenate([start, np.broadcast_to(down, start.shape)], 1).astype(np.float32)
    surfaces = (mesh, (known.vertices, known.faces))
    away = [raycaster(*each).cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy() for each in surfaces]
    difference: np.ndarray = np.where(np.isfinite(away).all(0), away[1] - away[0], np.nan)
    return difference


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("truth", type=Path, help="folder of the town")
    parser.add_argument("workspaces", type=Path, nargs="+")
    arguments = parser.parse_args()
    for root in arguments.workspaces:
        print(json.dumps(measure(root, arguments.truth)), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
