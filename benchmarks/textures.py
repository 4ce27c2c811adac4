"""Textures against photos that were held out: ours, simpler ones, and ours with parts switched off.

python -m benchmarks.textures WORKSPACES DATA                  every finished run in WORKSPACES that has no result yet
python -m benchmarks.textures WORKSPACES DATA viking           this one
python -m benchmarks.textures WORKSPACES DATA viking --cost    what the bake stage takes at three sizes of texture
python -m benchmarks.textures --table-only                     only rewrite the tables of docs/benchmarks/textures.md

WORKSPACES holds a workspace a set, named like the set in DATA, made with every eighth photo held out:

    hineus run DATA/viking/images --workspace WORKSPACES/viking --set train.hold_out=8

Each texture is baked from the other photos; the final mesh with it is drawn into the held-out ones and compared with
them, inside the object's mask and where the mesh covers the pixel (how much of the mask that is has a column). Masks
come from DATA/SET/masks, resampled through the undistortion, else from the run; without any the mesh's silhouette
counts. Results go to benchmarks/results/textures/.
"""

from __future__ import annotations

import argparse
import json
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.pages import NOT_MEASURED, markdown_table, write_tables
from benchmarks.run_sets import GIB, OUT, RESULTS, ROOT, machine
from stages import artifacts
from stages.artifacts import AtlasMesh
from stages.drawing.rasterizing import NO_FACE, Texels, corner_weights, projected, rasterize, rasterize_atlas
from stages.drawing.rasterizing import surface_points as _surface_points
from stages.drawing.rendering import sample_texture
from stages.drawing.view_scores import SUPERSAMPLE, psnr, ssim
from stages.geometry.cameras import PinholeCameras
from stages.surface.triangle_mesh import face_areas

FOLDER = RESULTS / "textures"
SIZES = (2048, 4096, 8192)
# Of the photos that made the texture, this many are scored, too.
TRAINING_SCORED = 6
OURS, VERTEX, NAIVE, BOUND = "ours", "vertex colours", "best view per face", "mean of the held-out photos"
# name of the row -> arguments of `baking.bake_texture`
VARIANTS: dict[str, dict[str, Any]] = {
    "ours, no rejection": {"robust_sigma": 1e6},
    "ours, strict rejection": {"robust_sigma": 2.5},
    "ours, without gains": {"gain": False},
    "ours, without detail": {"detail": False},
    "ours, diffuse": {"diffuse": True},
}
ROWS = 4 + len(VARIANTS)


@dataclass(frozen=True)
class Score:
    """One texture of one set.

    Attributes:
        name: of the row.
        psnr, ssim: of the held-out photos, means over them.
        psnr_gain: with the drawing's channels scaled to each photo first: exposure differs between photos.
        psnr_train: of photos that made the texture.
        seam_charts: colour step across the borders of charts, over that inside them.
        seam_photos: the same across the borders between photos of `NAIVE`.
    """

    name: str
    psnr: float
    psnr_gain: float
    ssim: float
    psnr_train: float
    seam_charts: float
    seam_photos: float


@dataclass(frozen=True)
class SetResult:
    """One set.

    Attributes:
        name: of the set. texture_size: side. held_out: photos scored. masks: what they were scored inside of.
        covered: part of the masks that the mesh covers.
        scores: a row a texture.
        costs: texture size -> wall seconds, CPU seconds, peak bytes of the bake stage.
    """

    name: str
    texture_size: int
    held_out: int
    masks: str
    covered: float
    scores: tuple[Score, ...]
    costs: dict[str, tuple[float, float, int]]
    machine: dict[str, str]


