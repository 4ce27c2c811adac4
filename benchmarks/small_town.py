"""A strip of land with a few houses, photographed from the air: small, textured all over, with poses that are known.

A town for the smoke and the tests, drawn with Open3D alone.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from stages.drawing.rendering import look_at
from stages.evaluation.protocols.known_object import TRUTH_MESH
from stages.scenes.photo_files import write_truth

SIZE, FOCAL = (240, 180), 200.0
LAND = np.array([[0.0, 0.0], [6.0, 3.0]])  # lowest and highest corner on the ground
HEIGHT = 3.0  # of the flight
BEYOND = 4.0  # what is flown over the land goes on: no photo sees its end
SLAB = 0.5  # thickness of the land in the truth, so that its lowest point is not the ground, which is judged
HOUSES = ((1.2, 0.9, 0.5), (2.9, 2.0, 0.8), (4.6, 1.0, 0.6))  # x, y and height; all are 0.7 wide
WIDTH = 0.7


def town() -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and faces [F, 3]: land that goes on beyond what is flown over, and houses on it."""
    return _with_houses(_land(BEYOND))


def true_town() -> tuple[np.ndarray, np.ndarray]:
    """The same of what is flown over alone, which is what counts."""
    return _with_houses(_land(0.0))


def _land(beyond: float) -> Any:
    """A slab whose upper side is the ground, z = 0."""
    import trimesh

    (left, low), (right, high) = LAND[0] - beyond, LAND[1] + beyond
    return trimesh.creation.box(bounds=[[left, low, -SLAB], [right, high, 0]])


def _with_houses(land: Any) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    houses = []
    for x, y, height in HOUSES:
        house = trimesh.creation.box((WIDTH, WIDTH, height))
        house.apply_translation((x, y, height / 2))
        houses.append(house)
    mesh = trimesh.util.concatenate([land, *houses])
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def flight(columns: int = 8, rows: int = 3) -> np.ndarray:
    """[N, 4, 4] world-to-camera: along the strip and back, tilted to one side and the other in turn."""
    poses = []
    for row, y in enumerate(np.linspace(0.4, 2.6, rows)):
        for column, x in enumerate(np.linspace(0.3, 5.7, columns)):
            lean = np.array([0.7, 0.4, 0]) * (1 if (row + column) % 2 else -1)
            center = np.array([x, y, HEIGHT])
            pose = np.eye(4)
            pose[:3] = look_at(center - lean, np.array([x, y, 0.0]), np.array([0, 1.0, 0]), 1, 1).extrinsics[0]
            poses.append(pose)
    return np.array(poses)


def photograph(folder: Path, columns: int = 8, rows: int = 3) -> Path:
    """Write `photos/*.png` and, beside them, `gt_mesh.ply` and `transforms.json`; returns the folder of the photos."""
    import open3d as o3d
    import trimesh

    from stages.surface.triangle_mesh import face_normals, raycaster

    vertices, faces = town()
    scene = raycaster(vertices.astype(np.float32), faces.astype(np.int32))
    normals = face_normals(vertices, faces)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    poses = flight(columns, rows)
    names = [f"photos/{i:03d}.png" for i in range(len(poses))]
    (folder / "photos").mkdir(parents=True, exist_ok=True)
    for name, pose in zip(names, poses, strict=True):
        u, v = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
        rays = np.stack([(u - SIZE[0] / 2) / FOCAL, (v - SIZE[1] / 2) / FOCAL, np.ones_like(u)], -1) @ pose[:3, :3]
        center = -pose[:3, :3].T @ pose[:3, 3]
        sent = np.concatenate([np.broadcast_to(center, rays.shape), rays], -1).astype(np.float32)
        hit = scene.cast_rays(o3d.core.Tensor(sent))
        places = center + hit["t_hit"].numpy()[..., None] * rays
        facing = np.abs(normals[np.minimum(hit["primitive_ids"].numpy(), len(faces) - 1).astype(int)])
        Image.fromarray(_painted(places, facing)).save(folder / name)
    trimesh.Trimesh(*true_town(), process=False).export(folder / TRUTH_MESH)
    write_truth(folder, names, poses, SIZE, FOCAL, {"made_by": "small_town"})
    return folder / "photos"


def _painted(places: np.ndarray, facing: np.ndarray) -> np.ndarray:
    """Colours [H, W, 3] uint8 of points: blotches of three sizes, each side of a house shaded by where it faces."""
    value = np.zeros(places.shape[:2])
    for size, strength, seed in ((0.45, 0.5, 1), (0.16, 0.9, 2), (0.07, 0.8, 3)):
        value += strength * _noise(np.nan_to_num(places) / size, seed)
    shade = 0.6 + 0.4 * facing @ np.array([0.4, 0.7, 1.0])
    tint = np.stack([0.9 + 0.1 * np.sin(3 * places[..., 0]), np.ones_like(value), 0.8 + 0.2 * facing[..., 0]], -1)
    colour = np.clip((0.5 + 0.33 * value)[..., None] * shade[..., None] * tint, 0, 1)
    return (255 * np.nan_to_num(colour)).astype(np.uint8)


def _noise(places: np.ndarray, seed: int) -> np.ndarray:
    """Smooth noise in -1..1: values at whole numbers, and between them trilinear."""
    low = np.floor(places).astype(np.int64)
    part = places - low
    total = np.zeros(places.shape[:-1])
    for corner in np.ndindex(2, 2, 2):
        at = low + corner
        mixed = (at @ np.array([73856093, 19349663, 83492791]) + seed * 2654435761) & 0xFFFFFFFF
        mixed = (mixed ^ (mixed >> 15)) * 2246822519 & 0xFFFFFFFF
        mixed = (mixed ^ (mixed >> 13)) * 3266489917 & 0xFFFFFFFF
        weight = np.where(corner, part, 1 - part).prod(-1)
        total += weight * ((mixed >> 8 & 0xFFFF) / 32767.5 - 1)
    return total
