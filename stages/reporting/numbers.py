"""Numbers for people: headline, time and memory, what is known of the place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from stages.artifacts import AtlasMesh
from stages.engine.manifest import Manifest
from stages.geometry.cameras import PosedScene
from stages.geometry.place import Place


def generator(manifests: Mapping[str, Manifest]) -> str:
    """Program and version that made the newest stage."""
    found = (manifest.versions.get("hineus") for manifest in reversed(list(manifests.values())))
    return next((f"hineus {version}" for version in found if version), "hineus")


def headline(
    scene: PosedScene, atlas: AtlasMesh, manifests: Mapping[str, Manifest], held_out: dict[str, Any] | None
) -> list[dict[str, str]]:
    """The few numbers on top of the page; `held_out` as `held_out_photos.compare_held_out` gives it."""
    numbers = [
        ("faces", f"{len(atlas.faces):,}"),
        ("texture", f"{atlas.texture_size}²"),
        ("photos used", str(len(scene.cameras) - (held_out["count"] if held_out else 0))),
    ]
    sfm, train, baked, exported = (
        manifests[name].numbers if name in manifests else {} for name in ("sfm", "train", "bake", "export")
    )
    if exported.get("units") == "metres":
        numbers.insert(0, ("size", " x ".join(f"{side:.3g}" for side in exported["extent"]) + " m"))
    if "mean_reprojection_error_px" in sfm:
        numbers.append(("reprojection error", f"{sfm['mean_reprojection_error_px']:.2f} px"))
    if "psnr" in train:
        numbers.append(("training PSNR", f"{train['psnr']:.1f} dB"))
    if held_out:
        numbers.append(("final mesh in held-out photos", f"{held_out['psnr']:.1f} dB"))
    if "seen_share" in baked:
        numbers.append(("texture from photos", f"{100 * baked['seen_share']:.0f} %"))
    if "splats" in exported:
        numbers.append(("Gaussian splats", f"{exported['splats']:,}"))
    total = total_row(list(manifests.values()))
    if total:
        numbers += [("wall time", total["wall"]), ("peak memory", total["memory"])]
    return [{"label": label, "value": value} for label, value in numbers]


def warnings(manifests: Mapping[str, Manifest]) -> list[dict[str, str]]:
    """What stages found wrong with the result: a "sentence" each and, where there is one, the "command" to try.

    They return them as "warnings" among their numbers.
    """
    return [warning for manifest in manifests.values() for warning in manifest.numbers.get("warnings", ())]


def describe_where(scene: PosedScene, place: Place, numbers: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Sentences on the region of interest, the ground, up, the scale and the place.

    Args:
        numbers: of the stages undistort, place and train.
    """
    found = numbers.get("undistort", {})
    sentences = [
        f"The region of interest (orange) has a radius of {scene.world_from_scene(place).scale:.4g}"
        f"{' m' if place.metric else ''}, from {found.get('region_from', 'elsewhere')}. Sparse points inside it are "
        "green, cameras blue."
    ]
    if (grown := numbers.get("train", {}).get("region_grown", 1.0)) > 1:
        sentences.append(f"It grew to {grown:.2f} times its radius in training, where its border had cut the surface.")
    if scene.ground is not None:
        sentences.append(f"The ground (dashed) holds {100 * scene.ground.share:.0f} % of the sparse points near it.")
    if up_from := numbers.get("place", {}).get("up_from") or found.get("up_from"):
        sentences.append(f"Up is from {up_from}.")
    return [*sentences, place.describe()]


def describe_history(manifests: Mapping[str, Manifest]) -> list[str]:
    """A sentence on what was kept of the result before photos came or went; none where nothing was."""
    sfm, undistort, train = (
        manifests[name].numbers if name in manifests else {} for name in ("sfm", "undistort", "train")
    )
    parts, kept = [], train.get("kept_of_budget")
    if sfm.get("new") or sfm.get("gone"):
        moved = sfm.get("moved_percent")
        by = "" if moved is None else f" (they moved by {moved:.2g} % of the distance to what they see)"
        parts.append(f"{sfm['known']} photos were known, {sfm['new']} are new, {sfm['gone']} gone")
        parts.append(f"known poses {'stayed' if sfm.get('poses_stayed') else 'did not stay'}{by}")
    if "region_kept" in undistort and (parts or kept):
        parts.append(f"the region {'stayed' if undistort['region_kept'] else 'was found anew'}")
    if kept:
        steps = f", {train['steps_in_all']:,} steps in all" if "steps_in_all" in train else ""
        parts.append(f"training went on with {100 * kept:.0f} % of its budget counted as spent{steps}")
    return [f"This result goes on from an earlier one: {'; '.join(parts)}."] if parts else []


def stage_row(manifest: Manifest) -> dict[str, str]:
    """One line of the stage table."""
    simple = {k: v for k, v in manifest.numbers.items() if isinstance(v, (int, float, str)) and not isinstance(v, bool)}
    return {
        "name": manifest.identity.stage,
        "wall": duration(manifest.wall_s),
        "cpu": duration(manifest.cpu_s),
        "memory": memory(manifest.peak_rss),
        "result": ", ".join(f"{k.replace('_', ' ')} {plain(v)}" for k, v in list(simple.items())[:8]),
    }


def total_row(manifests: Sequence[Manifest]) -> dict[str, str] | None:
    """Times summed and memory's peak; None where nothing was made."""
    if not manifests:
        return None
    return {
        "wall": duration(sum(manifest.wall_s for manifest in manifests)),
        "cpu": duration(sum(manifest.cpu_s for manifest in manifests)),
        "memory": memory(max(manifest.peak_rss for manifest in manifests)),
    }


def duration(seconds: float) -> str:
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
