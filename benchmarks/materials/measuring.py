"""A finished run of an object against its truth, beside the baselines: numbers, and rows of a contact sheet."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.materials import scoring
from benchmarks.materials.baselines import baked_model, fitted_model
from benchmarks.materials.glb_model import Finished, Model
from benchmarks.materials.held_out import LIGHT_MAPS, Views, read_exr, read_truth, z_up_map
from benchmarks.materials.judge import Judge
from benchmarks.materials.scenes import SUBJECTS
from benchmarks.materials.sheet import Row
from stages.evaluation.machine import machine

SPP = 100  # a pixel of the judge's pictures
SHOWN = 2  # the held-out view on the contact sheet


@dataclass(frozen=True)
class Measured:
    """Numbers as they go to the result file, and rows of the contact sheet."""

    result: dict[str, Any]
    rows: tuple[Row, ...]


def measure(name: str, truth_folder: Path, finished: Finished, variant: str) -> Measured:
    """Score an object's maps, its pictures under the unseen lights, and its light."""
    subject = SUBJECTS[name]
    truth = Truth.read(truth_folder)
    judge = Judge(truth.views, variant)
    unseen = subject.unseen
    models: dict[str, Model] = {"ours": finished.model} if finished.has_materials else {}
    fitted_roughness = None
    if finished.baked is not None:
        models["baked"] = baked_model(finished.model, finished.baked)
        models["baked, fitted"], fitted_roughness = fitted_model(
            finished.model, finished.baked, truth_folder, truth.lights[subject.light], variant
        )
    scores: dict[str, dict[str, float]] = {}
    rows = [truth.row(unseen)]
    for label, model in models.items():
        maps = judge.maps(model)
        relit = [judge.lit(model, truth.lights[light], SPP) for light in unseen]
        truths = [truth.radiance(light) for light in unseen]
        lit = scoring.lit_scores(relit, truths, truth.masks)
        scores[label] = scoring.map_scores(maps, truth.maps) | {f"relit_{key}": value for key, value in lit.items()}
        rows.append(_row(label, maps, relit, truths, truth))
    if finished.light is not None:
        error = scoring.source_error_deg(finished.light, truth.lights[subject.light])
        seen = judge.lit(finished.model, finished.light, SPP)
        novel = scoring.lit_scores([seen], [truth.radiance(subject.light)], truth.masks)
        scores["ours"] = scores.get("ours", {}) | {
            "light_error_deg": error,
            **{f"novel_{key}": value for key, value in novel.items()},
        }
    result = {"name": name, "light": subject.light, "unseen": list(unseen), "fitted_roughness": fitted_roughness,
              "scores": _rounded(scores), "machine": machine()}  # fmt: skip
    return Measured(result, tuple(rows))


@dataclass(frozen=True)
class Truth:
    """What is known of an object.

    Attributes:
        views: held-out cameras.
        maps: of each view, with the radiances.
        masks: [N, H, W] bool, the pixels that count; not those, rare, where the renderer made no number.
        lights: by name, each as `Scene.sky`.
    """

    views: Views
    maps: list[dict[str, np.ndarray]]
    masks: np.ndarray
    lights: dict[str, np.ndarray]

    @classmethod
    def read(cls, folder: Path) -> Truth:
        views = Views.load(folder)
        maps = [read_truth(folder, i) for i in range(len(views.cam_from_world))]
        lights = {path.stem: z_up_map(read_exr(path)) for path in sorted((folder / LIGHT_MAPS).glob("*.exr"))}
        masks = [scoring.counted(one["coverage"]) for one in maps]
        for mask, one in zip(masks, maps, strict=True):
            for light in lights:
                mask &= np.isfinite(one[f"radiance_{light}"]).all(2)
        return cls(views, maps, np.stack(masks), lights)

    def radiance(self, light: str) -> np.ndarray:
        """[N, H, W, 3] of all views, 0 where the renderer made no number."""
        return np.nan_to_num(np.stack([one[f"radiance_{light}"] for one in self.maps]))

    def row(self, unseen: tuple[str, ...]) -> Row:
        shown, mask = self.maps[SHOWN], self.masks[SHOWN]
        truths = [self.radiance(light) for light in unseen]
        lit = [scoring.coded(scoring.exposure(truth, self.masks) * truth[SHOWN]) for truth in truths]
        return Row("truth", scoring.coded(shown["base_color"]), shown["roughness"], shown["metallic"], lit, mask)


def _row(
    label: str, maps: list[dict[str, np.ndarray]], relit: list[np.ndarray], truths: list[np.ndarray], truth: Truth
) -> Row:
    """A model's row of the contact sheet, with the scales of the scores."""
    masks = truth.masks
    colors, true_colors = (np.stack([one["base_color"] for one in each])[masks] for each in (maps, truth.maps))
    base = scoring.channel_scale(colors, true_colors) * maps[SHOWN]["base_color"]
    scale, exposures = scoring.lit_scales(relit, truths, masks)
    lit = [scoring.coded(scale * e * picture[SHOWN]) for picture, e in zip(relit, exposures, strict=True)]
    return Row(
        label, scoring.coded(base), maps[SHOWN]["roughness"], maps[SHOWN]["metallic"], lit, masks[SHOWN]
    )  # fmt: skip


def _rounded(scores: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
    return {label: {key: round(value, 4) for key, value in numbers.items()} for label, numbers in scores.items()}