# ---------------------------------------------------------------- a run and its photos
class Capture:
    """A finished run: its mesh, its photos, those held out, and masks to score inside of."""

    def __init__(self, workspace: Path, data: Path) -> None:
        self.undistorted = workspace / "undistort"
        self.cameras = artifacts.CAMERAS.load(workspace / "train")
        held_out = artifacts.HELD_OUT.load(workspace / "train")
        if not held_out:
            sys.exit(f"{workspace} held no photo out: run it with `--set train.hold_out=8`")
        self.held_out = [i for i, name in enumerate(self.cameras.names) if name in held_out]
        self.training = [i for i, name in enumerate(self.cameras.names) if name not in held_out]
        self.atlas = artifacts.ATLAS_MESH.load(workspace / "atlas")
        loaded = [artifacts.Pictures(self.undistorted).masked(name) for name in self.cameras.names]
        self.photos, self.own_masks = [photo for photo, _ in loaded], [mask for _, mask in loaded]
        self.masks_from = "the run" if self.own_masks[0] is not None else "silhouette"
        self.masks = list(self.own_masks)
        if (data / "masks").is_dir():
            self.masks_from, self.masks = "the set", warped_masks(workspace, data / "masks", self.cameras)
        self._looks: dict[int, Look] = {}

    def look(self, index: int) -> Look:
        if index not in self._looks:
            self._looks[index] = Look.of(self.atlas, self.cameras, index)
        return self._looks[index]

    def counted(self, index: int) -> np.ndarray:
        mask, covered = self.masks[index], self.look(index).covered
        return covered if mask is None else covered & mask


def warped_masks(workspace: Path, folder: Path, cameras: PinholeCameras) -> list[np.ndarray | None]:
    """Masks [H, W] bool of undistorted photos from those of the photos themselves (one PNG a photo, of its stem)."""
    import cv2
    import pycolmap

    model = pycolmap.Reconstruction(str(artifacts.MODEL.load(workspace / "sfm")))
    lenses = {Path(image.name).stem: model.cameras[image.camera_id] for image in model.images.values()}
    masks: list[np.ndarray | None] = []
    for index, name in enumerate(cameras.names):
        (width, height), K = cameras.sizes[index], cameras.intrinsics[index]
        x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
        rays = np.stack([(x - K[0, 2]) / K[0, 0], (y - K[1, 2]) / K[1, 1], np.ones_like(x)], -1).reshape(-1, 3)
        lens = lenses[Path(name).stem]
        mask = cv2.imread(str(folder / f"{Path(name).stem}.png"), cv2.IMREAD_GRAYSCALE)
        if mask is None:
            sys.exit(f"{folder} has no mask for {name}")
        scale = np.array(mask.shape[::-1]) / (lens.width, lens.height)
        at = (np.asarray(lens.img_from_cam(rays)) * scale - 0.5).reshape(height, width, 2).astype(np.float32)
        masks.append(cv2.remap(mask, at[..., 0], at[..., 1], cv2.INTER_LINEAR) > 127)
    return masks


