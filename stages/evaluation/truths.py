"""What results are held against, read from the layouts it is published in: surfaces, scans, cameras, masks."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stages import artifacts
from stages.engine.workspace import Workspace
from stages.errors import InputError, WorkspaceError
from stages.evaluation.comparison import mesh_path, read_mesh
from stages.evaluation.dtu import DtuTruth
from stages.evaluation.surfaces import Surface
from stages.evaluation.tanks import CropVolume
from stages.geometry.cameras import PinholeCameras, PosedScene

CLOUDS = (".pcd", ".xyz", ".pts")


# ---------------------------------------------------------------- surfaces
def read_surface(path: Path) -> Surface:
    """A mesh of any format that trimesh reads, or a cloud of points (PLY without faces, PCD, XYZ, PTS).

    Raises:
        InputError: it is neither.
    """
    if not path.is_file():
        raise InputError(f"There is no file {path}.", "Name a mesh, a cloud of points, or a workspace.")
    if path.suffix.lower() in CLOUDS or (path.suffix.lower() == ".ply" and not _has_faces(path)):
        return _read_cloud(path)
    vertices, faces = read_mesh(path)
    return Surface(vertices, faces)


def read_prediction(place: Path) -> tuple[Path, Surface]:
    """The file and the surface of what is judged: a file as it is, or a workspace's PLY in the frame of its poses.

    Raises:
        InputError: it cannot be read.
    """
    path = mesh_path(place)
    surface = read_surface(path)
    if not place.is_dir():
        return path, surface
    poses_from_world = artifacts.load_place(Workspace.open(place).stage_folder("place")).world_from_poses.inverse()
    return path, surface.moved(poses_from_world.matrix())


def _has_faces(path: Path) -> bool:
    """Whether a PLY file's header announces faces."""
    with path.open("rb") as stream:
        for line in stream:
            words = line.split()
            if words[:2] == [b"element", b"face"]:
                return int(words[2]) > 0
            if words == [b"end_header"]:
                return False
    return True  # no header: let the reader of meshes say so


def _read_cloud(path: Path) -> Surface:
    import open3d as o3d

    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud = o3d.io.read_point_cloud(str(path))
    points = np.asarray(cloud.points)
    if not len(points):
        raise InputError(f"{path} cannot be read as points.", "Name a PLY, PCD, XYZ or PTS file with points.")
    normals = np.asarray(cloud.normalize_normals().normals) if cloud.has_normals() else None
    return Surface(points, None, normals)


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
    scene = _posed_scene(workspace)
    frame, cameras = scene.poses_from_scene, scene.cameras
    rotation = cameras.cam_from_scene[:, :, :3] @ frame.rotation.T
    translation = -np.einsum("nij,nj->ni", rotation, frame.apply(cameras.centers))
    poses = np.concatenate([rotation, translation[:, :, None]], 2)
    return Cameras(str(workspace), PinholeCameras(cameras.names, cameras.sizes, cameras.intrinsics, poses))


def _posed_scene(workspace: Path) -> PosedScene:
    opened = Workspace.open(workspace)
    if opened.published("undistort") is None:
        raise WorkspaceError(
            f"{workspace} has no undistorted photos.", f"Make them: `hineus undistort --workspace {workspace}`."
        )
    return artifacts.load_scene(opened.stage_folder("undistort"))


def read_masks(folder: Path, cameras: PinholeCameras) -> Iterator[tuple[int, np.ndarray]]:
    """Camera and mask [H, W] bool of the photos that have one in `folder`, named like them.

    Raises:
        InputError: none has one, or one is not of its camera's size.
    """
    from stages.capture.masks import match_masks, read_mask

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
            yield i, read_mask(found[name], name, size, size, 1)


def read_matrix(path: Path) -> np.ndarray:
    """A similarity [4, 4] from a text file of 16 numbers.

    Raises:
        InputError: it is none.
    """
    try:
        matrix = np.loadtxt(path).reshape(4, 4)
    except (OSError, ValueError) as error:
        raise InputError(f"{path} holds no 4 x 4 numbers ({error}).", "Write four lines of four numbers.") from error
    linear = matrix[:3, :3]
    squared = np.trace(linear @ linear.T) / 3
    if not np.allclose(linear @ linear.T, squared * np.eye(3), atol=1e-3 * squared) or np.linalg.det(linear) <= 0:
        raise InputError(
            f"The matrix in {path} is no similarity: its 3 x 3 part skews, mirrors or shrinks to nothing.",
            "It takes points of the first surface to the truth's frame: a turn, a scale, a shift.",
        )
    return matrix


