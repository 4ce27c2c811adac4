"""From a finished workspace to a film of its model, as textured mesh or as Gaussian splats, along a path of cameras."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from stages import artifacts
from stages.atlas import ATLAS
from stages.bake import BAKE
from stages.engine.damage import damage_named
from stages.engine.status import check_current
from stages.engine.workspace import Workspace
from stages.errors import InputError, WorkspaceError, check_choice
from stages.files.films import check_film, is_video, write_film
from stages.geometry.cameras import PinholeCameras, PosedScene
from stages.geometry.normalisation import into_frame
from stages.geometry.place import Place
from stages.geometry.up import gltf_from_scene
from stages.splats import SPLATTING

ORBIT = "orbit"
SUBJECTS = ("mesh", "splats")
# A path longer than this is a mistake.
MOST_CAMERAS = 20_000
SUPERSAMPLE = 2


@dataclass(frozen=True)
class Film:
    """What is to be drawn.

    Attributes:
        what: one of SUBJECTS.
        path: ORBIT, or a `transforms.json` of cameras in the frame of the exported PLY and OBJ.
        out: a `.mp4` or `.png` file.
        size: width and height of one picture.
        frames: of an orbit in an `.mp4`; a file's path has a frame for each camera.
        sides: pictures in a `.png`, evenly along the path.
    """

    what: str
    path: str
    out: Path
    size: tuple[int, int] = (1280, 720)
    frames: int = 240
    sides: int = 1

    def check(self) -> None:
        """
        Raises:
            ConfigError: it cannot be drawn.
            InputError: there is no folder for the file.
        """
        check_film(self.out, self.size)
        check_choice("--what", self.what, SUBJECTS)


def render(workspace: Path, film: Film, progress: Callable[[int, int], None]) -> dict[str, Any]:
    """Draw the model of a workspace into the file that is wished.

    Args:
        progress: told how many pictures are done, of how many.

    Returns:
        Numbers and names of what was done.

    Raises:
        WorkspaceError: what is to be shown is not there, is of another mesh than the workspace now holds, or damaged.
        ConfigError, InputError: the wish cannot be fulfilled.
    """
    film.check()
    opened = Workspace.open(workspace)
    stages = _needed(opened, film.what)
    with damage_named(opened, stages):
        scene = artifacts.SCENE.load(opened.stage_folder(artifacts.SCENE.stage))
        place = artifacts.WORLD_PLACE.load(opened.stage_folder(artifacts.WORLD_PLACE.stage))
        mesh = artifacts.ATLAS_MESH.load(opened.stage_folder(ATLAS.name))
        cameras = path_cameras(film, mesh.vertices, scene, place)
        draw = _mesh_painter(opened, mesh) if film.what == "mesh" else _splat_painter(opened)
        pictures: Iterator[np.ndarray] = (draw(cameras, index) for index in range(len(cameras)))
        about = write_film(film.out, pictures, len(cameras), film.size, progress)
    return {"file": str(film.out.absolute()), "what": film.what, "path": film.path, **about}


def _needed(opened: Workspace, what: str) -> list[str]:
    """Stages that are read."""
    read = [artifacts.SCENE.stage, artifacts.WORLD_PLACE.stage, ATLAS.name]
    if what == "mesh":
        check_current(opened, (ATLAS, BAKE), "texture of its present mesh", "--until bake")
        return [*read, BAKE.name]
    check_current(opened, (ATLAS, SPLATTING), "splats of its present mesh", "--splats")
    if not artifacts.SPLATS.load(opened.stage_folder(SPLATTING.name)).exists():
        raise WorkspaceError(
            f"The workspace {opened.root} has no splats.",
            f"Make them: `hineus run --workspace {shlex.quote(str(opened.root))} --splats`.",
        )
    return [*read, SPLATTING.name]


# ---------------------------------------------------------------- the path
def path_cameras(film: Film, vertices: np.ndarray, scene: PosedScene, place: Place) -> PinholeCameras:
    """The film's cameras, in the scene frame that the vertices are in."""
    if film.path == ORBIT:
        return _orbit(film, vertices, scene, place)
    cameras = into_frame(read_path(Path(film.path), film.size), scene.world_from_scene(place))
    if is_video(film.out):
        return cameras
    return cameras.select(np.linspace(0, len(cameras) - 1, film.sides).round().astype(int).tolist())


def _orbit(film: Film, vertices: np.ndarray, scene: PosedScene, place: Place) -> PinholeCameras:
    """Around the model, from the side that the exported GLB turns to a viewer."""
    from stages.drawing.rendering import turntable

    up, front = gltf_from_scene(scene, place).rotation[1:]
    count = film.frames if is_video(film.out) else film.sides
    views = turntable(vertices, up, count, *film.size, front)
    return PinholeCameras(
        names=tuple(f"view {k}" for k in range(count)),
        **{
            name: np.concatenate([getattr(view, name) for view in views])
            for name in ("sizes", "intrinsics", "extrinsics")
        },
    )


def read_path(file: Path, size: tuple[int, int]) -> PinholeCameras:
    """The cameras of a `transforms.json`, in the order of their names, for pictures of `size`.

    What they see from top to bottom stays; what lens distortion they say is left out.

    Raises:
        InputError: it cannot be read, or has too many.
    """
    from stages.posing.transforms import read_transforms

    if not file.is_file():
        raise InputError(
            f"--path {str(file)[:200]} is neither `{ORBIT}` nor a file.",
            "Name a transforms.json, as `hineus export-transforms` writes it.",
        )
    known = read_transforms(file).cameras
    if len(known) > MOST_CAMERAS:
        raise InputError(f"{file} has {len(known)} cameras, at most {MOST_CAMERAS} are drawn.", "Name a shorter path.")
    width, height = size
    intrinsics = np.zeros((len(known), 3, 3))
    for matrix, camera in zip(intrinsics, known, strict=True):
        focal_x, focal_y, x, y = camera.params[:4]
        scale = height / camera.size[1]
        right, down = x - camera.size[0] / 2, y - camera.size[1] / 2
        matrix[[0, 1, 2], [0, 1, 2]] = scale * focal_x, scale * focal_y, 1
        matrix[:2, 2] = width / 2 + scale * right, height / 2 + scale * down
    return PinholeCameras(
        names=tuple(camera.name for camera in known),
        sizes=np.tile(np.array([[width, height]]), (len(known), 1)),
        intrinsics=intrinsics,
        extrinsics=np.stack([camera.cam_from_world for camera in known]),
    )


# ---------------------------------------------------------------- pictures
def _mesh_painter(opened: Workspace, mesh: artifacts.AtlasMesh) -> Callable[[PinholeCameras, int], np.ndarray]:
    from stages.drawing.rendering import render_textured

    texture = artifacts.read_texture(artifacts.BASE_COLOR.load(opened.stage_folder(BAKE.name)))
    return lambda cameras, index: render_textured(mesh, texture, cameras.select([index]), supersample=SUPERSAMPLE)


def _splat_painter(opened: Workspace) -> Callable[[PinholeCameras, int], np.ndarray]:
    from stages.gaussians.keeping import read_gaussians
    from stages.gaussians.pictures import draw_picture

    gaussians = read_gaussians(artifacts.SPLATS.load(opened.stage_folder(SPLATTING.name)))
    return lambda cameras, index: draw_picture(gaussians, cameras, index)
