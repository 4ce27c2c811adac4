"""What became of each photo: placed, left out or held out, its fit to the points, how far stereo explains it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from stages.artifacts import ImageRecord, ImageSet, Pictures, Registration
from stages.posing.photo_fits import PhotoFit, photo_fits
from stages.reporting.pictures import jpeg_uri, read_rgb, shrink

THUMBNAIL_SIDE = 200


@dataclass(frozen=True)
class PhotoResult:
    """One photo that was taken in.

    Attributes:
        record: what ingest knows of it.
        reason: why it has no pose, empty where it has one.
        fit: to the sparse points, where it has a pose and the model can be read.
        camera: its number among the scene's cameras, or None.
        held_out: whether it was held out from training and texture.
        explained: share (0..1) of its pixels whose depth stereo found and trusts; None where it has no depth map.
    """

    record: ImageRecord
    reason: str
    fit: PhotoFit | None
    camera: int | None
    held_out: bool
    explained: float | None

    @property
    def state(self) -> str:
        """In one word, as the page filters by it."""
        return "out" if self.reason else "held" if self.held_out else "used"


def photo_results(
    image_set: ImageSet | None,
    registration: Registration | None,
    model: Path,
    cameras: Sequence[str],
    held_out: Sequence[str],
    explained: Mapping[str, float],
) -> list[PhotoResult]:
    """All photos, by name; none where their list is missing.

    Args:
        model: folder of the COLMAP model.
        cameras: names of the scene's cameras: the photos' with `.png`.
        held_out: those of them that were held out.
        explained: share (0..1) of the pixels of each of them that stereo explains.
    """
    if image_set is None:
        return []
    unregistered = registration.unregistered if registration else ()
    reasons = {item.name: item.reason or "no pose" for item in unregistered}
    try:
        fits = photo_fits(model)
    except ValueError:
        fits = {}
    numbers = {name: number for number, name in enumerate(cameras)}
    results = []
    for record in sorted(image_set.images, key=lambda record: record.name):
        short = PurePosixPath(record.name).with_suffix(".png").as_posix()
        camera = next((numbers[name] for name in (f"{record.name}.png", short) if name in numbers), None)
        pinhole = "" if camera is None else cameras[camera]
        reason, fit = reasons.get(record.name, ""), fits.get(record.name)
        results.append(
            PhotoResult(record, reason, fit, None if reason else camera, pinhole in held_out, explained.get(pinhole))
        )
    return results


def describe_photos(
    results: Sequence[PhotoResult],
    image_set: ImageSet | None,
    registration: Registration | None,
    pictures: Pictures,
    most: int,
) -> dict[str, Any]:
    """The page's photos, those left out first; at most `most` have a picture. And the files never used."""
    if not results or image_set is None:
        return {}
    ordered = sorted(results, key=lambda result: result.state != "out")
    photos = [
        {
            "name": result.record.name,
            "image": _thumbnail(pictures, result.record) if number < most else "",
            "state": result.state,
            "reason": result.reason,
            "error": result.fit.error_px if result.fit else None,
            "points": result.fit.points if result.fit else None,
            "explained": result.explained,
            "camera": result.camera,
        }
        for number, result in enumerate(ordered)
    ]
    placed = sum(result.state != "out" for result in results)
    summary = f"{placed} of {len(results)} photos were placed."
    if held := sum(result.held_out for result in results):
        summary += f" {held} were held out from training and texture."
    attempts = [f"{step['rung']} {step['registered']}" for step in (registration.ladder if registration else ())]
    if len(attempts) > 1:
        summary += f" Attempts, with the photos each placed: {', '.join(attempts)}."
    if len(results) > most:
        summary += f" The first {most} have a picture."
    return {
        "photos": photos,
        "photo_summary": summary,
        "skipped": [{"source": item.source, "reason": item.reason} for item in image_set.skipped],
    }


def camera_captions(results: Sequence[PhotoResult], cameras: Sequence[str]) -> list[dict[str, Any]]:
    """For each of the scene's cameras what the 3D view says of it."""
    by_camera = {result.camera: result for result in results}
    captions = []
    for number, name in enumerate(cameras):
        result = by_camera.get(number)
        fit = result.fit if result else None
        captions.append(
            {
                "name": result.record.name if result else name,
                "held_out": result is not None and result.held_out,
                "error": fit.error_px and round(fit.error_px, 3) if fit else None,
                "points": fit.points if fit else None,
                "explained": result.explained if result else None,
            }
        )
    return captions


def _thumbnail(pictures: Pictures, record: ImageRecord) -> str:
    try:
        return jpeg_uri(shrink(read_rgb(pictures.path(record.name)), THUMBNAIL_SIDE), 75)
    except (OSError, ValueError):
        return ""
