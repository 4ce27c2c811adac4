"""Score a mesh against a known object: reads the files, leaves the measuring to `known_surface`.

The truth is a folder with `gt_mesh.ply` and `transforms.json` (w, h, fl_x, fl_y, cx, cy; per frame
`file_path` and `w2c_opencv`). Mesh and truth meet by the camera centres of the COLMAP model: a similarity,
no ICP.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from stages.errors import InputError
from stages.evaluation.known_surface import KnownSurface, score_surface
from stages.geometry.similarity import align_points

TRUTH_MESH = "gt_mesh.ply"
TRUTH_CAMERAS = "transforms.json"


def has_truth(folder: Path) -> bool:
    """Whether a folder holds a known object to score against."""
    return (folder / TRUTH_MESH).is_file() and (folder / TRUTH_CAMERAS).is_file()


def load_known_surface(folder: Path) -> tuple[KnownSurface, dict[str, np.ndarray]]:
    """The known object, and its camera centres [3] by file name."""
    import trimesh

    if not has_truth(folder):
        raise InputError(
            f"{folder} holds no known object ({TRUTH_MESH} and {TRUTH_CAMERAS}).",
            "Name the folder that `hineus demo` made, or one with these two files.",
        )
    mesh = trimesh.load(folder / TRUTH_MESH, process=False)
    truth = json.loads((folder / TRUTH_CAMERAS).read_text(encoding="utf-8"))
    poses = {Path(frame["file_path"]).name: np.array(frame["w2c_opencv"]) for frame in truth["frames"]}
    known = KnownSurface(
        vertices=np.asarray(mesh.vertices),
        faces=np.asarray(mesh.faces),
        intrinsics=np.array([[truth["fl_x"], 0, truth["cx"]], [0, truth["fl_y"], truth["cy"]], [0, 0, 1.0]]),
        size=(int(truth["w"]), int(truth["h"])),
        cam_from_world=np.stack(list(poses.values())),
    )
    return known, {name: _center(pose) for name, pose in poses.items()}


def load_model_centers(model: Path) -> dict[str, np.ndarray]:
    """Camera centres [3] of a COLMAP model by file name."""
    import pycolmap

    reconstruction = pycolmap.Reconstruction(str(model))
    centers = {}
    for image in reconstruction.images.values():
        if image.has_pose:
            centers[Path(image.name).name] = _center(np.asarray(image.cam_from_world().matrix()))
    return centers


def file_stem(name: str) -> str:
    """Name of a file without folders and suffix."""
    return Path(name).stem


def score_mesh(
    mesh_path: Path, model: Path, truth: Path, known_stem: Callable[[str], str] = file_stem
) -> dict[str, float]:  # fmt: skip
    """Distances of a mesh (in the frame of the COLMAP model) to the known object, see `SurfaceScore`.

    Args:
        known_stem: name of a photo in the model -> that of the truth without its suffix. Photos may have been renamed
            on the way in (another suffix): the stem decides.
    """
    import trimesh

    known, true_centers = load_known_surface(truth)
    centers = load_model_centers(model)
    true_by_stem = {file_stem(name): center for name, center in true_centers.items()}
    shared = [name for name in sorted(centers) if known_stem(name) in true_by_stem]
    if len(shared) < 3:
        raise InputError(
            f"Only {len(shared)} of {len(centers)} cameras of {model} have a known pose (need 3).",
            f"Check that {truth} belongs to these photos.",
        )
    world_from_model = align_points(
        np.array([centers[name] for name in shared]), np.array([true_by_stem[known_stem(name)] for name in shared])
    )
    mesh = trimesh.load(mesh_path, process=False, force="mesh")
    try:
        score = score_surface(world_from_model.apply(np.asarray(mesh.vertices)), np.asarray(mesh.faces), known)
    except ValueError as error:
        raise InputError(f"{mesh_path} cannot be scored: {error}.", f"Look at it, and at {truth}.") from error
    return score.as_dict()


def _center(cam_from_world: np.ndarray) -> np.ndarray:
    return -cam_from_world[:3, :3].T @ cam_from_world[:3, 3]
