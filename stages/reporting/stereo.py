"""What the page says of dense stereo: how far it explains the photos, and what to do where that is little."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from stages.reporting.photo_table import PhotoResult

# Of all pixels, explained: below this it is little. Textured things on a plain ground are above, mostly plain ones not.
LITTLE = 0.1
# A photo with less is as good as unexplained; so many of these are named.
NOTHING, NAMED = 0.01, 5


def describe_stereo(results: Sequence[PhotoResult], numbers: Mapping[str, Any]) -> list[str]:
    """Sentences for the page; none where there was no stereo.

    Args:
        numbers: of the stage densify.
    """
    shares = {result.record.name: result.explained for result in results if result.explained is not None}
    if "points" not in numbers or not shares:
        return []
    mean = sum(shares.values()) / len(shares)
    sentences = [f"Stereo explains {100 * mean:.0f} % of the photos' pixels, by {numbers['points']:,} dense points."]
    if mean < LITTLE:
        sentences.append(
            "That is little. Plain walls and things that shine, move or can be seen through give no points; nor do "
            "photos that are blurred, or taken far from all others, or from the same place. It helps to take photos in "
            "between, each a step from the last, in even light, with something printed beside what is plain."
        )
    blank = [name for name, share in shares.items() if share < NOTHING]
    if 0 < len(blank) < len(shares) / 2:
        more = f" and {len(blank) - NAMED} more" if len(blank) > NAMED else ""
        sentences.append(
            f"It explains next to nothing of {', '.join(blank[:NAMED])}{more}: look whether they are blurred, and "
            "whether others were taken near them."
        )
    return sentences
