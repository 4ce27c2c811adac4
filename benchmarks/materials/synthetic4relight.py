"""Synthetic4Relight (Zhang et al., "Modeling Indirect Illumination for Inverse Rendering", 2022), for who has its data.

python -m benchmarks.materials.synthetic4relight DATA OUT --lights FOLDER [--scenes hotdog,jugs] [--preset gpu]

Each scene of DATA (`air_baloons`, `chair`, `hotdog`, `jugs`) runs with its poses and alpha through `hineus run
--relightable` to OUT/SCENE/workspace, is drawn by Mitsuba from the cameras of `transforms_test.json`, and scored in
OUT/SCENE/result.json as Relightable 3D Gaussians (Gao et al. 2024) and others after it score:

    photos        train/NNN.png or train/NNN_rgba.png, their alpha the mask
    novel views   test/NNN.png or test/NNN_rgba.png, under the light that was learned
    albedo        test/NNN_albedo.png, after one scale a channel for the scene, the median of truth over result
    roughness     test/NNN_rough.png, mean squared error
    relit         test_rli/envmap6_NNN.png and envmap12_NNN.png, under FOLDER/envmap6.exr and envmap12.exr, with the
                  scaled albedo

Pictures are compared whole, in sRGB, on white outside of the truth's alpha. Files of albedo are taken to be sRGB-coded.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.materials.glb_model import Model, linear, read_finished
from benchmarks.materials.held_out import Views, read_exr, z_up_map
from benchmarks.materials.judge import Judge
from benchmarks.materials.scoring import channel_scale, coded, picture_scores
from benchmarks.run_sets import run_hineus
from benchmarks.synthetic.mitsuba_camera import choose_variant
from stages import artifacts
from stages.errors import HineusError, InputError

TRAIN, TEST = "transforms_train.json", "transforms_test.json"
LIGHTS = ("envmap6", "envmap12")
SUFFIXES = (".png", "_rgba.png")
FLIP = np.diag([1.0, -1, -1, 1])  # OpenGL's camera axes to OpenCV's
AT_ONCE = 8  # views whose radiance is in memory


@dataclass(frozen=True)
class Tests:
    """The test views of a scene.

    Attributes:
        folder: of the scene. names: "000" and so on. views: their cameras.
    """

    folder: Path
    names: tuple[str, ...]
    views: Views

    def parts(self) -> Iterator[Tests]:
        """AT_ONCE at a time."""
        for begin in range(0, len(self.names), AT_ONCE):
            part = slice(begin, begin + AT_ONCE)
            views = replace(self.views, cam_from_world=self.views.cam_from_world[part])
            yield Tests(self.folder, self.names[part], views)

    def pictures(self, *suffixes: str, folder: str = "test", prefix: str = "") -> np.ndarray:
        """[N, H, W, 4] uint8, the first file there is for each.

        Raises:
            InputError: there is none.
        """
        return np.stack([read_rgba(_first(self.folder / folder, prefix + name, suffixes)) for name in self.names])


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--lights", type=Path, required=True, help="folder of envmap6.exr and envmap12.exr")
    parser.add_argument("--scenes", help="names, with commas between; default: all")
    parser.add_argument("--every", type=int, default=1, help="of so many test views one is scored")
    parser.add_argument("--spp", type=int, default=64, help="paths a pixel")
    parser.add_argument("--preset", help="of the run")
    asked = parser.parse_args(argv)
    variant, _ = choose_variant()
    try:
        there = sorted(path.parent.name for path in asked.data.glob(f"*/{TRAIN}"))
        scenes = asked.scenes.split(",") if asked.scenes else there
        lights = {name: read_light(asked.lights / f"{name}.exr") for name in LIGHTS}
        for scene in scenes:
            out = asked.out / scene
            run_scene(asked.data / scene, out, [] if asked.preset is None else ["--preset", asked.preset])
            scores = score_scene(asked.data / scene, out / "workspace", lights, variant, asked.every, asked.spp)
            artifacts.write_json(out / "result.json", scores)
            print(f"{scene}: {json.dumps(scores)}", flush=True)
    except HineusError as error:
        print(f"{error.message}\n{error.hint}", file=sys.stderr)
        return error.exit_code
    return 0


def run_scene(data: Path, out: Path, options: Sequence[str]) -> None:
    """`hineus run --relightable` on the photos of `train`, by the names that the poses have for them."""
    photos = out / "photos"
    photos.mkdir(parents=True, exist_ok=True)
    for frame in artifacts.read_json(data / TRAIN)["frames"]:
        name = Path(frame["file_path"]).name
        link = photos / f"{name}.png"
        link.unlink(missing_ok=True)
        link.symlink_to(_first(data / "train", name, SUFFIXES).resolve())
    run_hineus(
        ["run", str(photos), "--workspace", str(out / "workspace"), "--poses", str(data / TRAIN), "--relightable",
         "--json", *options]
    )  # fmt: skip


def read_tests(data: Path, every: int = 1) -> Tests:
    """Cameras in the frame of the poses.

    Raises:
        InputError: a picture is not there.
    """
    transforms = artifacts.read_json(data / TEST)
    frames = transforms["frames"][::every]
    names = tuple(Path(frame["file_path"]).name for frame in frames)
    height, width = read_rgba(_first(data / "test", names[0], SUFFIXES)).shape[:2]
    poses = [FLIP @ np.linalg.inv(np.array(frame["transform_matrix"], float)) for frame in frames]
    focal = width / 2 / np.tan(transforms["camera_angle_x"] / 2)
    return Tests(data, names, Views(np.stack(poses), float(focal), (width, height)))


def score_scene(
    data: Path, workspace: Path, lights: dict[str, np.ndarray], variant: str, every: int = 1, spp: int = 64
) -> dict[str, float]:
    """Means over the test views.

    Args:
        lights: each as `Scene.sky`.

    Raises:
        InputError: the workspace has no model, or a picture of the truth is not there.
    """
    finished = read_finished(workspace)
    tests = read_tests(data, every)
    maps = [view for part in tests.parts() for view in Judge(part.views, variant).maps(finished.model)]
    albedo, roughness = (np.stack([view[key] for view in maps]) for key in ("base_color", "roughness"))
    truth, rough = tests.pictures("_albedo.png"), tests.pictures("_rough.png")[..., 0] / np.float32(255)
    inside = truth[..., 3] > 127
    scale = channel_scale(albedo[inside], linear(truth[..., :3])[inside])
    scaled = replace(finished.model, base_color=np.clip(finished.model.base_color * scale.astype(np.float32), 0, 1))
    scores = {"albedo": on_white(coded(albedo * scale), truth)}
    for name, light in lights.items():
        relit = tests.pictures(".png", folder="test_rli", prefix=f"{name}_")
        scores[f"relit_{name}"] = on_white(_drawn(tests, variant, scaled, light, spp), relit)
    if finished.light is not None:
        scores["novel"] = on_white(
            _drawn(tests, variant, finished.model, finished.light, spp), tests.pictures(*SUFFIXES)
        )
    numbers = {f"{label}_{key}": value for label, each in scores.items() for key, value in each.items()}
    numbers["roughness_mse"] = float((((roughness - rough) * truth[..., 3] / 255) ** 2).mean())
    return {key: round(value, 4) for key, value in numbers.items()}


def _drawn(tests: Tests, variant: str, model: Model, light: np.ndarray, spp: int) -> np.ndarray:
    """8-bit pictures [N, H, W, 3]."""
    return np.concatenate([coded(Judge(part.views, variant).lit(model, light, spp)) for part in tests.parts()])


def on_white(found: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Mean PSNR and SSIM of 8-bit pictures [N, H, W, 3], whole, on white outside of the truth's alpha [N, H, W, 4]."""
    scores = []
    for picture, rgba in zip(found, truth, strict=True):
        whole = np.ones((1, *rgba.shape[:2]), bool)
        pair = (_over_white(each, rgba[..., 3:])[None] for each in (picture, rgba[..., :3]))
        scores.append(picture_scores(*pair, whole))
    return {key: float(np.mean([score[key] for score in scores])) for key in scores[0]}


def _over_white(picture: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    share = alpha / np.float32(255)
    return (picture * share + 255 * (1 - share) + 0.5).astype(np.uint8)


# ---------------------------------------------------------------- files
def read_light(path: Path) -> np.ndarray:
    """An equirectangular map as Blender has it, as `Scene.sky`.

    Raises:
        InputError: it is not there.
    """
    if not path.is_file():
        raise InputError(f"There is no light {path}.", "Name the folder of envmap6.exr and envmap12.exr with --lights.")
    return z_up_map(read_exr(path))


def read_rgba(path: Path) -> np.ndarray:
    """[H, W, 4] uint8; opaque where the file has no alpha."""
    from PIL import Image

    return np.asarray(Image.open(path).convert("RGBA"))


def _first(folder: Path, name: str, suffixes: Sequence[str]) -> Path:
    for suffix in suffixes:
        if (path := folder / f"{name}{suffix}").is_file():
            return path
    wanted = " or ".join(f"{name}{suffix}" for suffix in suffixes)
    raise InputError(f"There is no {wanted} in {folder}.", f"See `ls {folder}`: is the scene unpacked whole?")


if __name__ == "__main__":
    sys.exit(main())
