"""Views taken at once from one place, such as those of a 360-degree picture, as COLMAP's rigs and frames.

A rig's cameras are turned against each other by known angles about one centre, and their intrinsics are known; one
pose places all views of a frame.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from stages.artifacts import ImageRecord


def write_rigs(database: Path, records: Iterable[ImageRecord]) -> frozenset[int]:
    """Put the images of a database into rigs and frames, photos alone into one each; ids of the rigs' cameras.

    Args:
        records: of all images of the database; where none is part of a frame, nothing is changed.
    """
    import pycolmap

    of_name = {record.name: record for record in records}
    if not any(record.frame for record in of_name.values()):
        return frozenset()
    rotations: dict[Any, dict[int, np.ndarray]] = {}  # of a rig's cameras
    frames: dict[Any, list[Any]] = {}  # images of a rig and a frame
    known = set()
    with pycolmap.Database.open(database) as opened:
        for image in opened.read_all_images():
            record, turn = of_name[image.name], np.eye(3)
            rig: Any = image.camera_id
            if record.cam_from_frame is not None:
                rig, turn = (record.width, record.height), np.array(record.cam_from_frame)
                known.add(image.camera_id)
            rotations.setdefault(rig, {})[image.camera_id] = turn
            frames.setdefault((rig, record.frame or record.name), []).append(image)
        opened.clear_frames()
        opened.clear_rigs()
        ids = {rig: opened.write_rig(_rig(turns)) for rig, turns in rotations.items()}
        for (rig, _), images in frames.items():
            frame = pycolmap.Frame()
            frame.rig_id = ids[rig]
            for image in images:
                frame.add_data_id(image.data_id)
            frame_id = opened.write_frame(frame)
            for image in images:
                image.frame_id = frame_id
                opened.update_image(image)
    return frozenset(known)


def _rig(turns: dict[int, np.ndarray]) -> Any:
    """A rig of cameras by id, whose first one is its reference; their rotations [3, 3] from the rig's frame."""
    import pycolmap

    sensors = {camera_id: pycolmap.sensor_t(pycolmap.SensorType.CAMERA, camera_id) for camera_id in turns}
    first, *others = turns
    rig = pycolmap.Rig()
    rig.add_ref_sensor(sensors[first])
    for camera_id in others:
        turn = pycolmap.Rotation3d(turns[camera_id] @ turns[first].T)
        rig.add_sensor(sensors[camera_id], pycolmap.Rigid3d(turn, np.zeros(3)))
    return rig


def has_rigs(model: Any) -> bool:
    """Whether a pycolmap model has a rig of several cameras."""
    return any(rig.num_sensors() > 1 for rig in model.rigs.values())
