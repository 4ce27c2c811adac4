"""From a finished workspace to pictures of its asset in another light."""

from __future__ import annotations

import logging
import shlex
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from stages import artifacts
from stages.atlas import ATLAS
from stages.bake import BAKE
from stages.engine.damage import damage_named
from stages.engine.status import check_current, replaced_inputs
from stages.engine.workspace import Workspace
from stages.errors import ConfigError, WorkspaceError, check_choice, did_you_mean
from stages.files.films import check_film, is_video, write_film
from stages.geometry.up import gltf_from_scene
from stages.light.built_in import LIGHTS, MEAN
from stages.light.environment import mean_radiance
from stages.materials import MATERIALS

if TYPE_CHECKING:
    from stages.drawing.relighting import Material
    from stages.geometry.cameras import PinholeCameras
    from stages.light.levels import Levels

    # From a camera and the turn of the light to radiance and coverage, see `stages.drawing.relighting.relit`.
    Renderer = Callable[[PinholeCameras, float], tuple[np.ndarray, np.ndarray]]

log = logging.getLogger(__name__)

LEARNED = "learned"
# Rows of the maps of built-in lights.
BUILT_IN_ROWS = 256
RENDERERS = ("hineus", "mitsuba")

UP, FRONT = np.array([0.0, 1, 0]), np.array([0.0, 0, 1])


@dataclass(frozen=True)
class Wish:
    """What is to be drawn.

    Attributes:
        light: `LEARNED`, a name of `LIGHTS`, or a file.
        out: a `.png` or `.mp4` file.
        turn_deg: the light is turned by, about the vertical.
        exposure_ev: the pictures are 2^EV times as bright.
        size: width and height of one picture.
        sides: pictures in a row, evenly from all sides; of a `.png`.
        frames: of an `.mp4`.
        turn_light: the light goes around, not the asset.
        background: one of `stages.drawing.relighting.BACKGROUNDS`.
        renderer: one of RENDERERS.
    """

    light: str
    out: Path
    turn_deg: float = 0.0
    exposure_ev: float = 0.0
    size: tuple[int, int] = (640, 480)
    sides: int = 1
    frames: int = 120
    turn_light: bool = False
    background: str = "light"
    renderer: str = "hineus"

    @property
    def is_video(self) -> bool:
        return is_video(self.out)

    @property
    def count(self) -> int:
        """Of pictures."""
        return self.frames if self.is_video else self.sides

    def check(self) -> None:
        """
        Raises:
            ConfigError: it cannot be drawn.
            InputError: there is no folder for the file.
        """
        from stages.drawing.relighting import BACKGROUNDS

        check_film(self.out, self.size)
        check_choice("--renderer", self.renderer, RENDERERS)
        check_choice("--background", self.background, BACKGROUNDS)
        if self.is_video and self.background == "transparent":
            raise ConfigError("A video has no transparent background.", "Try `--background white`, or a .png file.")


@dataclass(frozen=True)
class Subject:
    """A workspace's asset in the frame of its GLB, Y up.

    Attributes:
        tangents: [V, 4] of the normal map, where there is one.
        light_file: the light that was learned with the materials; None where there are none.
    """

    mesh: artifacts.AtlasMesh
    tangents: np.ndarray | None
    material: Material
    light_file: Path | None


def relight(workspace: Path, wish: Wish, progress: Callable[[int, int], None]) -> dict[str, Any]:
    """Draw the asset of a workspace into the file that is wished.

    Args:
        progress: told how many pictures are done, of how many.

    Returns:
        Numbers and names of what was done.

    Raises:
        WorkspaceError: there is no textured mesh, it is of others than the workspace now holds, or damaged; or no light
            was learned.
        ConfigError, InputError, SystemRequirementError: the wish cannot be fulfilled.
    """
    from stages.drawing.tone_mapping import NAME

    wish.check()
    opened = Workspace.open(workspace)
    stages = _needed(opened)
    given = _given_light(wish.light, opened)
    with damage_named(opened, stages):
        subject = read_subject(opened)
        radiance, metered = given if given is not None else (_learned_light(subject, opened), 0.0)
        if subject.light_file is None:
            _tell_of_no_materials(opened)
        pictures = _pictures(subject, radiance, wish, wish.exposure_ev + metered)
        about = write_film(wish.out, pictures, wish.count, wish.size, progress)
    return {
        "file": str(wish.out.absolute()),
        "light": wish.light,
        "materials": subject.light_file is not None,
        "renderer": wish.renderer,
        "tone_mapping": NAME,
        "exposure_ev": round(wish.exposure_ev + metered, 2),
        **about,
    }


# ---------------------------------------------------------------- what is there
def _needed(opened: Workspace) -> list[str]:
    """Stages that are read; those that materials come from only where there are some."""
    check_current(opened, (ATLAS, BAKE), "texture of its present mesh", "--until bake")
    with_materials = not replaced_inputs(MATERIALS, opened)
    read = [artifacts.SCENE.stage, artifacts.WORLD_PLACE.stage, ATLAS.name, BAKE.name]
    return [*read, *([MATERIALS.name] if with_materials else [])]


