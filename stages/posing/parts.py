"""A COLMAP model built again: of some of its photos, in another frame, of photos that have other names or sizes now."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from stages.geometry.similarity import Similarity

MIN_SEEING = 2  # a point that fewer photos see is none of the part's


def rebuilt(
    model: Any, taken: Mapping[str, tuple[str, tuple[int, int]]], old_from_new: Similarity | None = None
) -> Any:
    """The pycolmap model of these photos alone, with all points that two of them see.

    Args:
        taken: a photo's name in `model` -> its name and its width and height in pixels in the new one.
        old_from_new: to the frame of `model` from that of the new one; None: they are one.
    """
    import pycolmap

    frame = old_from_new or Similarity.identity()
    images = sorted((image for image in model.images.values() if image.name in taken), key=lambda image: image.image_id)
    kept = _kept_tracks(model, images)
    found = pycolmap.Reconstruction()
    lenses: dict[tuple[int, tuple[int, int]], int] = {}
    new_place: dict[tuple[int, int], int] = {}
    for image in images:
        name, size = taken[image.name]
        lens = model.cameras[image.camera_id]
        if (image.camera_id, size) not in lenses:
            lenses[image.camera_id, size] = number = len(lenses) + 1
            found.add_camera_with_trivial_rig(_resized(lens, size, number))
        stretch = np.array([size[0] / lens.width, size[1] / lens.height])
        places = pycolmap.Point2DList()
        for number, place in enumerate(image.points2D):
            if place.has_point3D() and place.point3D_id in kept:
                new_place[image.image_id, number] = len(places)
                places.append(pycolmap.Point2D(place.xy * stretch))
        pose = image.cam_from_world().matrix()
        rotation = pose[:, :3] @ frame.rotation
        translation = (pose[:, :3] @ frame.translation + pose[:, 3]) / frame.scale
        found.add_image_with_trivial_frame(
            pycolmap.Image(name, places, lenses[image.camera_id, size], image.image_id),
            pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), translation),
        )
    new_from_old = frame.inverse()
    for number, track in kept.items():
        point = model.points3D[number]
        elements = [pycolmap.TrackElement(image, new_place[image, at]) for image, at in track]
        added = found.add_point3D(new_from_old.apply(point.xyz), pycolmap.Track(elements), point.color)
        found.points3D[added].error = point.error
    return found


def _kept_tracks(model: Any, images: Sequence[Any]) -> dict[int, list[tuple[int, int]]]:
    """Points that enough of these images see -> where they see them: (image, place)."""
    tracks: dict[int, list[tuple[int, int]]] = {}
    for image in images:
        for place, feature in enumerate(image.points2D):
            if feature.has_point3D():
                tracks.setdefault(feature.point3D_id, []).append((image.image_id, place))
    return {
        number: track for number, track in sorted(tracks.items()) if len({image for image, _ in track}) >= MIN_SEEING
    }


def _resized(lens: Any, size: tuple[int, int], number: int) -> Any:
    """A camera as it is where its photos have this width and height, with this number."""
    import pycolmap

    camera = pycolmap.Camera(
        model=lens.model_name, width=lens.width, height=lens.height, params=list(lens.params), camera_id=number
    )
    if size != (lens.width, lens.height):
        camera.rescale(*size)
    camera.has_prior_focal_length = True
    return camera
