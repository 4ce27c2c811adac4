"""Find the poses of sets of photos, and of twelve ways to make such a set harder.

python -m benchmarks.hard_variants DATA                        every row that has no result yet
python -m benchmarks.hard_variants DATA synth_helmet-blurred   these
python -m benchmarks.hard_variants DATA --mesh                 go on to the clean mesh where its truth is known
python -m benchmarks.hard_variants DATA --mesh --set train.steps=2000    with a smaller budget
python -m benchmarks.hard_variants --table-only                only rewrite the table of docs/benchmarks/hard-photos.md

A row is a set of DATA, or SET-VARIANT: see `VARIANTS` for what each does to the photos, and `BASES` for the sets it is
done to. A row runs in a process of its own; results go to benchmarks/results/poses/ROW.json, photos made and workspaces
to benchmarks/out/poses/ROW/, where an interrupted row goes on. A row whose poses could not be found says why; one that
broke has no result.
"""

from __future__ import annotations

import argparse
import hashlib
import shutil
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.ablate import score_clean_mesh
from benchmarks.pages import NOT_MEASURED, markdown_table, write_tables
from benchmarks.run_sets import OUT, RESULTS, ROOT, find_sets, known_cameras, machine, photos_of, run_hineus
from stages import artifacts
from stages.errors import InputError, ReconstructionError, WorkspaceError
from stages.posing.neus import read_neus

ROWS = RESULTS / "poses"
FOLDERS = OUT / "poses"
POSES, CLEAN = "undistort", "cleanup"
# Exit codes: photos that cannot be used and poses that cannot be found are results, too.
ANSWERS = (0, InputError.exit_code, ReconstructionError.exit_code)
PHOTOS = "photos"
VIDEO_FPS, VIDEO_HOLD = 30, 10  # every photo is shown for a third of a second
BLUR_SHARE, BLUR_SIGMA = 0.3, 3 / 640  # of the photos; of the width
CROP, CROP_SCALE = 0.75, 1.2  # of both sides; then enlarged
GREY, NOISE = 128, 1.2  # of 255
CUT_LEFT, CUT_TOP = 0.15, 0.1  # of the width, of the height
# A lens whose distortion eases off towards the corners, as that of wide ones does, at the focal length of the synthetic
# photos in widths: 10 % inwards at the corner.
WIDE_FOCAL, WIDE_K1, WIDE_K2 = 1.39, -0.75, 1.25


@dataclass(frozen=True)
class Photo:
    """A photo of a set: its name, [H, W, 3] uint8 RGB, and [H, W] bool mask or None."""

    name: str
    pixels: np.ndarray
    mask: np.ndarray | None


@dataclass(frozen=True)
class Row:
    """One set or variant.

    Attributes:
        name: SET or SET-VARIANT.
        command: that made it, with DATA for the folder of sets.
        machine: CPU, cores, versions.
        code: hash of the sources that find poses.
        photos: how many there are.
        registered: how many have a pose.
        center_error: median and largest distance of camera centres to the truth, after alignment by a similarity, in
            percent of the object's extent; None where the truth is not known.
        attempts: what each rung of the ladder did, see `stages.posing.ladder.Step`.
        cpu_s: CPU seconds of the sfm stage, all attempts.
        failure: message and hint of the error that ended the row, or None.
        score: distances of the clean mesh to the truth, see `protocols.known_object`; None where it was not made.
        mesh_preset: preset of the training behind that mesh; mesh_settings: what was set over it, SECTION.KEY=VALUE.
    """

    name: str
    command: str
    machine: dict[str, str]
    code: str
    photos: int
    registered: int
    center_error: dict[str, float] | None
    attempts: tuple[dict[str, Any], ...]
    cpu_s: float | None
    failure: dict[str, str] | None
    score: dict[str, float] | None = None
    mesh_preset: str | None = None
    mesh_settings: tuple[str, ...] = ()


# ---------------------------------------------------------------- variants
def no_exif(photos: list[Photo], folder: Path) -> None:
    """The same pixels without EXIF."""
    for photo in photos:
        _save(folder, photo, photo.pixels)


def rotated(photos: list[Photo], folder: Path) -> None:
    """Every second photo turned by 90 degrees, no EXIF."""
    for i, photo in enumerate(photos):
        _save(folder, photo, np.rot90(photo.pixels) if i % 2 else photo.pixels)


