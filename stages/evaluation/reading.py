"""Files that are measured and what they are measured with: surfaces, cameras, masks, a matrix."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from stages import artifacts
from stages.engine.damage import damage_named
from stages.engine.workspace import Workspace
from stages.errors import InputError, WorkspaceError
from stages.evaluation.surfaces import Surface
from stages.geometry.cameras import PinholeCameras
from stages.geometry.normalisation import into_frame
from stages.inputs.bounded import reason
from stages.inputs.meshes import read_geometry
from stages.inputs.texts import read_text

NO_SIMILARITY = "It takes points of the first surface to the truth's frame: a turn, a scale, a shift."
SMALLEST, LARGEST = 1e-9, 1e9  # extent of a surface that distances can be told of; a number in a matrix


# ---------------------------------------------------------------- surfaces
def read_surface(path: Path) -> Surface:
    """A mesh (PLY, OBJ, STL, GLB, glTF, OFF) or a cloud of points (PLY without faces, PCD, XYZ, PTS).

    Raises:
        InputError: it is neither, or no larger than a point.
    """
    if not path.is_file():
        raise InputError(f"There is no file {path}.", "Name a mesh, a cloud of points, or a workspace.")
    try:
        with np.errstate(all="ignore"):  # what overflows is refused by what comes of it
            surface = Surface(*read_geometry(path))
    except Exception as error:  # damaged files raise nearly anything
        raise InputError(
            f"{path} cannot be read as a mesh or as points: {reason(error)}.",
            "Name a PLY, OBJ, GLB, glTF, STL, OFF, PCD, XYZ or PTS file, or a workspace.",
        ) from error
    if not surface.extent >= SMALLEST:
        raise InputError(f"{path} has an extent of {surface.extent:g}: it is no surface.", "Name another file.")
    return surface


def mesh_path(place: Path) -> Path:
    """The mesh of a workspace, that which was exported; a file is its own."""
    if not place.is_dir():
        return place
    path = artifacts.asset_path(place / "export", "ply")
    if not path.exists():
        raise InputError(
            f"{place} holds no exported PLY ({path.relative_to(place)}).",
            f"Make it with ply in `export.formats`: `hineus export --workspace {place}`; or name a mesh file.",
        )
    return path


def read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] float64 and faces [F, 3] of a mesh file.

    Raises:
        InputError: as `read_surface`, or it is a cloud.
    """
    surface = read_surface(path)
    if surface.faces is None:
        raise InputError(f"{path} holds {len(surface.points)} points and no faces.", "Name a mesh, not a point cloud.")
    return surface.points, surface.faces


def read_prediction(place: Path) -> tuple[Path, Surface]:
    """The file and the surface of what is judged: a file as it is, or a workspace's PLY in the frame of its poses.

    Raises:
        InputError: it cannot be read.
    """
    path = mesh_path(place)
    if not place.is_dir():
        return path, read_surface(path)
    opened = Workspace.open(place)
    with damage_named(opened, ["export", "place"]):
        in_world = artifacts.WORLD_PLACE.load(opened.stage_folder("place"))
        return path, read_surface(path).moved(in_world.world_from_poses.inverse().matrix())


# ---------------------------------------------------------------- cameras
@dataclass(frozen=True)
class Cameras:
    """Cameras in the frame of a surface.

    Attributes:
        origin: what they were read from, in words.
        pinhole: without their distortion.
        distorted: how many have one, which is left out.
    """

    origin: str
    pinhole: PinholeCameras
    distorted: int = 0

    @property
    def centers(self) -> dict[str, np.ndarray]:
        """Projection centres [3] by the names of the photos, without folders and suffixes."""
        return {Path(name).stem: center for name, center in zip(self.pinhole.names, self.pinhole.centers, strict=True)}


def read_cameras(path: Path) -> Cameras:
    """Cameras of a file or folder of poses in any format that `hineus run --poses` takes.

    Raises:
        InputError: they cannot be read.
    """
    import pycolmap

    from stages.posing.reading import read_poses

    known = read_poses(path)
    models = [
        pycolmap.Camera(model=camera.model, width=camera.size[0], height=camera.size[1], params=list(camera.params))
        for camera in known.cameras
    ]
    pinhole = PinholeCameras(
        tuple(camera.name for camera in known.cameras),
        np.array([camera.size for camera in known.cameras]),
        np.stack([model.calibration_matrix() for model in models]),
        np.stack([camera.cam_from_world for camera in known.cameras]),
    )
    bent = [any(model.params[row] for row in model.extra_params_idxs()) for model in models]
    return Cameras(str(known.origin), pinhole, sum(bent))


def workspace_cameras(workspace: Path) -> Cameras:
    """Cameras of a workspace in the frame of its poses.

    Raises:
        WorkspaceError: there is none, or it has no undistorted photos.
    """
    opened = Workspace.open(workspace)
    if opened.published("undistort") is None:
        raise WorkspaceError(
            f"{workspace} has no undistorted photos.", f"Make them: `hineus undistort --workspace {workspace}`."
        )
    with damage_named(opened, ["undistort"]):
        scene = artifacts.FIRST_SCENE.load(opened.stage_folder("undistort"))
    return Cameras(str(workspace), into_frame(scene.cameras, scene.poses_from_scene.inverse()))


def own_cameras(predicted: Path, given: Path | None) -> Cameras | None:
    """Cameras in the frame of what is judged: those that were given, or a workspace's own."""
    if given is not None:
        return read_cameras(given)
    return workspace_cameras(predicted) if predicted.is_dir() else None


def read_masks(folder: Path, cameras: PinholeCameras) -> Iterator[tuple[int, np.ndarray]]:
    """Camera and mask [H, W] bool of the photos that have one in `folder`, named like them.

    Raises:
        InputError: none has one, or one is not of its camera's size.
    """
    from stages.capture.masks import load_mask, match_masks

    if not folder.is_dir():
        raise InputError(f"There is no folder {folder}.", "`--masks` takes a folder of masks, named like the photos.")
    found = match_masks(list(cameras.names), folder)
    if not found:
        raise InputError(
            f"None of the {len(cameras)} photos, e.g. {cameras.names[0]}, has a mask in {folder}.",
            "Masks are named like the photos of `--true-cameras`.",
        )
    for i, name in enumerate(cameras.names):
        if name in found:
            size = int(cameras.sizes[i][0]), int(cameras.sizes[i][1])
            yield i, load_mask(found[name], name, size, size, 1).kept


def read_matrix(path: Path) -> np.ndarray:
    """A similarity [4, 4] from a text file of 16 numbers.

    Raises:
        InputError: it is none.
    """
    try:
        words = re.sub("#.*", "", read_text(path)).split()
        matrix = np.array(words, dtype=np.float64).reshape(4, 4)
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path} holds no 4 x 4 numbers ({reason(error)}).", "Write four lines of four numbers."
        ) from error
    if not (np.abs(matrix) <= LARGEST).all() or (matrix[3] != (0, 0, 0, 1)).any():
        raise InputError(
            f"The matrix in {path} has numbers beyond {LARGEST:g}, or its last line is not 0 0 0 1.", NO_SIMILARITY
        )
    linear = matrix[:3, :3]
    squared = np.trace(linear @ linear.T) / 3
    if not np.allclose(linear @ linear.T, squared * np.eye(3), atol=1e-3 * squared) or np.linalg.det(linear) <= 0:
        raise InputError(
            f"The matrix in {path} is no similarity: its 3 x 3 part skews, mirrors or shrinks to nothing.",
            NO_SIMILARITY,
        )
    return matrix
