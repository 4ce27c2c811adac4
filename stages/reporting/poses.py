"""Sentences on the lens that the poses were found with, and on how exact they are."""

from __future__ import annotations

import numpy as np

from stages.artifacts import Lens, LensTrial, Registration
from stages.geometry.place import Place
from stages.posing.adjustment import K2, PRINCIPAL_POINT

MOST_LENSES = 4  # sentences on single cameras


def describe_poses(registration: Registration | None, place: Place) -> list[str]:
    """What the last adjustment freed of each lens, and the expected error of the camera centres.

    Nothing where the poses were given, or an older version found them.
    """
    if registration is None:
        return []
    tried = sorted((lens for lens in registration.lenses if lens.trials), key=lambda lens: -lens.photos)
    sentences = [describe_lens(lens, len(registration.lenses) > 1) for lens in tried[:MOST_LENSES]]
    if len(tried) > MOST_LENSES:
        sentences.append(f"{len(tried) - MOST_LENSES} more cameras are in registration.json.")
    if error := registration.pose_error:
        percent = 100 * error.center / error.distance
        length = f" ({place.world_from_poses.scale * error.center:.2g} m)" if place.metric else ""
        sentences.append(
            f"Expected error of the camera centres: {percent:.2g} % of the distance{length}, from "
            f"features that are off by {error.residual_px:.2f} px. It counts what errs from feature to feature: "
            "true errors are larger."
        )
    return sentences


def describe_lens(lens: Lens, several: bool) -> str:
    """One sentence on a camera.

    Args:
        several: whether there are others, so that its photos are named.
    """
    of = f" of the camera of {lens.photos} photos" if several else ""
    freed = [trial for trial in lens.trials if not trial.refused]
    if not freed:
        reasons = "; ".join(f"{trial.freedom}: {trial.refused}" for trial in lens.trials)
        return f"Nothing more of the lens{of} was freed ({reasons})."
    parts = "; ".join(f"{trial.freedom}{_found(lens, trial)}" for trial in freed)
    before, after = freed[0].held_out_px[0], freed[-1].held_out_px[1]
    return f"Freed of the lens{of}: {parts}. Error of held-out observations {before:.3f} -> {after:.3f} px."


def _found(lens: Lens, trial: LensTrial) -> str:
    """What came out, in words."""
    if "cx" in lens.standard_errors and trial.freedom == PRINCIPAL_POINT:
        shift = np.hypot(lens.params["cx"] - lens.size[0] / 2, lens.params["cy"] - lens.size[1] / 2)
        error = np.hypot(lens.standard_errors["cx"], lens.standard_errors["cy"])
        return f", {shift:.1f} ± {error:.1f} px from the middle"
    if "k2" in lens.standard_errors and trial.freedom == K2:
        return f", {lens.params['k2']:.3f} ± {lens.standard_errors['k2']:.3f}"
    return ""
