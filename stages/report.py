"""Everything a run made, on one HTML page that needs nothing else: numbers, a 3D view, pictures, photos,
where to stand for the next ones, times, and the command that runs it again.

Whatever an earlier stage did not leave is left out; only the textured mesh itself must be there.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from configs.params import ReportParams
from stages.artifacts import (
    ATLAS_MESH,
    BASE_COLOR,
    GIVEN_REGION,
    HELD_OUT,
    IMAGE_SET,
    KNOWN,
    LIGHT_HDR,
    MATERIAL_COLOR,
    METRICS,
    MODEL,
    ORM,
    OUTLINES,
    PAGE,
    PHOTOS,
    PINHOLE_PHOTOS,
    POINT_CLOUD,
    PREVIEWS,
    PROVENANCE,
    QUALITY,
    REGISTRATION,
    SCENE,
    SPLATS,
    WORLD_PLACE,
    Artifact,
    AtlasMesh,
    VertexQuality,
    given_mask_of,
    read_texture,
)
from stages.drawing.overview import overview_svg
from stages.engine.stage import Stage, StageContext
from stages.errors import HineusError
from stages.geometry.cameras import PosedScene
from stages.geometry.place import GivenRegion, Place
from stages.geometry.point_cloud import PointCloud

T = TypeVar("T")

TEMPLATES = Path(__file__).parent / "templates"
THREE, SPARK = TEMPLATES / "vendor" / "three.min.js", TEMPLATES / "vendor" / "spark.min.js"
REPLAY_WORKSPACE = "again_hineus"


def run(context: StageContext[ReportParams]) -> dict[str, Any]:
    """Write report.html. Returns its size in bytes, and how the final mesh meets held-out photos."""
    import jinja2

    from stages.reporting import control, curves, gps, materials, numbers, photo_table, pictures, poses, stereo
    from stages.reporting.held_out_photos import compare_held_out

    scene, place, atlas = context.read(SCENE), context.read(WORLD_PLACE), context.read(ATLAS_MESH)
    scene = replace(scene, up=scene.up_in(place))
    texture = read_texture(context.read(BASE_COLOR))
    held_out, pinholes, outlines = context.read(HELD_OUT), context.read(PINHOLE_PHOTOS), context.read(OUTLINES)
    manifests = context.manifests
    steps = 5
    context.progress(0, steps, "drawing the model")
    page: dict[str, Any] = {
        "stills": [pictures.jpeg_uri(still) for still in pictures.draw_stills(atlas, texture, scene.up)],
        "texture": pictures.jpeg_uri(pictures.shrink(texture, pictures.PICTURE_SIDE)),
        "provenance": pictures.describe_provenance(context.read(PROVENANCE)),
        "materials": materials.describe_materials(
            *(context.read(artifact) for artifact in (MATERIAL_COLOR, ORM, KNOWN, LIGHT_HDR))
        ),
    }
    context.progress(1, steps, "comparing with held-out photos")

    def load(index: int) -> tuple[np.ndarray, np.ndarray | None]:
        name = scene.cameras.names[index]
        return given_mask_of(name, pinholes, outlines).masked(name)

    page["held_out"] = compare_held_out(atlas, texture, scene.cameras, load, held_out)
    context.progress(2, steps, "collecting the photos")
    image_set, registration = left(context, IMAGE_SET), left(context, REGISTRATION)
    dense = manifests["densify"].numbers if "densify" in manifests else {}
    results = photo_table.photo_results(
        image_set, registration, context.read(MODEL), scene.cameras.names, held_out, dense.get("explained", {})
    )
    page |= photo_table.describe_photos(
        results, image_set, registration, context.read(PHOTOS), context.params.thumbnails
    )
    context.progress(3, steps, "packing the 3D view")
    captions = photo_table.camera_captions(results, scene.cameras.names)
    region = context.read(GIVEN_REGION)
    page |= describe_view(
        scene, place, region, atlas, texture, left(context, QUALITY), left(context, POINT_CLOUD), captions
    )
    page["viewer"] |= in_lights(context, scene, place)
    page |= with_splats(context, page["viewer"], scene)
    context.progress(4, steps, "writing the page")
    placed = {name: manifests[name].numbers for name in ("undistort", "place", "train") if name in manifests}
    page |= {
        "numbers": numbers.headline(scene, atlas, manifests, page["held_out"]),
        "overview": overview_svg(scene, region_corners(scene, region)),
        "warnings": numbers.warnings(manifests),
        "where": numbers.describe_where(scene, place, placed),
        "stereo": stereo.describe_stereo(results, dense),
        "control": control.describe_control(place),
        "gps": gps.describe_gps(results, scene.world_from_scene(place).apply(scene.cameras.centers), place),
        "poses": [*numbers.describe_history(manifests), *poses.describe_poses(registration, place)],
        "charts": curves.training_charts(context.read(METRICS)),
        "previews": pictures.training_previews(context.read(PREVIEWS)),
        "stages": [numbers.stage_row(manifest) for manifest in manifests.values()],
        "total": numbers.total_row(list(manifests.values())),
        "settings": [
            {"name": name, "text": json.dumps(manifest.identity.params, indent=1)}
            for name, manifest in manifests.items()
            if manifest.identity.params
        ],
        "replay": replay(context),
        "generator": numbers.generator(manifests),
        "created": next((each.created for each in reversed(list(manifests.values())) if each.created), ""),
    }
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES), autoescape=True, undefined=jinja2.ChainableUndefined
    )
    html = environment.get_template("report.html.j2").render(page)
    context.to_write(PAGE).write_text(html, encoding="utf-8")
    context.progress(steps, steps, "done")
    summary: dict[str, Any] = {"bytes": len(html.encode())}
    if page["held_out"]:
        summary |= {f"mesh_held_out_{key}": round(page["held_out"][key], 4) for key in ("psnr", "ssim")}
    return summary


def left(context: StageContext[ReportParams], artifact: Artifact[T]) -> T | None:
    """An artifact that the page can do without: None where it is missing or damaged."""
    try:
        return context.read(artifact)
    except (OSError, ValueError, TypeError, KeyError, HineusError):
        return None


def describe_view(
    scene: PosedScene,
    place: Place,
    region: GivenRegion | None,
    atlas: AtlasMesh,
    texture: np.ndarray,
    quality: VertexQuality | None,
    cloud: PointCloud | None,
    captions: list[dict[str, Any]],
) -> dict[str, Any]:
    """The 3D view and, where the bake stage left its measures, their colours and the next photos to take."""
    from stages.reporting import view3d
    from stages.reporting.next_views import suggest_views, vertex_needs

    advice = quality and suggest_views(atlas.vertices, atlas.normals, atlas.faces, vertex_needs(quality), scene)
    shown, quality = view3d.light_enough(atlas, quality)
    overlays = view3d.pack_overlays(quality) if quality else []
    return {
        "advice": advice,
        "faces_shown": len(shown.faces) if shown is not atlas else None,
        "viewer": {
            **view3d.pack_mesh(shown, texture, scene.up),
            **view3d.pack_scene(scene, captions, advice.views if advice else (), shown),
            "region": view3d.pack_region(scene, place, region),
            "overlays": overlays,
            "dense": None if cloud is None else view3d.pack_dense(cloud, scene),
        },
        "three": THREE.read_text(encoding="utf-8"),
    }


def in_lights(context: StageContext[ReportParams], scene: PosedScene, place: Place) -> dict[str, Any]:
    """What the 3D view shows the model in: lights, and the material where it was learned."""
    from stages.reporting.lit_view import describe_lights

    return describe_lights(context.read(LIGHT_HDR), context.read(MATERIAL_COLOR), context.read(ORM), scene, place)


def with_splats(context: StageContext[ReportParams], viewer: dict[str, Any], scene: PosedScene) -> dict[str, Any]:
    """The 3D view with Gaussian splats, and the program that draws them; the view as it is where there are none."""
    from stages.reporting.splats import pack_splats

    splats = pack_splats(context.read(SPLATS), scene.up)
    return {"viewer": {**viewer, "splats": splats}, "spark": SPARK.read_text(encoding="utf-8")} if splats else {}


def region_corners(scene: PosedScene, region: GivenRegion | None) -> np.ndarray | None:
    """Corners [8, 3] of the box that was given as region, scene frame; None where none was."""
    corners = region.box_corners() if region else None
    return None if corners is None else scene.poses_from_scene.inverse().apply(corners)


def replay(context: StageContext[ReportParams]) -> str:
    """The command that runs it all again, from what this run was started with; empty where that is not known."""
    from configs.params import Config
    from configs.replay import replay_command

    record, config = context.record, context.config
    if record is None or not isinstance(config, Config):
        return ""
    return replay_command(record.sources, record.preset, config, REPLAY_WORKSPACE)


REPORT: Stage[ReportParams] = Stage(
    name="report",
    version=13,
    settings=lambda config: config.report,
    run=run,
    reads=(
        IMAGE_SET,
        PHOTOS,
        MODEL,
        REGISTRATION,
        WORLD_PLACE,
        GIVEN_REGION,
        SCENE,
        PINHOLE_PHOTOS,
        OUTLINES,
        POINT_CLOUD,
        METRICS,
        PREVIEWS,
        HELD_OUT,
        ATLAS_MESH,
        BASE_COLOR,
        PROVENANCE,
        QUALITY,
        MATERIAL_COLOR,
        ORM,
        KNOWN,
        LIGHT_HDR,
        SPLATS,
    ),
    writes=(PAGE,),
    reads_manifests=(
        "ingest",
        "sfm",
        "place",
        "undistort",
        "densify",
        "train",
        "extract",
        "cleanup",
        "atlas",
        "bake",
        "materials",
        "splats",
        "export",
    ),
    reads_run=True,
    summary="everything -> one HTML page",
)
