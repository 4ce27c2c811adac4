"""Everything a run made, on one HTML page that needs nothing else: numbers, a 3D view, pictures, photos,
times.

Whatever an earlier stage did not leave is left out; only the textured mesh itself must be there.
"""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stages import artifacts
from stages.artifacts import AtlasMesh
from stages.engine.manifest import MANIFEST
from stages.engine.stage import Stage, StageContext
from stages.geometry.cameras import PosedScene
from stages.geometry.orientation import y_up_rotation

TEMPLATES = Path(__file__).parent / "templates"
# Meshes with more faces than this would make the page too heavy: it then has pictures only.
MAX_VIEWER_FACES = 400_000
VIEWER_TEXTURE_SIDE = 2048
THUMBNAIL_SIDE = 200
STILL_SIDE = 480
PICTURE_SIDE = 768
MAX_PREVIEWS = 4
SVG = "http://www.w3.org/2000/svg"
CHART_POINTS = 240
# Training numbers worth a curve where they are logged, in the order of the page.
CURVES = ("psnr", "loss", "rgb", "eikonal", "mask", "scale")
PROVENANCE_COLORS = {"PHOTO": "#3c8d5a", "FIELD": "#d9822b", "PADDING": "#8a94a3", "OUTSIDE": "#3a3f47"}
PROVENANCE_LABELS = {"PHOTO": "photos", "FIELD": "learned colour"}


def run(context: StageContext) -> dict[str, Any]:
    """Write report.html. Returns its size in bytes."""
    import jinja2

    inputs = context.inputs
    scene = artifacts.load_scene(inputs["undistort"])
    atlas = artifacts.load_atlas(inputs["atlas"])
    texture = read_rgb(artifacts.base_color_path(inputs["bake"]))
    manifests = {name: read_manifest(folder) for name, folder in inputs.items()}
    steps = 4
    context.progress(0, steps, "drawing the model")
    page: dict[str, Any] = {
        "stills": [jpeg_uri(still) for still in draw_stills(atlas, texture, scene.up)],
        "texture": jpeg_uri(shrink(texture, PICTURE_SIDE)),
        "provenance": describe_provenance(artifacts.provenance_path(inputs["bake"])),
    }
    context.progress(1, steps, "packing the 3D view")
    if len(atlas.faces) <= MAX_VIEWER_FACES:
        page["viewer"] = pack_viewer(atlas, texture, scene.up)
    else:
        page["viewer_missing"] = (
            f"The interactive view holds at most {MAX_VIEWER_FACES:,} faces; this model has {len(atlas.faces):,}."
        )
    context.progress(2, steps, "collecting the photos")
    page |= describe_photos(inputs["ingest"], inputs["sfm"], context.params.thumbnails)
    context.progress(3, steps, "writing the page")
    page |= {
        "numbers": headline(scene, atlas, manifests),
        # part of a page, the drawing needs no namespace
        "overview": read_text(artifacts.overview_path(inputs["undistort"])).replace(f' xmlns="{SVG}"', ""),
        "where": describe_where(scene, manifests.get("undistort", {}).get("numbers") or {}),
        "charts": training_charts(artifacts.metrics_path(inputs["train"])),
        "previews": training_previews(artifacts.previews_path(inputs["train"])),
        "stages": [stage_row(name, manifest) for name, manifest in manifests.items() if manifest],
        "total": total_row(list(manifests.values())),
        "settings": [
            {"name": name, "text": json.dumps(manifest["params"], indent=1)}
            for name, manifest in manifests.items()
            if manifest.get("params")
        ],
        "generator": generator(manifests),
        "created": next((m["created"] for m in reversed(list(manifests.values())) if m.get("created")), ""),
    }
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES), autoescape=True, undefined=jinja2.ChainableUndefined
    )
    html = environment.get_template("report.html.j2").render(page)
    artifacts.report_path(context.out).write_text(html, encoding="utf-8")
    context.progress(steps, steps, "done")
    return {"bytes": len(html.encode())}


# ---------------------------------------------------------------- numbers
def read_manifest(folder: Path) -> dict[str, Any]:
    """The stage's manifest as it stands in its folder; empty where there is none that can be read."""
    try:
        data = artifacts.read_json(folder / MANIFEST)
    except (OSError, ValueError):
        return {}
    return data if isinstance(data, dict) else {}