def two_cameras(photos: list[Photo], folder: Path) -> None:
    """Every second photo cropped to its middle and enlarged, as from a longer lens with another size; no EXIF."""
    import cv2

    for i, photo in enumerate(photos):
        pixels = photo.pixels
        if i % 2:
            height, width = pixels.shape[:2]
            top, left = round((1 - CROP) / 2 * height), round((1 - CROP) / 2 * width)
            pixels = pixels[top : height - top, left : width - left]
            pixels = cv2.resize(pixels, None, fx=CROP_SCALE, fy=CROP_SCALE, interpolation=cv2.INTER_CUBIC)
        _save(folder, photo, pixels)


def blurred(photos: list[Photo], folder: Path) -> None:
    """30 % of the photos out of focus, no EXIF."""
    import cv2

    chosen = np.random.default_rng(0).permutation(len(photos))[: round(BLUR_SHARE * len(photos))]
    for i, photo in enumerate(photos):
        sigma = BLUR_SIGMA * photo.pixels.shape[1]
        _save(folder, photo, cv2.GaussianBlur(photo.pixels, None, sigma) if i in chosen else photo.pixels)


def every_third(photos: list[Photo], folder: Path) -> None:
    """A third of the photos, no EXIF."""
    for photo in photos[::3]:
        _save(folder, photo, photo.pixels)


def black_background(photos: list[Photo], folder: Path) -> None:
    """All but the object black, no EXIF."""
    for photo in photos:
        _save(folder, photo, np.where(_mask(photo), photo.pixels, 0))


def plain_ground(photos: list[Photo], folder: Path) -> None:
    """All but the object one grey with the photos' noise, no EXIF: a ground without print, but without shadows, too."""
    noise = np.random.default_rng(0)
    for photo in photos:
        ground = (GREY + noise.normal(0, NOISE, photo.pixels.shape)).round().clip(0, 255).astype(np.uint8)
        _save(folder, photo, np.where(_mask(photo), photo.pixels, ground))


def wrong_focal(photos: list[Photo], folder: Path) -> None:
    """EXIF that says twice the focal length."""
    from PIL import ExifTags, Image

    for photo in photos:
        image = Image.fromarray(photo.pixels)
        exif = Image.Exif()
        exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 96
        image.save(folder / f"{Path(photo.name).stem}.jpg", quality=97, subsampling=0, exif=exif)


def greyscale(photos: list[Photo], folder: Path) -> None:
    """Grey photos, no EXIF."""
    import cv2

    for photo in photos:
        _save(folder, photo, cv2.cvtColor(photo.pixels, cv2.COLOR_RGB2GRAY))


def video(photos: list[Photo], folder: Path) -> None:
    """One MPEG-4 video that shows each photo for a third of a second."""
    import cv2

    height, width = photos[0].pixels.shape[:2]
    fourcc = cv2.VideoWriter.fourcc(*"mp4v")
    writer = cv2.VideoWriter(str(folder / "capture.mp4"), fourcc, VIDEO_FPS, (width, height))
    for photo in photos:
        for _ in range(VIDEO_HOLD):
            writer.write(cv2.cvtColor(photo.pixels, cv2.COLOR_RGB2BGR))
    writer.release()


def off_centre(photos: list[Photo], folder: Path) -> None:
    """15 % of the width cut off on the left, 10 % of the height at the top: the lens looks off the middle; no EXIF."""
    for photo in photos:
        height, width = photo.pixels.shape[:2]
        _save(folder, photo, photo.pixels[round(CUT_TOP * height) :, round(CUT_LEFT * width) :])


def wide_lens(photos: list[Photo], folder: Path) -> None:
    """Barrel distortion that a single radial term does not describe, no EXIF."""
    import cv2

    for photo in photos:
        height, width = photo.pixels.shape[:2]
        where = distorted_positions(width, height)
        _save(folder, photo, cv2.remap(photo.pixels, where[..., 0], where[..., 1], cv2.INTER_CUBIC))


