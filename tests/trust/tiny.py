"""A run so small that it can be broken a hundred times, and valid input of every kind, mostly written by it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from trust_runs import Ended, run_hineus, run_in_child

from configs.params import MaterialsParams
from stages.engine.stage import StageContext
from stages.pipeline import PIPELINE

PHOTOS, SIZE = 12, (480, 360)
SETTINGS = {
    "train.steps": 40,
    "train.steps_if_covered": 1,
    "cleanup.target_faces": 500,
    "atlas.texture_size": 128,
}
RUN = ["--preset", "tiny", "--deterministic", "--workers", "1", "--device", "cpu"]
RUN += [word for name, value in SETTINGS.items() for word in ("--set", f"{name}={value}")]
RELIGHTABLE = ["--set", "materials.enabled=true"]
WITHIN_S = 300.0
STAGES = [stage.name for stage in PIPELINE]
HOLD_TIMES = ("manifest.json", "report.html")


@dataclass(frozen=True)
class Tiny:
    """A finished run.

    Attributes:
        folder: holds `photos` (and the truth beside them), `workspace`, `relightable` and `inputs`.
    """

    folder: Path

    @property
    def photos(self) -> Path:
        return self.folder / "photos"

    @property
    def workspace(self) -> Path:
        return self.folder / "workspace"

    @property
    def relightable(self) -> Path:
        """The same with materials and a light, which are made up: to learn them takes a minute."""
        return self.folder / "relightable"

    def input(self, name: str) -> Path:
        """A valid input of the kind that the name says."""
        return self.folder / "inputs" / name

    def begun(self, workspace: Path, stages: Sequence[str]) -> Path:
        """A workspace in which these stages, the first ones, are done."""
        workspace.mkdir()
        shutil.copy(self.workspace / "workspace.json", workspace)
        for stage in stages:
            shutil.copytree(self.workspace / stage, workspace / stage)
        return workspace

    def run(self, workspace: Path, *more: str, seconds: float = WITHIN_S, **extra: object) -> Ended:
        """The same run in another workspace."""
        words = ["run", str(self.photos), "-w", str(workspace), *RUN, *more]
        return run_hineus(words, self.folder, seconds, **extra)  # type: ignore[arg-type]


def make_tiny(folder: Path) -> Tiny:
    """Photos, the unbroken run and the inputs."""
    tiny = Tiny(folder)
    _child(folder, _photos, folder)
    ended = tiny.run(tiny.workspace)
    assert ended.code == 0, ended.output
    shutil.copytree(tiny.workspace, tiny.relightable)
    ended = tiny.run(tiny.relightable, *RELIGHTABLE, first=make_up_materials)
    assert ended.code == 0, ended.output
    tiny.input("").mkdir()
    for command, name in (("export-colmap", "colmap"), ("export-transforms", "nerfstudio")):
        ended = run_hineus([command, str(tiny.workspace), str(tiny.input(name))], folder, WITHIN_S)
        assert ended.code == 0, ended.output
    _child(folder, _inputs, tiny)
    return tiny


def make_up_materials() -> None:
    """Let the stage of the materials leave a matte thing in the light of a window, in this process."""
    from stages import artifacts
    from stages.files.light_files import harmonics_json, write_exr, write_hdr
    from stages.light.built_in import LIGHTS
    from stages.materials import MATERIALS

    def run(context: StageContext[MaterialsParams]) -> dict[str, Any]:
        if not context.params.enabled:
            return {}
        light = LIGHTS["window"](32)
        shutil.copy(context.read(artifacts.BASE_COLOR), context.to_write(artifacts.MATERIAL_COLOR))
        side = context.read(artifacts.ATLAS_MESH).texture_size
        artifacts.write_png(context.to_write(artifacts.ORM), np.full((side, side, 3), (255, 200, 0), np.uint8))
        artifacts.write_png(context.to_write(artifacts.KNOWN), np.full((side, side), 255, np.uint8))
        write_exr(context.to_write(artifacts.LIGHT), light)
        write_hdr(context.to_write(artifacts.LIGHT_HDR), light)
        artifacts.write_json(context.to_write(artifacts.LIGHT_HARMONICS), harmonics_json(light))
        of_all = {"share": 1.0, "metallic": False, "roughness": 0.784, "roughness_told": True}
        return {"materials": [of_all], "light_max_over_mean": 9.0, "gain_min": 1.0, "gain_max": 1.0, "cost": 0.1}

    object.__setattr__(MATERIALS, "run", run)  # the record is frozen, and all know this one


def _child(folder: Path, work: object, *arguments: object) -> None:
    ended = run_in_child(lambda: work(*arguments), folder, WITHIN_S)  # type: ignore[operator]
    assert ended.code == 0, ended.output


def _photos(folder: Path) -> None:
    from stages.scenes.demo_photos import make_demo_photos

    make_demo_photos(folder, PHOTOS, SIZE)


def _inputs(tiny: Tiny) -> None:
    _picture_files(tiny)
    _video(tiny.input("video.mp4"))
    _meshes(tiny)
    _poses(tiny)
    tiny.input("control.csv").write_text(
        "name,x,y,z,photo,px,py\n"
        + "".join(f"P{i % 3},{i % 3}.5,{i % 2}.25,0.125,{i:03d}.jpg,{100 + 9 * i}.5,{90 + 5 * i}\n" for i in range(9))
    )
    tiny.input("gcp_list.txt").write_text(
        "EPSG:32632\n"
        + "".join(f"5000{i % 3}0.5 53000{i % 3}0 10{i % 3} {100 + i} 9{i} {i:03d}.jpg P{i % 3}\n" for i in range(9))
    )
    _lights(tiny)
    np.savetxt(tiny.input("matrix.txt"), np.diag([2.0, 2, 2, 1]))
    shutil.copy(tiny.workspace / "config.yaml", tiny.input("config.yaml"))


def _picture_files(tiny: Tiny) -> None:
    from PIL import Image

    from stages.inputs.formats import register_formats

    register_formats()
    picture = Image.open(tiny.photos / "000.jpg").resize((96, 72))
    exif = Image.open(tiny.photos / "000.jpg").info["exif"]
    for suffix in ("jpg", "png", "tif", "webp", "bmp", "heic", "avif"):
        picture.save(tiny.input(f"photo.{suffix}"), **({} if suffix == "bmp" else {"exif": exif}))
    Image.fromarray((np.arange(72 * 96).reshape(72, 96) % 7 < 3).astype(np.uint8) * 255).save(tiny.input("mask.png"))


def _video(path: Path) -> None:
    import cv2

    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 10, (96, 72))
    assert writer.isOpened()
    for i in range(12):
        writer.write(np.random.default_rng(i).integers(0, 255, (72, 96, 3), np.uint8))
    writer.release()


def _meshes(tiny: Tiny) -> None:
    import trimesh

    box = trimesh.creation.icosphere(subdivisions=1)
    for suffix in ("ply", "stl", "obj", "glb", "off"):
        box.export(tiny.input(f"mesh.{suffix}"))
    box.export(tiny.input("ascii.ply"), encoding="ascii")
    trimesh.PointCloud(box.vertices).export(tiny.input("cloud.ply"))
    np.savetxt(tiny.input("cloud.xyz"), box.vertices)


def _poses(tiny: Tiny) -> None:
    truth = json.loads((tiny.folder / "transforms.json").read_text())
    tiny.input("transforms.json").write_text(json.dumps(truth))
    arrays: dict[str, np.ndarray] = {}
    for i, frame in enumerate(truth["frames"]):
        camera = np.eye(4)
        camera[:3, :3] = [[truth["fl_x"], 0, truth["cx"]], [0, truth["fl_y"], truth["cy"]], [0, 0, 1]]
        arrays[f"world_mat_{i}"] = camera @ np.asarray(frame["w2c_opencv"])
        arrays[f"scale_mat_{i}"] = np.eye(4)
    np.savez(tiny.input("cameras_sphere.npz"), **arrays)
    import pycolmap

    model = next(path.parent for path in tiny.input("colmap").rglob("cameras.*"))
    for kind, write in (("text", "write_text"), ("binary", "write_binary")):
        tiny.input(kind).mkdir()
        getattr(pycolmap.Reconstruction(str(model)), write)(str(tiny.input(kind)))


def _lights(tiny: Tiny) -> None:
    import cv2

    from stages.files.light_files import write_exr, write_hdr

    radiance = np.random.default_rng(0).random((8, 16, 3)).astype(np.float32)
    write_hdr(tiny.input("flat.hdr"), radiance)
    cv2.imwrite(str(tiny.input("runs.hdr")), radiance)
    write_exr(tiny.input("light.exr"), radiance)


def files_of(folder: Path) -> Mapping[str, bytes]:
    """The contents of a stage's files by their paths, without those that hold times."""
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.name not in HOLD_TIMES
    }