def generator(manifests: dict[str, dict[str, Any]]) -> str:
    """Program and version that made the newest stage."""
    for manifest in reversed(list(manifests.values())):
        found = (manifest.get("versions") or {}).get("hineus")
        if found:
            return f"hineus {found}"
    return "hineus"


def headline(scene: PosedScene, atlas: AtlasMesh, manifests: dict[str, dict[str, Any]]) -> list[dict[str, str]]:
    """The few numbers on top of the page."""
    numbers = [
        ("faces", f"{len(atlas.faces):,}"),
        ("texture", f"{atlas.texture_size}²"),
        ("photos used", str(len(scene.cameras))),
    ]
    sfm, train, baked, exported = (
        manifests.get(name, {}).get("numbers") or {} for name in ("sfm", "train", "bake", "export")
    )
    if exported.get("units") == "metres":
        numbers.insert(0, ("size", " x ".join(f"{side:.3g}" for side in exported["extent"]) + " m"))
    if "mean_reprojection_error_px" in sfm:
        numbers.append(("reprojection error", f"{sfm['mean_reprojection_error_px']:.2f} px"))
    if "psnr" in train:
        numbers.append(("training PSNR", f"{train['psnr']:.1f} dB"))
    if "seen_share" in baked:
        numbers.append(("texture from photos", f"{100 * baked['seen_share']:.0f} %"))
    total = total_row(list(manifests.values()))
    if total:
        numbers += [("wall time", total["wall"]), ("peak memory", total["memory"])]
    return [{"label": label, "value": value} for label, value in numbers]


def describe_where(scene: PosedScene, numbers: dict[str, Any]) -> list[str]:
    """Sentences on the region of interest, the ground, up, the scale and the place."""
    radius = scene.world_from_scene.scale
    metric = scene.place is not None and scene.place.metric
    sentences = [
        f"The region of interest (orange) has a radius of {radius:.4g}{' m' if metric else ''}, from "
        f"{numbers.get('region_from', 'elsewhere')}. Sparse points inside it are green, cameras blue."
    ]
    if scene.ground is not None:
        sentences.append(f"The ground (dashed) holds {100 * scene.ground.share:.0f} % of the sparse points near it.")
    if "up_from" in numbers:
        sentences.append(f"Up is from {numbers['up_from']}.")
    return [*sentences, scene.place.describe()] if scene.place is not None else sentences


def stage_row(name: str, manifest: dict[str, Any]) -> dict[str, str]:
    """One line of the stage table."""
    numbers = manifest.get("numbers") or {}
    simple = {k: v for k, v in numbers.items() if isinstance(v, (int, float, str)) and not isinstance(v, bool)}
    return {
        "name": name,
        "wall": duration(manifest.get("wall_s")),
        "cpu": duration(manifest.get("cpu_s")),
        "memory": memory(manifest.get("peak_rss")),
        "result": ", ".join(f"{k.replace('_', ' ')} {plain(v)}" for k, v in list(simple.items())[:8]),
    }


def total_row(manifests: Sequence[dict[str, Any]]) -> dict[str, str] | None:
    """Times summed and memory's peak over the stages that say them."""
    known = [m for m in manifests if m.get("wall_s") is not None]
    if not known:
        return None
    return {
        "wall": duration(sum(m["wall_s"] for m in known)),
        "cpu": duration(sum(m.get("cpu_s") or 0 for m in known)),
        "memory": memory(max(m.get("peak_rss") or 0 for m in known)),
    }


def duration(seconds: float | None) -> str:
    if seconds is None:
        return "-"
    if seconds < 60:
        return f"{seconds:.1f} s"
    return f"{int(seconds // 60)} min {int(seconds % 60):02d} s"


def memory(size: float | None) -> str:
    return f"{size / 2**30:.2f} GB" if size else "-"


def plain(value: float | str) -> str:
    """A number without noise digits."""
    if isinstance(value, float):
        return f"{value:.4g}"
    return f"{value:,}" if isinstance(value, int) else value


def read_text(path: Path) -> str:
    """The file's text; empty where there is none."""
    return path.read_text(encoding="utf-8") if path.exists() else ""


# ---------------------------------------------------------------- pictures
def read_rgb(path: Path) -> np.ndarray:
    """[H, W, 3] uint8 RGB. Raises ValueError where the file is no image."""
    import cv2

    image = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise ValueError(f"expected an image, got {path}")
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB)