def read_subject(opened: Workspace) -> Subject:
    """The asset: with its materials, or with the photos' colours and the roughness that exported files say."""
    from stages.drawing.relighting import Material
    from stages.files.contents import ROUGHNESS
    from stages.surface.placing import placed
    from stages.texture.tangents import vertex_tangents

    def path(artifact: artifacts.Artifact[Path]) -> Path:
        return artifact.load(opened.stage_folder(artifact.stage))

    scene = artifacts.SCENE.load(opened.stage_folder(artifacts.SCENE.stage))
    place = artifacts.WORLD_PLACE.load(opened.stage_folder(artifacts.WORLD_PLACE.stage))
    mesh = placed(artifacts.ATLAS_MESH.load(opened.stage_folder("atlas")), gltf_from_scene(scene, place))
    normal = artifacts.read_texture(path(artifacts.NORMAL_MAP)) if path(artifacts.NORMAL_MAP).exists() else None
    tangents = None if normal is None else vertex_tangents(mesh)
    if path(artifacts.MATERIAL_COLOR).exists() and not replaced_inputs(MATERIALS, opened):
        material = Material(
            artifacts.read_texture(path(artifacts.MATERIAL_COLOR)), artifacts.read_texture(path(artifacts.ORM)), normal
        )
        return Subject(mesh, tangents, material, path(artifacts.LIGHT))
    orm = np.full((1, 1, 3), (255, round(255 * ROUGHNESS), 0), np.uint8)
    if path(artifacts.OCCLUSION).exists():
        occlusion = artifacts.read_texture(path(artifacts.OCCLUSION))
        orm = np.stack(
            [occlusion[..., 0], *(np.full(occlusion.shape[:2], value, np.uint8) for value in orm[0, 0, 1:])], 2
        )
    return Subject(mesh, tangents, Material(artifacts.read_texture(path(artifacts.BASE_COLOR)), orm, normal), None)


def _tell_of_no_materials(opened: Workspace) -> None:
    log.warning(
        "No materials were learned: the photos' colours, with the light in them, stand for the base colour, and all is "
        "matt. For more: `hineus run --workspace %s --relightable`.", shlex.quote(str(opened.root)),
    )  # fmt: skip


# ---------------------------------------------------------------- the light
def _given_light(name: str, opened: Workspace) -> tuple[np.ndarray, float] | None:
    """Radiance and the exposure (EV) that it is metered for: 0 of a built-in light; None where the learned is asked."""
    from stages.files.light_files import read_light

    if name == LEARNED:
        return None
    if name in LIGHTS:
        return LIGHTS[name](BUILT_IN_ROWS), 0.0
    if not Path(name).suffix and not Path(name).exists():
        known = (LEARNED, *LIGHTS)
        hint = did_you_mean(name, known, "--light {}")
        raise ConfigError(
            f"--light {name[:40]} is neither known nor a file.", f"{hint}There are {', '.join(known)}; or name a file."
        )
    radiance = read_light(Path(name))
    return radiance, float(np.log2(MEAN / mean_radiance(radiance)))


def _learned_light(subject: Subject, opened: Workspace) -> np.ndarray:
    from stages.files.light_files import read_light

    if subject.light_file is None or not subject.light_file.exists():
        raise WorkspaceError(
            f"No light was learned in {opened.root}.",
            f"Learn it: `hineus run --workspace {shlex.quote(str(opened.root))} --relightable`; "
            f"or try `--light {next(iter(LIGHTS))}`.",
        )
    return read_light(subject.light_file)


# ---------------------------------------------------------------- pictures
def views(vertices: np.ndarray, wish: Wish) -> list[tuple[PinholeCameras, float]]:
    """Cameras, and by how much the light is turned for each.

    The asset turns before a camera and a light that stay: so the camera goes around it, and the light with the camera.
    """
    from stages.drawing.rendering import turntable

    count = wish.count
    angles = 360 * np.arange(count) / count
    width, height = wish.size
    if wish.turn_light:
        (camera,) = turntable(vertices, UP, 1, width, height, FRONT)
        return [(camera, wish.turn_deg + angle) for angle in angles]
    # counter-clockwise from above is from +Z to +X, which is against φ
    cameras = turntable(vertices, UP, count, width, height, FRONT)
    return [(camera, wish.turn_deg - angle) for camera, angle in zip(cameras, angles, strict=True)]


def _pictures(subject: Subject, radiance: np.ndarray, wish: Wish, exposure_ev: float) -> Iterator[np.ndarray]:
    from stages.drawing.relighting import behind
    from stages.drawing.tone_mapping import picture
    from stages.light.levels import levels_of

    levels = levels_of(radiance)
    draw = _path_tracer(subject, radiance) if wish.renderer == "mitsuba" else _rasterizer(subject, levels)
    for camera, turn_deg in views(subject.mesh.vertices, wish):
        backdrop: np.ndarray | float | None = {"white": 1.0}.get(wish.background)
        if wish.background == "light":
            backdrop = behind(levels, camera, turn_deg)
        yield picture(*draw(camera, turn_deg), backdrop, exposure_ev)


def _rasterizer(subject: Subject, levels: Levels) -> Renderer:
    from stages.drawing.relighting import relit

    return lambda camera, turn_deg: relit(subject.mesh, subject.material, levels, camera, subject.tangents, turn_deg)


def _path_tracer(subject: Subject, radiance: np.ndarray) -> Renderer:
    from stages.drawing.path_tracing import PathTracer, choose_variant

    return PathTracer(subject.mesh, subject.material, radiance, choose_variant()[0]).relit
