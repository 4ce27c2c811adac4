"""Numbers for people: headline, time and memory, what is known of the place."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from stages.artifacts import AtlasMesh, read_json
from stages.engine.manifest import MANIFEST
from stages.geometry.cameras import PosedScene


def read_manifest(folder: Path) -> dict[str, Any]:
    """The stage's manifest as it stands in its folder; empty where there is none that can be read."""
    try:
        data = read_json(folder / MANIFEST)
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


def headline(
    scene: PosedScene, atlas: AtlasMesh, manifests: dict[str, dict[str, Any]], held_out: dict[str, Any] | None
) -> list[dict[str, str]]:
    """The few numbers on top of the page; `held_out` as `held_out.compare_held_out` gives it."""
    numbers = [
        ("faces", f"{len(atlas.faces):,}"),
        ("texture", f"{atlas.texture_size}²"),
        ("photos used", str(len(scene.cameras) - (held_out["count"] if held_out else 0))),
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
    if held_out:
        numbers.append(("final mesh in photos kept back", f"{held_out['psnr']:.1f} dB"))
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