def shrink(image: np.ndarray, side: int) -> np.ndarray:
    """The image with its longest side at most `side` pixels."""
    import cv2

    height, width = image.shape[:2]
    factor = side / max(height, width)
    if factor >= 1:
        return image
    size = (max(1, round(width * factor)), max(1, round(height * factor)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)


def jpeg_uri(image: np.ndarray, quality: int = 85) -> str:
    """[H, W, 3] uint8 RGB as a data URI."""
    import cv2

    _, data = cv2.imencode(".jpg", cv2.cvtColor(image, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode()


def draw_stills(atlas: AtlasMesh, texture: np.ndarray, up: np.ndarray) -> list[np.ndarray]:
    """The model from four sides: with its texture, then its shape alone."""
    from stages.meshing.rendering import render_textured, turntable

    views = turntable(atlas.vertices, up, 4, STILL_SIDE, STILL_SIDE)
    grey = np.full((1, 1, 3), 205, dtype=np.uint8)
    return [render_textured(atlas.vertices, atlas.faces, atlas.uvs, texture, view) for view in views] + [
        render_textured(atlas.vertices, atlas.faces, atlas.uvs, grey, view, normals=atlas.normals) for view in views
    ]


def pack_viewer(atlas: AtlasMesh, texture: np.ndarray, up: np.ndarray) -> dict[str, Any]:
    """What viewer.js reads: the mesh turned +Y up, positions and UVs in 16 bits, normals in 8, base64."""
    turn = y_up_rotation(up)
    vertices = atlas.vertices @ turn.T
    low = vertices.min(0)
    size = np.maximum(vertices.max(0) - low, 1e-9)
    positions = np.round((vertices - low) / size * 65535).astype("<u2")
    uvs = np.clip(np.stack([atlas.uvs[:, 0], 1 - atlas.uvs[:, 1]], 1), 0, 1)
    # Three bytes a normal are padded by nobody: attributes of bytes may start anywhere in WebGL.
    normals = np.round(np.nan_to_num(atlas.normals @ turn.T).clip(-1, 1) * 127).astype(np.int8)

    def encode(array: np.ndarray) -> str:
        return base64.b64encode(array.tobytes()).decode()

    return {
        "positions": encode(positions),
        "uvs": encode(np.round(uvs * 65535).astype("<u2")),
        "normals": encode(normals),
        "faces": encode(atlas.faces.astype("<u4")),
        "count": int(atlas.faces.size),
        "low": low.tolist(),
        "size": size.tolist(),
        "texture": jpeg_uri(shrink(texture, VIEWER_TEXTURE_SIDE), 88),
    }


def describe_provenance(path: Path) -> dict[str, Any] | None:
    """The provenance map in colours and the shares of the charts' texels; None where it is missing."""
    import cv2

    from stages.meshing.baking import Provenance

    kinds = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE) if path.exists() else None
    if kinds is None:
        return None
    palette = np.zeros((256, 3), dtype=np.uint8)
    for kind in Provenance:
        palette[kind] = [int(PROVENANCE_COLORS[kind.name][k : k + 2], 16) for k in (1, 3, 5)]
    counts = {kind: int((kinds == kind).sum()) for kind in (Provenance.PHOTO, Provenance.FIELD)}
    total = max(sum(counts.values()), 1)
    return {
        "image": jpeg_uri(shrink(palette[kinds], PICTURE_SIDE)),
        "parts": [
            {
                "label": PROVENANCE_LABELS[kind.name],
                "color": PROVENANCE_COLORS[kind.name],
                "share": f"{100 * count / total:.1f} %",
            }
            for kind, count in counts.items()
        ],
    }


# ---------------------------------------------------------------- photos
def describe_photos(ingest: Path, sfm: Path, most: int) -> dict[str, Any]:
    """Thumbnails of the photos, those left out first, each with its reason; and the files never used."""
    try:
        image_set = artifacts.load_image_set(ingest)
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    try:
        registration = artifacts.load_registration(sfm)
    except (OSError, ValueError):
        registration = {}
    reasons = {item["name"]: item.get("reason", "") for item in registration.get("unregistered", [])}
    names = sorted((record.name for record in image_set.images), key=lambda name: (name not in reasons, name))
    photos = []
    for name in names[:most]:
        path = artifacts.image_path(ingest, name)
        try:
            image = jpeg_uri(shrink(read_rgb(path), THUMBNAIL_SIDE), 75)
        except (OSError, ValueError):
            image = ""
        photos.append(
            {"name": name, "image": image, "registered": name not in reasons, "reason": reasons.get(name, "")}
        )
    summary = f"{len(names) - len(reasons)} of {len(names)} photos were placed."
    attempts = [f"{step['rung']} {step['registered']}" for step in registration.get("ladder", [])]
    if len(attempts) > 1:
        summary += f" Attempts, with the photos each placed: {', '.join(attempts)}."
    if len(names) > most:
        summary += f" The first {most} are shown."
    return {
        "photos": photos,
        "photo_summary": summary,
        "skipped": [{"source": item.source, "reason": item.reason} for item in image_set.skipped],
    }


# ---------------------------------------------------------------- training
def training_charts(path: Path) -> list[dict[str, str]]:
    """A small curve for each number of `CURVES` that was logged and changed."""
    records = []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except OSError:
        return []
    for line in lines:
        try:
            record = json.loads(line)
        except ValueError:  # a line cut off by a kill
            continue
        if isinstance(record, dict):
            records.append(record)
    charts = []
    for key in CURVES:
        points = [
            (float(record.get("step", position)), float(record[key]))
            for position, record in enumerate(records)
            if isinstance(record.get(key), (int, float)) and math.isfinite(record[key])
        ]
        if len({value for _, value in points}) >= 2:
            charts.append({"label": key, "last": f"{points[-1][1]:.4g}", "svg": line_chart(points)})
    return charts


def line_chart(points: Sequence[tuple[float, float]], width: int = 420, height: int = 180) -> str:
    """An SVG curve. Values that are positive and span more than a factor of 30 get a logarithmic axis."""
    step = math.ceil(len(points) / CHART_POINTS)
    xs, ys = np.array([*points[::step], points[-1]]).T
    logarithmic = ys.min() > 0 and ys.max() / ys.min() > 30
    heights = np.log10(ys) if logarithmic else ys
    left, right, top, bottom = 52, width - 8, 8, height - 22
    across = left + (xs - xs[0]) / max(xs[-1] - xs[0], 1e-12) * (right - left)
    down = bottom - (heights - heights.min()) / max(np.ptp(heights), 1e-12) * (bottom - top)
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(across, down, strict=True))
    return (
        f'<svg viewBox="0 0 {width} {height}" role="img">'
        f'<line x1="{left}" y1="{bottom}" x2="{right}" y2="{bottom}"/>'
        f'<line x1="{left}" y1="{top}" x2="{left}" y2="{bottom}"/>'
        f'<text x="{left - 5}" y="{top + 8}" text-anchor="end">{ys.max():.3g}</text>'
        f'<text x="{left - 5}" y="{bottom}" text-anchor="end">{ys.min():.3g}</text>'
        f'<text x="{left}" y="{height - 7}">{xs[0]:.0f}</text>'
        f'<text x="{right}" y="{height - 7}" text-anchor="end">step {xs[-1]:.0f}</text>'
        f'<text x="{right}" y="{top + 8}" text-anchor="end">{"log" if logarithmic else ""}</text>'
        f'<polyline points="{path}"/></svg>'
    )


def training_previews(folder: Path) -> list[dict[str, str]]:
    """A few of the renders made while training, evenly spread, the last one among them."""
    files = sorted(folder.glob("*.png")) if folder.is_dir() else []
    if len(files) > MAX_PREVIEWS:
        files = [files[i] for i in np.linspace(0, len(files) - 1, MAX_PREVIEWS).round().astype(int)]
    previews = []
    for file in files:
        try:
            image = jpeg_uri(shrink(read_rgb(file), PICTURE_SIDE))
        except (OSError, ValueError):
            continue
        label = f"preview at step {int(file.stem)}" if file.stem.isdigit() else file.stem
        previews.append({"image": image, "label": label})
    return previews


REPORT = Stage(
    name="report",
    version=3,
    needs=("ingest", "sfm", "undistort", "train", "extract", "cleanup", "atlas", "bake", "export"),
    params="report",
    run=run,
    summary="everything -> one HTML page",
)
