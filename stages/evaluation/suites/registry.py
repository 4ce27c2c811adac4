"""All suites by name, and finding their scenes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from stages.errors import InputError, did_you_mean
from stages.evaluation.suites import blendedmvs, dtu, glossy, known, mipnerf360, nerf_synthetic, urbanscene3d
from stages.evaluation.suites.scene import SuiteScene, Wanted


@dataclass(frozen=True)
class Suite:
    """A benchmark.

    Attributes:
        name: on the command line. title: for people.
        find: scenes in a folder.
        score: place in a result's scores of the one that the suite's papers compare. score_name: in words. unit: of it.
        decimals: they print.
        layout: what a scene's folder holds, in words.
    """

    name: str
    title: str
    find: Callable[[Path, Wanted], list[SuiteScene]]
    score: str
    score_name: str
    unit: str
    decimals: int
    layout: str


PSNR = "views.mean.field.whole.psnr"
SUITES = {
    suite.name: suite
    for suite in (
        Suite(
            "dtu", "DTU", dtu.find_scenes,
            "mesh.overall", "Chamfer distance", "mm", 2,
            "dtu_scan24/{image,mask,cameras_sphere.npz}",
        ),
        Suite(
            "nerf-synthetic", "NeRF-synthetic", nerf_synthetic.find_scenes,
            PSNR, "PSNR", "dB", 2,
            "lego/{train,test,transforms_train.json,transforms_test.json}",
        ),
        Suite(
            "mipnerf360", "Mip-NeRF 360", mipnerf360.find_scenes,
            PSNR, "PSNR", "dB", 2,
            "garden/{images_4,sparse/0}",
        ),
        Suite(
            "glossy-synthetic", "GlossySynthetic", glossy.find_scenes,
            "mesh.chamfer", "Chamfer distance", "", 4,
            "bell/{0.png,0-camera.pkl,0-depth.png}",
        ),
        Suite(
            "blendedmvs", "BlendedMVS", blendedmvs.find_scenes,
            "mesh.chamfer_percent", "Chamfer distance", "% of the extent", 2,
            "ID/{blended_images,cams,rendered_depth_maps}, or SCENE/{image,mask,cameras_sphere.npz}",
        ),
        Suite(
            "urbanscene3d", "UrbanScene3D", urbanscene3d.find_scenes,
            PSNR, "PSNR", "dB", 2,
            "Residence/photos, or residence-pixsfm/{train,val}/{metadata,rgbs}",
        ),
        Suite(
            "known", "known objects", known.find_scenes,
            "mesh.mean", "distance", "% of the extent", 2,
            "SET/{images,masks,transforms.json,gt_mesh.ply}",
        ),
    )
}  # fmt: skip


def find_suite(name: str) -> Suite:
    """The suite called `name`.

    Raises:
        InputError: there is none.
    """
    if name not in SUITES:
        guess = did_you_mean(name, SUITES, "hineus bench {}")
        raise InputError(f"There is no suite '{name}'.", f"{guess}The suites are {', '.join(SUITES)}.")
    return SUITES[name]


def find_scenes(suite: Suite, folder: Path, wanted: Wanted, names: Sequence[str] = ()) -> list[SuiteScene]:
    """The suite's scenes in `folder`: those named, else all.

    Raises:
        InputError: there is no such folder, it holds none, or not those named.
    """
    if not folder.is_dir():
        raise InputError(f"There is no folder {folder}.", "Check the path with `ls`.")
    scenes = suite.find(folder.resolve(), wanted)
    if not scenes:
        raise InputError(
            f"{folder} holds no scene of {suite.title}.",
            f"Name the folder that holds them as published, a folder each: {suite.layout}.",
        )
    unknown = sorted(set(names) - {scene.name for scene in scenes})
    if unknown:
        raise InputError(
            f"{folder} has no scene {', '.join(unknown)}.",
            f"Those of {suite.title} there are {', '.join(scene.name for scene in scenes)}.",
        )
    return [scene for scene in scenes if not names or scene.name in names]