# ---------------------------------------------------------------- DTU
def read_dtu(data: Path, scan: int) -> DtuTruth:
    """The truth of one scan from `SampleSet/MVS Data` of DTU, with the scans of `Points`.

    Raises:
        InputError: a file is missing or does not hold what it should.
    """
    observed, plane, scanned = (
        data / "ObsMask" / f"ObsMask{scan}_10.mat",
        data / "ObsMask" / f"Plane{scan}.mat",
        data / "Points" / "stl" / f"stl{scan:03}_total.ply",
    )
    missing = [str(path.relative_to(data)) for path in (observed, plane, scanned) if not path.is_file()]
    if missing:
        raise InputError(
            f"{data} lacks {len(missing)} of 3 files of scan {scan}: {', '.join(missing)}.",
            "`--data` takes the folder with ObsMask/ (of DTU's SampleSet) and Points/stl/ (of its Points).",
        )
    cells, box, side = (_matrix(observed, key) for key in ("ObsMask", "BB", "Res"))
    ground = _matrix(plane, "P")
    if cells.ndim != 3 or box.shape != (2, 3) or side.size != 1 or ground.size != 4:
        raise InputError(
            f"{observed} and {plane} hold ObsMask {cells.shape}, BB {box.shape}, Res {side.shape} and P "
            f"{ground.shape}, need [X, Y, Z], (2, 3), 1 and 4 numbers.",
            "Unpack DTU's SampleSet again.",
        )
    return DtuTruth(
        read_surface(scanned).points, cells.astype(bool), box.astype(np.float32), float(side.item()), ground.ravel()
    )


def _matrix(path: Path, key: str) -> np.ndarray:
    from scipy.io import loadmat

    try:
        return np.asarray(loadmat(str(path))[key])
    except Exception as error:  # scipy raises nearly anything on a damaged file
        raise InputError(f"{path} holds no matrix {key} ({error}).", "Unpack DTU's SampleSet again.") from error


# ---------------------------------------------------------------- GlossySynthetic
@dataclass(frozen=True)
class GlossyTruth:
    """Cameras of an object's test views, and the depth of each, [H, W], infinite off the object."""

    cameras: PinholeCameras
    depths: list[np.ndarray]


def read_glossy(data: Path, split: Path | None) -> GlossyTruth:
    """The test views of an object of GlossySynthetic; all views without a split.

    Raises:
        InputError: cameras or depth images are missing or cannot be read.
    """
    from stages.posing import nero

    if not data.is_dir() or not nero.has_cameras(data):
        raise InputError(
            f"{data} holds no *{nero.CAMERA}.", "`--data` takes an object's folder of GlossySynthetic, e.g. `bell`."
        )
    found = read_cameras(data).pinhole
    stems = [Path(name).stem for name in found.names]
    wanted = stems if split is None else nero.read_split(split)
    missing = [stem for stem in wanted if stem not in stems or not (data / f"{stem}{nero.DEPTH}").is_file()]
    if missing or not wanted:
        raise InputError(
            f"{len(missing)} of {len(wanted)} views have no camera or no depth in {data}, e.g. "
            f"{(missing or ['-'])[0]}{nero.DEPTH}.",
            "Unpack GlossySynthetic again, or name the split that belongs to it.",
        )
    cameras = found.select([stems.index(stem) for stem in wanted])
    return GlossyTruth(cameras, [nero.read_depth(data / f"{stem}{nero.DEPTH}") for stem in wanted])


# ---------------------------------------------------------------- Tanks and Temples
@dataclass(frozen=True)
class TanksTruth:
    """A scene of Tanks and Temples.

    Attributes:
        name: of the scene.
        points: [P, 3] of the scan.
        crop: where it is scored.
        centers: [N, 3] of the reference cameras in the scan's frame, in the order of the photos; None: not there.
    """

    name: str
    points: np.ndarray
    crop: CropVolume
    centers: np.ndarray | None


def read_tanks(data: Path) -> TanksTruth:
    """A scene from its folder: `SCENE.ply`, `SCENE.json`, `SCENE_COLMAP_SfM.log`, `SCENE_trans.txt`.

    Raises:
        InputError: the scan or the crop volume is missing, or a file cannot be read.
    """
    scene = data.resolve().name
    scan, crop = data / f"{scene}.ply", data / f"{scene}.json"
    missing = [path.name for path in (scan, crop) if not path.is_file()]
    if missing:
        raise InputError(
            f"{data} lacks {', '.join(missing)}.",
            "`--data` takes a scene's folder of Tanks and Temples' training data, whose name is the scene's.",
        )
    log, trans = data / f"{scene}_COLMAP_SfM.log", data / f"{scene}_trans.txt"
    centers = None
    if log.is_file() and trans.is_file():
        matrix = read_matrix(trans)
        centers = _trajectory(log) @ matrix[:3, :3].T + matrix[:3, 3]
    return TanksTruth(scene, read_surface(scan).points, _crop_volume(crop), centers)


def _crop_volume(path: Path) -> CropVolume:
    try:
        data: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        axis = "XYZ".index(data["orthogonal_axis"].upper())
        polygon = np.delete(np.array(data["bounding_polygon"], dtype=np.float64), axis, axis=1)
        return CropVolume(axis, float(data["axis_min"]), float(data["axis_max"]), polygon)
    except (OSError, ValueError, KeyError, AttributeError, IndexError) as error:
        raise InputError(
            f"{path} is no crop volume ({error}).",
            "It needs orthogonal_axis, axis_min, axis_max and bounding_polygon, as Open3D writes them.",
        ) from error


def _trajectory(path: Path) -> np.ndarray:
    """Camera centres [N, 3] of a log: for each camera a line of three numbers and a matrix [4, 4] world_from_cam."""
    try:
        numbers = np.array(path.read_text(encoding="utf-8").split(), dtype=np.float64).reshape(-1, 19)
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path} is no trajectory ({error}).", "It needs a line of three numbers and four of four, a camera each."
        ) from error
    return numbers[:, 3:].reshape(-1, 4, 4)[:, :3, 3]