@dataclass(frozen=True)
class Look:
    """Where a camera's samples fall on the texture, so that many textures are drawn without looking again.

    Attributes:
        size: width, height.
        hit: [P] samples on the mesh, row-major in the image SUPERSAMPLE times as large. uvs: [P, 2].
        covered: [H, W] bool, pixels all of whose samples hit.
    """

    size: tuple[int, int]
    hit: np.ndarray
    uvs: np.ndarray
    covered: np.ndarray

    @staticmethod
    def of(atlas: AtlasMesh, cameras: PinholeCameras, index: int) -> Look:
        width, height = (int(side) for side in cameras.sizes[index])
        xy, inverse_depth = projected(cameras, index, atlas.vertices)
        wide, high = width * SUPERSAMPLE, height * SUPERSAMPLE
        face_map, _ = rasterize(xy * SUPERSAMPLE, inverse_depth, atlas.faces, wide, high)
        hit = np.flatnonzero(face_map != NO_FACE)
        faces = face_map.ravel()[hit]
        centers = np.stack([hit % wide, hit // wide], 1) + 0.5
        weights = corner_weights(xy * SUPERSAMPLE, inverse_depth, atlas.faces, faces, centers)
        uvs = np.einsum("pk,pkc->pc", weights, atlas.uvs[atlas.faces[faces]])
        covered = (face_map != NO_FACE).reshape(height, SUPERSAMPLE, width, SUPERSAMPLE).all((1, 3))
        return Look((width, height), hit, uvs.astype(np.float32), covered)

    def draw(self, texture: np.ndarray) -> np.ndarray:
        """What `view_scores.draw_view` draws."""
        width, height = self.size
        image = np.full((width * height * SUPERSAMPLE**2, 3), 255, dtype=np.float32)
        image[self.hit] = sample_texture(texture, self.uvs)
        image = image.reshape(height, SUPERSAMPLE, width, SUPERSAMPLE, 3).mean((1, 3))
        return np.clip(image + 0.5, 0, 255).astype(np.uint8)


# ---------------------------------------------------------------- simpler textures
def _paint(texels: Texels, colors: np.ndarray) -> np.ndarray:
    from stages.texture.padding import pad_charts

    return pad_charts(*texels.paint(np.clip(colors + 0.5, 0, 255).astype(np.uint8)))[0]


def _observe(capture: Capture, index: int, points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights [P] with which a photo sees points, and their colours [P, 3]."""
    from stages.texture.observing import sample_points
    from stages.texture.photo_views import prepare_view

    atlas = capture.atlas
    view = prepare_view(
        capture.cameras, index, capture.photos[index], capture.own_masks[index], atlas.vertices, atlas.faces
    )
    weights, colors = np.zeros(len(points), np.float32), np.zeros((len(points), 3), np.float32)
    sample_points(
        points, normals, view.matrix, view.center, view.focal, view.inverse_depth, view.confidence, view.photo,
        weights, colors,
    )  # fmt: skip
    return weights, colors


def vertex_colors(capture: Capture, texels: Texels) -> np.ndarray:
    """The texture that looks like colours at the vertices, linear between: the mean of the photos that see each."""
    atlas = capture.atlas
    total, count = np.zeros((len(atlas.vertices), 3)), np.zeros((len(atlas.vertices), 1))
    for index in capture.training:
        weights, colors = _observe(capture, index, atlas.vertices, atlas.normals)
        seen = weights[:, None] > 0
        total += np.where(seen, colors, 0)
        count += seen
    colors = np.where(count > 0, total / np.maximum(count, 1), total.sum(0) / max(count.sum(), 1))
    return _paint(texels, np.einsum("tk,tkc->tc", texels.corner, colors[atlas.faces[texels.face_ids]]))


def best_view(capture: Capture, texels: Texels) -> tuple[np.ndarray, np.ndarray]:
    """Each face from the one photo that shows it largest, as it is; texels that one does not see from their own best.

    Returns:
        The texture, and the photo of each face [F], -1 where none sees it.
    """
    atlas = capture.atlas
    centers = _surface_points(atlas, np.arange(len(atlas.faces)), np.full((len(atlas.faces), 3), 1 / 3, np.float32))
    points = _surface_points(atlas, texels.face_ids, texels.corner)
    together = [np.concatenate(pair) for pair in zip(centers, points, strict=True)]
    best, label = np.zeros(len(atlas.faces), np.float32), np.full(len(atlas.faces), -1)
    seen = []
    for index in capture.training:
        weights, colors = _observe(capture, index, *together)
        better = weights[: len(best)] > best
        best[better], label[better] = weights[: len(best)][better], index
        seen.append((weights[len(best) :], colors[len(best) :].astype(np.uint8)))
    rank, answer = np.zeros(len(texels), np.float32), np.full((len(texels), 3), 128.0)
    for index, (weights, colors) in zip(capture.training, seen, strict=True):
        own = np.where((label[texels.face_ids] == index) & (weights > 0), np.inf, weights)
        answer[own > rank], rank[own > rank] = colors[own > rank], own[own > rank]
    return _paint(texels, answer), label


def held_out_mean(capture: Capture, texels: Texels) -> np.ndarray:
    """The mean of the held-out photos themselves: about the best that colours fixed to the surface can score.

    At depth edges no photo is trusted; colours come from a few texels off, as padding's do.
    """
    from stages.texture.padding import pad_charts

    points, normals = _surface_points(capture.atlas, texels.face_ids, texels.corner)
    total, count = np.zeros((len(texels), 3)), np.zeros((len(texels), 1))
    for index in capture.held_out:
        weights, colors = _observe(capture, index, points, normals)
        total += np.sqrt(weights)[:, None] * colors
        count += np.sqrt(weights)[:, None]
    colors = np.clip(total / np.maximum(count, 1e-12) + 0.5, 0, 255).astype(np.uint8)
    return pad_charts(texels.paint(colors)[0], texels.paint(count > 0)[0][..., 0])[0]


def baked(capture: Capture, texels: Texels, **options: Any) -> np.ndarray:
    """Our texture. Where no photo saw the surface it is grey: no held-out photo is near, either."""
    from stages.texture.baking import bake_texture

    def load(index: int) -> tuple[np.ndarray, np.ndarray | None]:
        return capture.photos[capture.training[index]], capture.own_masks[capture.training[index]]

    cameras = capture.cameras.select(capture.training)
    return bake_texture(
        capture.atlas, texels, cameras, load, lambda points, normals, away: np.full(points.shape, 0.5), **options
    ).base_color


# ---------------------------------------------------------------- scores
def seam(atlas: AtlasMesh, texture: np.ndarray, pairs: np.ndarray, border: np.ndarray, step: float) -> float:
    """Mean colour step across the face pairs [E, 2] of `border` [E] bool, over the mean across the other ones.

    Colours are read `step` (scene units) to both sides of the middle of the edge that a pair shares: a texel on either
    side, whichever charts they lie in.
    """
    corners = atlas.vertices[atlas.faces].astype(np.float64)
    first, second = corners[pairs[:, 0]], corners[pairs[:, 1]]
    # [E, 3, 3]: which corner of the first face is which of the second
    same = (first[:, :, None] == second[:, None]).all(3)
    colors = []
    for side, shared in ((0, same.any(2)), (1, same.any(1))):
        edge = shared / np.maximum(shared.sum(1, keepdims=True), 1)
        here = corners[pairs[:, side]]
        reach = np.linalg.norm(np.einsum("ek,ekc->ec", 1 / 3 - edge, here), axis=1)
        part = np.minimum(step / np.maximum(reach, 1e-12), 1)[:, None]
        weights = (1 - part) * edge + part / 3
        uvs = np.einsum("ek,ekc->ec", weights, atlas.uvs[atlas.faces[pairs[:, side]]])
        colors.append(sample_texture(texture, uvs))
    difference = np.abs(colors[0] - colors[1]).mean(1)
    if not border.any() or border.all():
        return 1.0
    return float(difference[border].mean() / max(difference[~border].mean(), 1e-9))


def score(
    capture: Capture, texture: np.ndarray, name: str, seams: Callable[[np.ndarray], tuple[float, float]]
) -> Score:
    """Drawings of the mesh with this texture against photos."""
    rows = []
    for index in capture.held_out:
        image, photo, counted = capture.look(index).draw(texture), capture.photos[index], capture.counted(index)
        rows.append((psnr(image, photo, counted), psnr(matched(image, photo, counted), photo, counted),
                     ssim(image, photo, counted)))  # fmt: skip
    held = np.mean(rows, axis=0)
    some = capture.training[:: max(1, len(capture.training) // TRAINING_SCORED)]
    train = np.mean([psnr(capture.look(i).draw(texture), capture.photos[i], capture.counted(i)) for i in some])
    numbers = [round(float(value), 4) for value in (*held, train, *seams(texture))]
    return Score(name, *numbers)


def matched(image: np.ndarray, photo: np.ndarray, counted: np.ndarray) -> np.ndarray:
    """The drawing with each channel scaled to the photo's, least squares over the pixels that count."""
    own, other = image[counted].astype(np.float64), photo[counted].astype(np.float64)
    gain = (own * other).sum(0) / np.maximum((own * own).sum(0), 1e-9)
    scaled: np.ndarray = np.clip(image * gain + 0.5, 0, 255).astype(np.uint8)
    return scaled


def measure(workspace: Path, data: Path, before: SetResult | None) -> SetResult:
    """All rows of one set; those of an earlier, interrupted measurement are kept, each is saved when it is done."""
    from stages.texture.charts import WAYS
    from stages.texture.filling import face_neighbors
    from stages.texture.footprint import pixels_per_area, texels_needed, texture_size_for

    known = {row.name: row for row in before.scores} if before else {}
    costs = before.costs if before else {}
    capture = Capture(workspace, data)
    atlas = capture.atlas
    texels_wanted = texels_needed(*pixels_per_area(atlas.vertices, atlas.faces, capture.cameras))
    size = texture_size_for(texels_wanted, WAYS["uvatlas"].fill)
    texels = rasterize_atlas(atlas.uvs, atlas.faces, size)
    naive, label = best_view(capture, texels)
    pairs = face_neighbors(atlas.vertices, atlas.faces)
    shared = (atlas.faces[pairs[:, 0], :, None] == atlas.faces[pairs[:, 1], None]).sum((1, 2))
    charts = shared < 2
    photos = ~charts & (label[pairs[:, 0]] != label[pairs[:, 1]])
    step = float(np.sqrt(face_areas(atlas.vertices, atlas.faces).sum() / len(texels)))

    def seams(texture: np.ndarray) -> tuple[float, float]:
        inside = ~charts
        return seam(atlas, texture, pairs, charts, step), seam(atlas, texture, pairs[inside], photos[inside], step)

    masks = {i: mask for i in capture.held_out if (mask := capture.masks[i]) is not None}
    covered = [capture.counted(i).sum() / max(mask.sum(), 1) for i, mask in masks.items()]
    result = SetResult(
        workspace.name, size, len(capture.held_out), capture.masks_from,
        round(float(np.mean(covered)), 4) if covered else 1.0, tuple(known.values()), costs, machine(),
    )  # fmt: skip
    makers: dict[str, Callable[[], np.ndarray]] = {
        OURS: lambda: baked(capture, texels),
        VERTEX: lambda: vertex_colors(capture, texels),
        NAIVE: lambda: naive,
        BOUND: lambda: held_out_mean(capture, texels),
    }
    for name, options in VARIANTS.items():
        makers[name] = partial(baked, capture, texels, **options)
    for name, make in makers.items():
        if name not in known:
            result = replace(result, scores=(*result.scores, score(capture, make(), name, seams)))
            save_result(result)
            print(f"{workspace.name}: {result.scores[-1]}", file=sys.stderr, flush=True)
    return result


# ---------------------------------------------------------------- what it costs
def cost_of(workspace: Path, size: int) -> tuple[float, float, int]:
    """Wall seconds, CPU seconds and peak bytes of the bake stage with a texture of this size, in its own process."""
    command = [sys.executable, "-m", "benchmarks.textures", str(workspace), "--bake", str(size)]
    done = subprocess.run(command, cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True)
    wall, cpu, peak = json.loads(done.stdout.splitlines()[-1])
    return wall, cpu, peak


def bake_alone(workspace: Path, size: int) -> tuple[float, float, int]:
    """Run the bake stage in this process on a copy of the atlas that asks for another size."""
    from configs.params import BakeParams
    from stages.bake import BAKE
    from stages.engine.stage import StageContext

    OUT.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=OUT) as folder:
        atlas, out, scratch = (Path(folder) / name for name in ("atlas", "out", "scratch"))
        for each in (atlas, out, scratch):
            each.mkdir()
        artifacts.ATLAS_MESH.save(atlas, replace(artifacts.ATLAS_MESH.load(workspace / "atlas"), texture_size=size))
        inputs = {name: workspace / name for name in BAKE.needs} | {"atlas": atlas}
        context = StageContext(inputs=inputs, sources={}, out=out, scratch=scratch, params=BakeParams(), workers=2)
        began, used = time.perf_counter(), time.process_time()
        BAKE.run(context)
        wall, cpu = time.perf_counter() - began, time.process_time() - used
        shutil.rmtree(out)
    return round(wall, 1), round(cpu, 1), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


# ---------------------------------------------------------------- results and tables
def save_result(result: SetResult) -> None:
    FOLDER.mkdir(parents=True, exist_ok=True)
    artifacts.write_json(FOLDER / f"{result.name}.json", asdict(result))


def load_results() -> list[SetResult]:
    results = []
    for path in sorted(FOLDER.glob("*.json")):
        data = artifacts.read_json(path)
        data["scores"] = tuple(Score(**row) for row in data["scores"])
        results.append(SetResult(**data))
    return results


def scores_table(results: Sequence[SetResult]) -> str:
    """A row a set and texture."""
    header = [
        "set", "texture", "PSNR", "over vertex", "over best view", "PSNR, gain fitted", "SSIM", "PSNR, training photos",
        "chart borders", "photo borders",
    ]  # fmt: skip
    rows = []
    order = [OURS, VERTEX, NAIVE, BOUND, *VARIANTS]
    for result in results:
        base = {row.name: row.psnr for row in result.scores}
        for row in sorted(result.scores, key=lambda row: order.index(row.name)):
            rows.append(
                [
                    result.name, row.name, f"{row.psnr:.2f}", f"{row.psnr - base[VERTEX]:+.2f}",
                    f"{row.psnr - base[NAIVE]:+.2f}", f"{row.psnr_gain:.2f}", f"{row.ssim:.3f}",
                    f"{row.psnr_train:.2f}",
                    f"{row.seam_charts:.2f}", f"{row.seam_photos:.2f}",
                ]
            )  # fmt: skip
    return markdown_table(header, rows)


def cost_table(results: Sequence[SetResult]) -> str:
    """A row a set and size."""
    rows = [
        [result.name, size, f"{wall:.0f}", f"{cpu:.0f}", f"{peak / GIB:.2f}"]
        for result in results
        for size, (wall, cpu, peak) in result.costs.items()
    ]
    return markdown_table(["set", "texture size", "wall s", "CPU s", "peak GiB"], rows)


def tables_of(results: Sequence[SetResult]) -> dict[str, str]:
    """Both tables."""
    made = {"textures": scores_table, "texture cost": cost_table}
    return {name: table(results) if results else NOT_MEASURED for name, table in made.items()}


def tables() -> dict[str, str]:
    """Both tables, from the result files."""
    return tables_of(load_results())


def main(argv: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("workspaces", nargs="?", type=Path, help="folder of workspaces")
    parser.add_argument("data", nargs="?", type=Path, help="folder of sets")
    parser.add_argument("sets", nargs="*", help="names; default: all")
    parser.add_argument("--again", action="store_true", help="also sets that have a result")
    parser.add_argument("--cost", action="store_true", help="measure the bake stage at three sizes for these sets")
    parser.add_argument("--table-only", action="store_true", help="only rewrite the tables")
    parser.add_argument("--bake", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args(argv)
    if arguments.bake:
        print(json.dumps(bake_alone(arguments.workspaces, arguments.bake)))
        return 0
    if not arguments.table_only:
        if arguments.data is None:
            parser.error("name the folders of workspaces and of sets")
        finished = sorted(path.parent.name for path in arguments.workspaces.glob("*/atlas"))
        for name in arguments.sets or finished:
            before = {result.name: result for result in load_results()}.get(name)
            if before and arguments.again and not arguments.cost:
                before = replace(before, scores=())
            if before is None or len(before.scores) < ROWS:
                before = measure(arguments.workspaces / name, arguments.data / name, before)
            for size in SIZES if arguments.cost else ():
                if str(size) not in before.costs or arguments.again:
                    cost = cost_of(arguments.workspaces / name, size)
                    before = replace(before, costs=before.costs | {str(size): cost})
                    save_result(before)
    write_tables(tables())
    return 0


if __name__ == "__main__":
    sys.exit(main())