def distorted_positions(width: int, height: int) -> np.ndarray:
    """[height, width, 2] float32: where each pixel of the wide lens is in the pinhole photo, pixel centres at integers.

    Its corners are those of the photo.
    """
    import pycolmap

    focal, center = WIDE_FOCAL * width, (width / 2, height / 2)
    corner = np.hypot(*center) / focal
    shrunk = 1 + WIDE_K1 * corner**2 + WIDE_K2 * corner**4
    lens = pycolmap.Camera(
        model="RADIAL", width=width, height=height, params=[focal / shrunk, *center, WIDE_K1, WIDE_K2]
    )
    grid = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1)
    rays = np.asarray(lens.cam_from_img(grid.reshape(-1, 2)))
    return (focal * rays + center - 0.5).reshape(height, width, 2).astype(np.float32)


VARIANTS: dict[str, Callable[[list[Photo], Path], None]] = {
    function.__name__: function
    for function in (
        no_exif, rotated, two_cameras, blurred, every_third, black_background, plain_ground, wrong_focal, greyscale,
        video, off_centre, wide_lens,
    )
}  # fmt: skip
BASES = {
    "synth_helmet": tuple(VARIANTS),
    # without the printed ground a white object has little to hold on to
    "synth_plaster": ("black_background", "plain_ground"),
}


def all_rows(sets: Sequence[str]) -> list[str]:
    """The sets, then the variants of those among them that have any."""
    return [*sets, *(f"{name}-{variant}" for name in sets for variant in BASES.get(name, ()))]


