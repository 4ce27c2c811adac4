"""Settings under the names they had before: read for one version, with a note.

A setting that is gone is dropped where it says what happens anyway, and else refused.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from configs.dotted import flatten, nested
from stages.errors import ConfigError

log = logging.getLogger(__name__)

_GROUPS = {
    "train.field": "encoding levels level_features log2_rows coarsest finest sdf_layers sdf_width radiance_layers "
    "radiance_width radiance_inputs gradients sphere_radius init background background_log2_rows",
    "train.density": "scale scale_start scale_end sharpen_until",
    "train.sampling": "rays samples free_points background_samples sampler cache_resolution cache_every "
    "proposal_samples proposal_updates",
    "train.schedule": "start_levels coarse_until lr_table lr_network lr_warm_up lr_decay lr_final adam_beta2",
    "train.losses": "sparse_until sparse_tolerance sparse_step sparse_batch",
}
_PLACE = "region up gps marker_size marker_dictionary known_distance"
RENAMED = {
    **{f"train.{name}": f"{group}.{name}" for group, names in _GROUPS.items() for name in names.split()},
    **{f"undistort.{name}": f"place.{name}" for name in _PLACE.split()},
    "sfm.exhaustive_max": "sfm.preemptive_max",
    "train.holdout": "train.hold_out",
    "train.density": "train.density.form",
    "train.weight_eikonal": "train.losses.eikonal",
    "train.weight_mask": "train.losses.mask",
    "train.weight_exposure": "train.losses.exposure",
    "train.weight_sparse": "train.losses.sparse",
    "train.ambiguity": "train.terms.ambiguity.form",
    "train.ambiguity_from": "train.terms.ambiguity.start",
    "train.visibility": "train.terms.ambiguity.visibility",
    "train.visibility_sharpness": "train.terms.ambiguity.sharpness",
    "train.visibility_samples": "train.terms.ambiguity.samples",
    "train.reflection": "train.terms.reflection.form",
    "train.reflection_from": "train.terms.reflection.start",
    "train.reflection_reach": "train.terms.reflection.reach",
    "train.reflection_samples": "train.terms.reflection.samples",
    "train.reflection_temperature": "train.terms.reflection.temperature",
    "train.planar": "train.terms.planar.form",
    "train.weight_planar": "train.terms.planar.weight",
    "train.planar_features": "train.terms.planar.features",
    "train.planar_start": "train.terms.planar.scale_start",
    "train.planar_until": "train.terms.planar.scale_until",
    "train.planar_radius": "train.terms.planar.radius",
    "train.planar_rays": "train.terms.planar.rays",
    "train.planar_neighbors": "train.terms.planar.neighbors",
    "train.eikonal": "train.terms.eikonal.form",
    "train.relaxation_gamma": "train.terms.eikonal.gamma",
    "train.relaxation_clip": "train.terms.eikonal.clip",
}
"""Old dotted name -> new one."""
_SECTIONS = {new.rpartition(".")[0] for new in RENAMED.values()}

_ANNEALED = "an Eikonal term that grows or fades gained nothing"
_COMPARED = "comparing photos with photos gained nothing"
REMOVED: dict[str, tuple[float | None, str]] = {
    "train.eikonal_start": (1, _ANNEALED),
    "train.eikonal_end": (1, _ANNEALED),
    "train.weight_consistency": (0, _COMPARED),
    "train.consistency_from": (None, _COMPARED),
    "train.consistency_rays": (None, _COMPARED),
}
"""Old dotted name -> the value at which it did nothing (None: alone it never did anything), and why it is gone."""

_NAMED = 3  # old names spelled out in a note; past it they are counted


def with_new_names(layer: Mapping[str, Any], origin: str) -> dict[str, Any]:
    """Settings by section with their new names, and a note in the log where some had old ones.

    Where one is given by both names the new one wins.

    Args:
        origin: where the settings were written, for people.

    Raises:
        ConfigError: a setting that is gone asks for what there is no more.
    """
    flat = flatten(layer)
    old = [key for key, value in flat.items() if _is_old(key, value)]
    if not old:
        return dict(layer)
    for key in old:
        if key in REMOVED and not _did_nothing(key, flat[key]):
            harmless, why = REMOVED[key]
            raise ConfigError(
                f"`{key}` = {flat[key]} in {origin}: this setting is gone, since {why}.",
                f"Leave it out, or use an older version of HiNeuS; it did nothing at {harmless}.",
            )
    moves = [f"`{key}` is now `{RENAMED[key]}`" if key in RENAMED else f"`{key}` is gone" for key in old]
    more = f", and {len(moves) - _NAMED} more" if len(moves) > _NAMED else ""
    log.warning(
        "%s: %s%s. Old names are read by this version and not by the next.", origin, ", ".join(moves[:_NAMED]), more
    )
    return nested(_renamed(flat))


def section_with_new_names(section: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """A section as a finished stage was made with, by today's names, to compare or to use again; no note.

    A setting that is gone stays where it did something.
    """
    return dict(nested(_renamed(flatten({section: values}))).get(section, {}))


def _renamed(flat: Mapping[str, Any]) -> dict[str, Any]:
    new = {RENAMED[key]: value for key, value in flat.items() if key in RENAMED and _is_old(key, value)}
    kept = {key: value for key, value in flat.items() if key not in RENAMED or not _is_old(key, value)}
    return new | {key: value for key, value in kept.items() if not _did_nothing(key, value)}


def _is_old(key: str, value: Any) -> bool:
    # A name of today may be an old one, too: `train.density` was a value and is a section, which may be empty.
    return key in REMOVED or (key in RENAMED and not (value is None and key in _SECTIONS))


def _did_nothing(key: str, value: Any) -> bool:
    return key in REMOVED and REMOVED[key][0] in (None, value)
