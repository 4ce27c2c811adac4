"""Everything a run made, on one HTML page that needs nothing else: numbers, a 3D view, pictures, photos,
where to stand for the next ones, times, and the command that runs it again.

Whatever an earlier stage did not leave is left out; only the textured mesh itself must be there.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from stages import artifacts
from stages.artifacts import AtlasMesh
from stages.engine.stage import Stage, StageContext
from stages.errors import HineusError
from stages.geometry.cameras import PosedScene

TEMPLATES = Path(__file__).parent / "templates"
THREE = TEMPLATES / "vendor" / "three.min.js"
SVG = "http://www.w3.org/2000/svg"
REPLAY_WORKSPACE = "again_hineus"


def run(context: StageContext) -> dict[str, Any]:
    """Write report.html. Returns its size in bytes, and how the final mesh meets photos that were kept back."""
    import jinja2

    from stages.reporting import curves, numbers, photo_table, pictures
    from stages.reporting.kept_back import compare_held_out

    inputs = context.inputs
    scene = artifacts.load_scene(inputs["undistort"])
    atlas = artifacts.load_atlas(inputs["atlas"])
    texture = pictures.read_rgb(artifacts.base_color_path(inputs["bake"]))
    manifests = {name: numbers.read_manifest(folder) for name, folder in inputs.items()}
    steps = 5
    context.progress(0, steps, "drawing the model")
    page: dict[str, Any] = {
        "stills": [pictures.jpeg_uri(still) for still in pictures.draw_stills(atlas, texture, scene.up)],
        "texture": pictures.jpeg_uri(pictures.shrink(texture, pictures.PICTURE_SIDE)),
        "provenance": pictures.describe_provenance(artifacts.provenance_path(inputs["bake"])),
    }
    context.progress(1, steps, "comparing with photos that were kept back")
    held_out = artifacts.load_held_out(inputs["train"])
    undistorted = inputs["undistort"]
    page["held_out"] = compare_held_out(
        atlas, texture, scene.cameras, lambda index: load_photo(undistorted, scene.cameras.names[index]), held_out
    )
    context.progress(2, steps, "collecting the photos")
    results = photo_table.photo_results(inputs["ingest"], inputs["sfm"], scene.cameras.names, held_out)
    page |= photo_table.describe_photos(results, inputs["ingest"], inputs["sfm"], context.params.thumbnails)
    context.progress(3, steps, "packing the 3D view")
    page |= describe_view(
        scene, atlas, texture, inputs["bake"], photo_table.camera_captions(results, scene.cameras.names)
    )
    context.progress(4, steps, "writing the page")
    page |= {
        "numbers": numbers.headline(scene, atlas, manifests, page["held_out"]),
        # part of a page, the drawing needs no namespace
        "overview": read_text(artifacts.overview_path(undistorted)).replace(f' xmlns="{SVG}"', ""),
        "where": numbers.describe_where(scene, manifests.get("undistort", {}).get("numbers") or {}),
        "charts": curves.training_charts(artifacts.metrics_path(inputs["train"])),
        "previews": pictures.training_previews(artifacts.previews_path(inputs["train"])),
        "stages": [numbers.stage_row(name, manifest) for name, manifest in manifests.items() if manifest],
        "total": numbers.total_row(list(manifests.values())),
        "settings": [
            {"name": name, "text": json.dumps(manifest["params"], indent=1)}
            for name, manifest in manifests.items()
            if manifest.get("params")
        ],
        "replay": replay(inputs["ingest"].parent),
        "generator": numbers.generator(manifests),
        "created": next((m["created"] for m in reversed(list(manifests.values())) if m.get("created")), ""),
    }
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES), autoescape=True, undefined=jinja2.ChainableUndefined
    )
    html = environment.get_template("report.html.j2").render(page)
    artifacts.report_path(context.out).write_text(html, encoding="utf-8")
    context.progress(steps, steps, "done")
    summary: dict[str, Any] = {"bytes": len(html.encode())}
    if page["held_out"]:
        summary |= {f"mesh_held_out_{key}": round(page["held_out"][key], 4) for key in ("psnr", "ssim")}
    return summary


def describe_view(
    scene: PosedScene, atlas: AtlasMesh, texture: np.ndarray, bake: Path, captions: list[dict[str, Any]]
) -> dict[str, Any]:
    """The 3D view and, where the bake stage left its measures, their colours and the next photos to take."""
    from stages.reporting import view3d
    from stages.reporting.next_views import suggest_views, vertex_needs

    try:
        quality = artifacts.load_quality(bake)
    except (OSError, ValueError, TypeError):
        quality = None
    advice = quality and suggest_views(atlas.vertices, atlas.normals, atlas.faces, vertex_needs(quality), scene)
    page: dict[str, Any] = {"advice": advice}
    if len(atlas.faces) > view3d.MAX_FACES:
        most = f"{view3d.MAX_FACES:,} faces; this model has {len(atlas.faces):,}"
        return page | {"viewer_missing": f"The interactive view holds at most {most}."}
    page["overlays"] = view3d.pack_overlays(quality) if quality else []
    page["viewer"] = {
        **view3d.pack_mesh(atlas, texture, scene.up),
        **view3d.pack_scene(scene, captions, advice.views if advice else (), atlas),
        "overlays": page["overlays"],
    }
    page["three"] = THREE.read_text(encoding="utf-8")
    return page


def load_photo(undistorted: Path, name: str) -> tuple[np.ndarray, np.ndarray | None]:
    """Undistorted photo [H, W, 3] uint8 and its mask [H, W] bool, or None where it has none."""
    mask = artifacts.load_mask(undistorted, name)
    return artifacts.load_image(undistorted, name), None if mask is None else mask > 127


def replay(root: Path) -> str:
    """The command that runs it all again, from the workspace's record; empty where that cannot be read."""
    from configs.load import load_config
    from configs.replay import replay_command
    from stages.engine.workspace import Workspace

    try:
        workspace = Workspace.open(root)
        config = load_config(file=workspace.config_path)
    except HineusError:
        return ""
    record = workspace.record
    return replay_command(record.sources, record.preset, config, REPLAY_WORKSPACE)


def read_text(path: Path) -> str:
    """The file's text; empty where there is none."""
    return path.read_text(encoding="utf-8") if path.exists() else ""


REPORT = Stage(
    name="report",
    version=4,
    needs=("ingest", "sfm", "undistort", "train", "extract", "cleanup", "atlas", "bake", "export"),
    params="report",
    run=run,
    summary="everything -> one HTML page",
)