def make_photos(row: str, data: Path) -> Path:
    """The folder with the photos of a row; those of a variant are made unless they are there.

    Raises:
        ValueError: the variant needs masks that the set lacks.
    """
    name, _, variant = row.partition("-")
    if not variant:
        return photos_of(data / name)
    folder = FOLDERS / row / PHOTOS
    if not folder.is_dir():
        partial = folder.with_name(f"{PHOTOS}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        VARIANTS[variant](load_photos(data / name), partial)
        partial.rename(folder)
    return folder


def load_photos(folder: Path) -> list[Photo]:
    """The photos of a set by name, with its masks."""
    from PIL import Image

    photos = []
    for path in sorted(photos_of(folder).iterdir()):
        with Image.open(path) as image:
            pixels = np.asarray(image.convert("RGB"))
        found = sorted((folder / "masks").glob(f"{path.stem}.*"))
        mask = None
        if found:
            with Image.open(found[0]) as image:
                mask = np.asarray(image.convert("L")) > 127
        photos.append(Photo(path.name, pixels, mask))
    return photos


def _mask(photo: Photo) -> np.ndarray:
    if photo.mask is None:
        raise ValueError(f"{photo.name} has no mask, which this variant needs")
    return photo.mask[..., None]


def _save(folder: Path, photo: Photo, pixels: np.ndarray) -> None:
    from PIL import Image

    Image.fromarray(pixels).save(folder / f"{Path(photo.name).stem}.png")  # PNG: no EXIF, and no second loss


# ---------------------------------------------------------------- truth
def true_centers(folder: Path) -> tuple[list[np.ndarray], float] | None:
    """Camera centres [3] of a set in the order of its photos, and the object's extent; None where not known.

    The extent of a set in the layout of NeuS is the diameter of its sphere.
    """
    from stages.evaluation.protocols.known_object import has_truth, load_known_object
    from stages.evaluation.reading import Cameras

    if has_truth(folder):
        known = load_known_object(folder)
        by_stem = Cameras(str(folder), known.cameras).centers
        return [by_stem[stem] for stem in _stems(photos_of(folder))], known.surface.extent
    if (path := known_cameras(folder)) is not None:
        stated = read_neus(path)
        poses = [camera.cam_from_world for camera in stated.cameras]
        assert stated.region is not None  # the format has one
        return [-pose[:, :3].T @ pose[:, 3] for pose in poses], 2 * stated.region.radius
    return None


def true_centers_of_row(row: str, data: Path, names: Sequence[str]) -> tuple[list[np.ndarray], float] | None:
    """Camera centres [3] of these photos of a row, and the object's extent; None where not known."""
    name, _, variant = row.partition("-")
    truth, source = true_centers(data / name), photos_of(data / name)
    if truth is None:
        return None
    by_stem, stem_of = dict(zip(_stems(source), truth[0], strict=True)), known_stem(source, variant)
    return [by_stem[stem_of(photo)] for photo in names], truth[1]


def center_error(workspace: Path, data: Path, row: str) -> dict[str, float] | None:
    """Distance of the camera centres of a workspace to the truth, median and largest, in percent of the extent."""
    found = _found_centers(artifacts.MODEL.load(workspace / "sfm"))
    truth = true_centers_of_row(row, data, list(found))
    if truth is None or len(found) < 3:
        return None
    centers, extent = truth
    distance = center_distances(np.array(list(found.values())), np.array(centers))
    return {
        "median": round(100 * float(np.median(distance)) / extent, 4),
        "max": round(100 * float(distance.max()) / extent, 4),
    }


def center_distances(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """[N] distances of centres [N, 3] to the true ones, after alignment by a similarity."""
    from stages.geometry.similarity import align_points

    return np.linalg.norm(align_points(found, true).apply(found) - true, axis=1)


def known_stem(source: Path, variant: str) -> Callable[[str], str]:
    """Name of a photo of a variant -> that of the photo in `source` that it was made from, both without the suffix.

    Frames of a video have their numbers at the end of their names.
    """
    from stages.evaluation.protocols.known_object import file_stem

    if variant != "video":
        return file_stem
    stems = _stems(source)
    return lambda name: stems[int(Path(name).stem.rsplit("_", 1)[-1]) // VIDEO_HOLD]


def _stems(source: Path) -> list[str]:
    return [path.stem for path in sorted(source.iterdir())]


def _found_centers(model: Path) -> dict[str, np.ndarray]:
    from stages.evaluation.reading import read_cameras

    cameras = read_cameras(model).pinhole
    return dict(zip(cameras.names, cameras.centers, strict=True))


# ---------------------------------------------------------------- one row
def run_row(row: str, data: Path, mesh: bool, preset: str, settings: Sequence[str] = ()) -> Row:
    """Find the poses of one row, and its clean mesh if wanted and its truth is known.

    Raises:
        RuntimeError: `hineus` broke, rather than saying why it cannot.
    """
    from stages.evaluation.protocols.known_object import has_truth

    photos = make_photos(row, data)
    workspace = FOLDERS / row / "workspace"
    given = [word for setting in settings for word in ("--set", setting)]
    arguments = ["run", str(photos), "--workspace", str(workspace), "--preset", preset, *given, "--json"]
    answer = run_hineus([*arguments, "--until", POSES], ANSWERS)
    score, failure = None, None if answer["ok"] else _failure(answer)
    name, _, variant = row.partition("-")
    if mesh and failure is None and has_truth(data / name):
        answer = run_hineus([*arguments, "--until", CLEAN], ANSWERS)
        if answer["ok"]:
            stem_of = known_stem(photos_of(data / name), variant)
            score = score_clean_mesh(workspace, workspace, data / name, known_stem=stem_of)
        else:
            failure = _failure(answer)
    stages = {stage["name"]: stage for stage in answer.get("stages", ())}
    placed = "sfm" in stages
    registration = artifacts.REGISTRATION.load(workspace / "sfm") if placed else artifacts.Registration()
    words = [
        "python -m benchmarks.hard_variants DATA",
        row,
        *(["--mesh", f"--preset {preset}"] if mesh else []),
        *given,
    ]
    return Row(
        name=row,
        command=" ".join(words),
        machine=machine(),
        code=code_hash(),
        photos=_count(workspace, photos),
        registered=len(registration.registered),
        center_error=center_error(workspace, data, row) if placed else None,
        attempts=registration.ladder,
        cpu_s=round(stages["sfm"]["cpu_s"], 1) if placed else None,
        failure=failure,
        score=score,
        mesh_preset=preset if score else None,
        mesh_settings=tuple(settings) if score else (),
    )


def _failure(answer: dict[str, Any]) -> dict[str, str]:
    return {key: answer["error"][key] for key in ("message", "hint")}


def _count(workspace: Path, photos: Path) -> int:
    try:
        return len(artifacts.IMAGE_SET.load(workspace / "ingest").images)
    except WorkspaceError:
        return sum(1 for _ in photos.iterdir())


def code_hash() -> str:
    """Hash of the sources that decide where the poses come out."""
    stages = ROOT / "stages"
    sources = [stages / "ingest.py", stages / "sfm.py"]
    sources += [path for package in ("capture", "posing") for path in sorted((stages / package).glob("*.py"))]
    return hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()[:8]


# ---------------------------------------------------------------- result files and table
def save_row(row: Row) -> None:
    ROWS.mkdir(parents=True, exist_ok=True)
    artifacts.write_json(ROWS / f"{row.name}.json", asdict(row))


def load_rows() -> list[Row]:
    """All there are: the sets, then the variants in the order of `VARIANTS`."""
    rows = []
    for path in sorted(ROWS.glob("*.json")):
        data = artifacts.read_json(path)
        lists = {key: tuple(data[key]) for key in ("attempts", "mesh_settings") if key in data}
        rows.append(Row(**{**data, **lists}))
    order = {name: place for place, name in enumerate(VARIANTS)}

    def place(row: Row) -> tuple[bool, str, int, str]:
        base, _, variant = row.name.partition("-")
        return bool(variant), base, order.get(variant, len(order)), variant

    return sorted(rows, key=place)


def pose_table(rows: Sequence[Row]) -> str:
    """One row a set or variant, and under it what ended those that found no poses."""
    header = [
        "photos", "with a pose", "centre error %, median", "largest", "attempts", "CPU s", "mesh distance %",
    ]  # fmt: skip
    lines = [
        [
            row.name.replace("-", ": ").replace("_", " ") if "-" in row.name else row.name,
            f"{row.registered} of {row.photos}",
            *(f"{row.center_error[key]:.2f}" if row.center_error else "-" for key in ("median", "max")),
            attempts_cell(row),
            "-" if row.cpu_s is None else f"{row.cpu_s:.0f}",
            f"{row.score['mean']:.2f} ({' '.join((str(row.mesh_preset), *row.mesh_settings))})" if row.score else "-",
        ]
        for row in rows
    ]
    failures = [f"- {row.name}: {row.failure['message']} {row.failure['hint']}" for row in rows if row.failure]
    return "\n".join([markdown_table(header, lines), *([""] if failures else []), *failures])


def attempts_cell(row: Row) -> str:
    """The photos each attempt placed, the one whose model was kept last in bold."""
    kept = max((i for i, step in enumerate(row.attempts) if step["kept"]), default=None)
    cells = [f"{step['rung']} {step['registered']}" for step in row.attempts]
    return ", ".join(f"**{cell}**" if i == kept else cell for i, cell in enumerate(cells)) or "-"


def tables() -> dict[str, str]:
    """The table, from the result files."""
    rows = load_rows()
    return {"poses": pose_table(rows) if rows else NOT_MEASURED}


# ---------------------------------------------------------------- command
def main(argv: Sequence[str] | None = None) -> int:
    from stages.reconstruct import default_preset

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path, nargs="?", help="folder of sets")
    parser.add_argument("rows", nargs="*", help="SET or SET-VARIANT; default: all")
    parser.add_argument("--mesh", action="store_true", help="make and score the clean mesh, too")
    parser.add_argument("--preset", help="of the training; default: that of `hineus run`")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", help="as of `hineus run`")
    parser.add_argument("--again", action="store_true", help="also rows that have a result")
    parser.add_argument("--table-only", action="store_true", help="run nothing")
    arguments = parser.parse_args(argv)
    failed: list[str] = []
    if not arguments.table_only:
        if arguments.data is None:
            parser.error("name a folder of sets, or --table-only")
        data = arguments.data.resolve()
        known = all_rows(find_sets(data, ()))
        if unknown := [row for row in arguments.rows if row not in known]:
            parser.error(f"no row {', '.join(unknown)}; there are {', '.join(known)}")
        done = {} if arguments.again else {row.name: row for row in load_rows()}
        for row in arguments.rows or known:
            if row in done and (done[row].score or done[row].failure or not arguments.mesh):
                print(f"{row}: has a result (--again measures it anew)", file=sys.stderr)
                continue
            print(f"{row}: running", file=sys.stderr, flush=True)
            if arguments.again:
                shutil.rmtree(FOLDERS / row, ignore_errors=True)
            try:
                save_row(run_row(row, data, arguments.mesh, arguments.preset or default_preset(), arguments.set))
            except RuntimeError as error:
                print(f"{row}: {error}", file=sys.stderr)
                failed.append(row)
    write_tables(tables())
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
