"""Masks: which file is whose, how it is read, what is said of those that make no sense. Case numbers are those of the
small inputs that go wrong."""

from __future__ import annotations

import json
import shutil
import tracemalloc
import unicodedata
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from toy_pipeline import TOY
from typer.testing import CliRunner, Result

from configs.params import IngestParams
from hineus_cli.app import app, build_app
from stages import artifacts
from stages.artifacts import ImageSet
from stages.capture import photo_reading
from stages.capture.mask_fit import outline_fit
from stages.capture.mask_names import pair, set_masks_aside
from stages.capture.masks import bytes_to_read_masks, load_mask
from stages.capture.photo_reading import BYTES_PER_PIXEL
from stages.engine.stage import StageContext
from stages.errors import InputError
from stages.ingest import INGEST
from stages.posing.reading import masks_beside, read_poses

SIZE = (320, 240)
COUNT = 6


def scene(seed: int, size: tuple[int, int] = SIZE) -> tuple[np.ndarray, np.ndarray]:
    """A photo [H, W, 3] uint8 of a speckled thing before a soft background, and where the thing is [H, W] bool."""
    generator = np.random.default_rng(seed)
    width, height = size
    corners = np.array([[-30, -24], [8, -36], [34, -2], [12, 12], [16, 34], [-22, 26]]) * height / 120
    angle = 0.4 * seed
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    outline = np.rint(corners @ turn.T + (width * 0.5, height * 0.5)).astype(np.int32)
    mask = cv2.fillPoly(np.zeros((height, width), np.uint8), [outline], 1) > 0
    soft = cv2.resize(generator.integers(150, 230, (4, 5, 3)).astype(np.uint8), size, interpolation=cv2.INTER_CUBIC)
    thing = cv2.resize(generator.integers(20, 110, (24, 32, 3)).astype(np.uint8), size, interpolation=cv2.INTER_CUBIC)
    return np.where(mask[..., None], thing, soft), mask


def white(mask: np.ndarray) -> Image.Image:
    return Image.fromarray(mask.astype(np.uint8) * 255)


def write_set(
    folder: Path,
    masks: str = "masks/{stem}.png",
    draw: Callable[[int], Image.Image] = lambda i: white(scene(i)[1]),
    photos: str = "photos/{i:03d}.jpg",
    count: int = COUNT,
) -> Path:
    """Photos and masks under these names; the folder of the photos."""
    for i in range(count):
        photo = folder / photos.format(i=i)
        photo.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(scene(i)[0]).save(photo, quality=92)
        if masks:
            mask = folder / masks.format(stem=photo.stem, name=photo.name, i=i)
            mask.parent.mkdir(parents=True, exist_ok=True)
            draw(i).save(mask)
    return folder / "photos"


def ingest(photos: Path, masks: Path | None = None, poses: Path | None = None, **params: object) -> ImageSet:
    out, scratch = photos.parent / "out", photos.parent / "scratch"
    for folder in (out, scratch):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
    sources = {"photos": photos, "masks": masks, "poses": poses}
    given = {name: path for name, path in sources.items() if path is not None}
    INGEST.run(StageContext({}, given, out, scratch, IngestParams(**params), workers=2))  # type: ignore[arg-type]
    return artifacts.IMAGE_SET.load(out)


def agreement(photos: Path, name: str, truth: np.ndarray) -> float:
    """Intersection over union of the mask that ingest wrote."""
    mask = artifacts.Pictures(photos.parent / "out").mask(name)
    assert mask is not None
    return float(((mask > 127) & truth).sum() / ((mask > 127) | truth).sum())


def aside(photos: list[str]) -> tuple[list[str], dict[str, str], list[str]]:
    """`set_masks_aside` of names alone."""
    kept, masks, others = set_masks_aside({name: Path(name) for name in photos})
    return list(kept), {photo: Path(mask).as_posix() for photo, mask in masks.items()}, sorted(map(str, others))


def check(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["check", *map(str, arguments)])


def said(result: Result) -> str:
    """What was printed, whatever the width of the terminal."""
    return " ".join((result.stdout + result.stderr).split())


# ---------------------------------------------------------------- names
@pytest.mark.parametrize(
    ("photo", "mask"),
    [
        ("IMG_1.JPG", "IMG_1_mask.JPG"),  # ODM
        ("IMG_1.jpg", "img_1-Mask.PNG"),
        ("IMG_1.jpg", "IMG_1.mask.png"),  # openMVS
        ("IMG_1.jpg", "IMG_1.jpg.mask.png"),  # RealityCapture
        ("IMG_1.jpg", "IMG_1.jpg.png"),  # COLMAP
        ("IMG_1.jpg", "IMG_1_Masq.tif"),  # MicMac
        ("IMG_1.jpg", "mask_IMG_1.png"),
        ("IMG_1.jpg", "dynamic_mask_IMG_1.png"),  # instant-ngp
        ("a b (2).jpeg", "a b (2) (mask).png"),
        ("_091-frame_0_mask_0.jpg", "_091-frame_0_mask_0_mask.png"),
    ],
)
def test_a_mask_beside_its_photo_is_told_by_its_name(photo: str, mask: str):
    assert aside([photo, mask, "other.jpg"]) == ([photo, "other.jpg"], {photo: mask}, [mask])
    assert pair([photo, "other.jpg"], [mask]) == {photo: mask}


@pytest.mark.parametrize(
    "masks",
    [
        {"cam1/0.jpg": "masks/cam1/0.png", "cam2/0.jpg": "masks/cam2/0.png"},
        {"cam1/0.jpg": "cam1/Masks/0.jpg.png", "cam2/0.jpg": "cam2/Masks/0.jpg.png"},
        {"images/0.jpg": "mask/0_mask.png", "images/1.jpg": "mask/1_mask.png"},
        {"a/images/0.jpg": "a/masks/0.png", "b/images/0.jpg": "b/masks/0.png"},
        {"images/0.jpg": "masks/0_fg.png", "images/1.jpg": "masks/1_fg.png"},
    ],
)
def test_folders_of_masks_among_the_photos(masks: dict[str, str]):
    photos = list(masks)
    assert aside([*photos, *masks.values()]) == (photos, masks, sorted(masks.values()))


def test_photos_are_not_taken_for_masks():
    for photos in (
        ["mask.jpg"],
        ["masks/1.jpg", "masks/2.jpg"],  # photos of masks
        ["masks/1.jpg", "vases/2.jpg"],
        ["1_mask.jpg", "2_mask.jpg"],
        ["img.v2.jpg", "img.jpg"],
    ):
        assert aside(photos) == (photos, {}, [])


def test_one_mask_for_a_whole_folder_is_no_photo():
    assert aside(["1.jpg", "2.jpg", "mask.tif"]) == (["1.jpg", "2.jpg"], {}, ["mask.tif"])


def test_reduced_copies_of_masks_are_not_preferred():
    photos, masks, others = aside(["images/1.png", "masks/1.png", "masks_2/1.png"])
    assert (photos, masks) == (["images/1.png"], {"images/1.png": "masks/1.png"})
    assert others == ["masks/1.png", "masks_2/1.png"]


def test_accents_are_the_same_however_they_are_composed():
    photo, mask = unicodedata.normalize("NFC", "Vasé.jpg"), unicodedata.normalize("NFD", "vasé_mask.png")
    assert pair([photo], [mask]) == {photo: mask}


def test_names_with_the_same_ending_are_understood_and_other_numbers_are_not():
    photos = [f"{i}.jpg" for i in range(1, 9)]
    assert pair(photos, [f"cut-{i}_v2.png" for i in range(1, 9)])["3.jpg"] == "cut-3_v2.png"
    assert pair(photos, [f"10{i}.png" for i in range(1, 9)]) == {}


def test_one_mask_is_not_for_photos_of_two_folders():
    assert pair(["a/1.jpg", "b/1.jpg"], ["1.png"]) == {}
    assert pair(["1.jpg"], ["a/1.png", "b/1.png"]) == {}
    assert pair(["a/1.jpg", "b/1.jpg"], ["a/1.png"]) == {"a/1.jpg": "a/1.png"}


# ---------------------------------------------------------------- which are used
def test_masks_among_the_photos_are_used_and_left_out_on_demand(tmp_path: Path, caplog):
    photos = write_set(tmp_path, "photos/{stem}_mask.png")
    caplog.set_level("INFO")
    image_set = ingest(photos)
    assert [record.has_mask for record in image_set.images] == [True] * COUNT
    assert "masks: 6 are used, e.g. 000_mask.png for 000.jpg; `--no-masks` leaves them out" in caplog.text
    assert min(agreement(photos, f"{i:03d}.jpg", scene(i)[1]) for i in range(COUNT)) == 1
    bare = ingest(photos, own_masks=False)
    assert [record.has_mask for record in bare.images] == [False] * COUNT
    assert {item.source for item in bare.skipped} == {f"{i:03d}_mask.png" for i in range(COUNT)}


def test_a_photo_is_never_its_own_mask(tmp_path: Path):
    """Case 01."""
    photos = write_set(tmp_path, "")
    with pytest.raises(InputError, match=r"6 of 6 photos have no mask in .* It holds the photos only"):
        ingest(photos, photos)
    write_set(tmp_path, "photos/{stem}_mask.png")
    for masks in (photos, tmp_path):
        assert [record.name for record in ingest(photos, masks).images] == [f"{i:03d}.jpg" for i in range(COUNT)]
        assert agreement(photos, "002.jpg", scene(2)[1]) == 1


@pytest.mark.slow
def test_case_01(cases_dir: Path, tmp_path: Path):
    photos = tmp_path / "photos"
    shutil.copytree(cases_dir / "01-masks-beside" / "photos", photos)
    for masks in (None, photos):
        image_set = ingest(photos, masks)
        assert len(image_set.images) == 12
        assert all(record.has_mask for record in image_set.images)
        kept = [artifacts.Pictures(tmp_path / "out").mask(record.name) for record in image_set.images]
        assert all(0.02 < (mask > 0).mean() < 0.5 for mask in kept if mask is not None)
    result = check(photos)
    assert (result.exit_code, said(result).count("12 are used, e.g. 000_mask.JPG")) == (0, 1)
    assert "photos 12 " in said(result)


@pytest.mark.slow
def test_case_02(cases_dir: Path, tmp_path: Path):
    case = tmp_path / "case"
    shutil.copytree(cases_dir / "02-openmvs-masks", case)
    assert all(record.has_mask for record in ingest(case / "photos", case / "masks").images)
    assert "8 are used, e.g. 000.mask.png for 000.jpg" in said(check(case / "photos", "--masks", case / "masks"))


def test_masks_that_are_named_replace_those_among_the_photos(tmp_path: Path):
    photos = write_set(tmp_path, "photos/{stem}_mask.png", lambda i: white(~scene(i)[1]))
    write_set(tmp_path)
    assert all(record.has_mask for record in ingest(photos, tmp_path / "masks").images)
    assert agreement(photos, "001.jpg", scene(1)[1]) == 1


def test_alpha_channels_are_masks_unless_none_are_wanted(tmp_path: Path):
    photos = tmp_path / "photos"
    photos.mkdir()
    for i, suffix in enumerate((".png", ".tif", ".webp")):
        pixels, mask = scene(i)
        image = Image.fromarray(np.dstack([pixels, mask.astype(np.uint8) * 255]))
        image.save(photos / f"{i}{suffix}")
    assert all(record.has_mask for record in ingest(photos).images)
    assert "3 are used, e.g. alpha channel of 0.png" in said(check(photos))
    assert not any(record.has_mask for record in ingest(photos, own_masks=False).images)
    assert "alpha channel" not in said(check(photos, "--no-masks"))


def test_masks_nearby_are_mentioned(tmp_path: Path):
    photos = write_set(tmp_path, "Masks/{stem}.png")
    assert f"none are used; `--masks {tmp_path / 'Masks'}` would use those there" in said(check(photos))
    hidden = write_set(tmp_path / "other", "photos/.mask/{stem}.png")  # RealityCapture's layer
    assert f"--masks {hidden / '.mask'}" in said(check(hidden))
    assert "6 are used" in said(check(hidden, "--masks", hidden / ".mask"))


def test_masks_with_names_of_their_own_do_not_count_as_photos(tmp_path: Path):
    photos = write_set(tmp_path, "photos/{i}x{stem}.png")
    image_set = ingest(photos)
    assert len(image_set.images) == COUNT
    assert {item.reason.split(",")[0] for item in image_set.skipped} == {"black and white"}


# ---------------------------------------------------------------- how a mask is read
def as_palette(mask: np.ndarray) -> Image.Image:
    image = Image.fromarray(mask.astype(np.uint8))
    image.putpalette([0, 0, 0, 128, 0, 0, *[0] * 762])
    return image


@pytest.mark.parametrize(
    ("suffix", "draw"),
    [
        (".png", as_palette),
        (".png", lambda mask: Image.fromarray(mask)),
        (".png", lambda mask: Image.fromarray(mask.astype(np.uint8))),
        (".png", lambda mask: Image.fromarray(mask.astype(np.uint16) * 65535)),
        (".png", lambda mask: Image.fromarray(mask.astype(np.uint16))),
        (".png", lambda mask: white(mask).convert("RGB")),
        (".png", lambda mask: Image.merge("RGBA", [white(np.ones_like(mask))] * 3 + [white(mask)])),
        (".png", lambda mask: white(mask).convert("RGBA")),
        (".png", lambda mask: Image.fromarray(np.where(mask, 255, 90).astype(np.uint8))),
        (".tif", lambda mask: Image.fromarray(mask.astype(np.float32))),
        (".tif", lambda mask: Image.fromarray(mask.astype(np.int32))),
        (".jpg", lambda mask: white(mask)),
    ],
)
def test_masks_of_any_depth_are_black_and_white(tmp_path: Path, suffix: str, draw: Callable[[np.ndarray], Image.Image]):
    mask, file = scene(3)[1], tmp_path / f"mask{suffix}"
    draw(mask).save(file)
    kept = load_mask(file, "photo", SIZE, SIZE, 1).kept
    assert (kept != mask).mean() < 0.005
    assert (load_mask(file, "photo", SIZE, SIZE, 1, black_keeps=True).kept == ~kept).all()


def test_large_masks_are_read_within_the_memory_that_is_free(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    file = tmp_path / "large.png"
    Image.new("1", (8000, 6000)).save(file)  # 48 MP; the photo is small
    needed = bytes_to_read_masks([file, tmp_path / "none.png"])
    assert needed == BYTES_PER_PIXEL * 48_000_000
    monkeypatch.setattr(photo_reading, "available_memory", lambda: needed - 1)
    with pytest.raises(InputError, match=r"large\.png cannot be read: 8000 x 6000 pixels take 0\.7 GiB"):
        load_mask(file, "photo", (160, 120), (160, 120), 1)
    monkeypatch.setattr(photo_reading, "available_memory", lambda: needed)
    tracemalloc.start()
    load_mask(file, "photo", (160, 120), (160, 120), 1)
    assert tracemalloc.get_traced_memory()[1] < 5 * 48_000_000  # of numpy: no floats of 8 bytes
    tracemalloc.stop()


def test_sizes_of_poses_that_would_fill_the_memory(tmp_path: Path):
    Image.new("L", (100, 100)).save(tmp_path / "x.png")
    with pytest.raises(InputError, match="100000 x 100000 pixels, too many for a mask"):
        load_mask(tmp_path / "x.png", "photo", (100_000, 100_000), (100_000, 100_000), 1)


@pytest.mark.slow
def test_the_largest_mask_counts_among_the_needs(tmp_path: Path):
    photos = write_set(tmp_path, "masks/{stem}.png")
    Image.new("1", (12000, 9000)).save(next((tmp_path / "masks").iterdir()))
    result = check(photos, "--masks", tmp_path / "masks", "--json")
    assert json.loads(result.stdout)["needs"]["memory_gib"] == pytest.approx(BYTES_PER_PIXEL * 108e6 / 2**30)


@pytest.mark.parametrize("value", [0, 1, 255])
def test_masks_of_one_value_and_the_noise_of_jpeg(tmp_path: Path, value: int):
    noise = np.random.default_rng(0).integers(-3, 4, SIZE[::-1])
    for suffix, pixels in ((".png", np.full(SIZE[::-1], value)), (".jpg", value + noise if value != 1 else noise)):
        Image.fromarray(pixels.clip(0, 255).astype(np.uint8)).save(tmp_path / f"mask{suffix}", quality=60)
        kept = load_mask(tmp_path / f"mask{suffix}", "photo", SIZE, SIZE, 1).kept
        assert kept.mean() == (value > 0 if suffix == ".png" else value == 255)


@pytest.mark.parametrize(
    "draw",
    [
        lambda i: Image.fromarray(scene(i)[0]),
        lambda i: Image.fromarray(np.linspace(0, 65535, SIZE[0] * SIZE[1]).reshape(SIZE[::-1]).astype(np.uint16)),
        lambda i: Image.fromarray((scene(i)[1] * 3 + np.linspace(0, 2.99, SIZE[0]).astype(int)).astype(np.uint8)),
    ],
    ids=["photo", "depth", "labels"],
)
def test_what_is_not_black_and_white_is_no_mask(tmp_path: Path, draw: Callable[[int], Image.Image]):
    photos = write_set(tmp_path, draw=draw)
    with pytest.raises(InputError, match=r"000\.png, taken for the mask of 000\.jpg, is not black and white: \d+%"):
        ingest(photos, tmp_path / "masks")
    result = check(photos, "--masks", tmp_path / "masks")
    assert result.exit_code == InputError.exit_code
    assert "5 more masks cannot be used either" in said(result)


@pytest.mark.parametrize("orientation", [3, 6, 8])
@pytest.mark.parametrize("drawn_on", ["stored", "upright", "stored with EXIF"])
def test_masks_are_turned_as_their_photos(tmp_path: Path, orientation: int, drawn_on: str):
    back = {3: Image.Transpose.ROTATE_180, 6: Image.Transpose.ROTATE_90, 8: Image.Transpose.ROTATE_270}[orientation]
    exif = Image.Exif()
    exif[0x0112] = orientation
    for i in range(3):
        pixels, mask = scene(i)
        for folder in ("photos", "masks"):
            (tmp_path / folder).mkdir(exist_ok=True)
        Image.fromarray(pixels).transpose(back).save(tmp_path / "photos" / f"{i}.jpg", exif=exif)
        stored = white(mask) if drawn_on == "upright" else white(mask).transpose(back)
        stored.save(tmp_path / "masks" / f"{i}.png", **({"exif": exif} if drawn_on == "stored with EXIF" else {}))
    assert len(ingest(tmp_path / "photos", tmp_path / "masks").images) == 3
    assert min(agreement(tmp_path / "photos", f"{i}.jpg", scene(i)[1]) for i in range(3)) == 1
    assert "do not seem to belong" not in said(check(tmp_path / "photos", "--masks", tmp_path / "masks"))


@pytest.mark.parametrize("size", [(160, 120), (107, 80), (800, 600)])
def test_masks_of_the_photos_shape_are_scaled(tmp_path: Path, caplog, size: tuple[int, int]):
    photos = write_set(tmp_path, draw=lambda i: white(scene(i)[1]).resize(size))
    caplog.set_level("INFO")
    ingest(photos, tmp_path / "masks")
    assert f"6 are scaled to their photos ({size[0]} x {size[1]} to 320 x 240)" in caplog.text
    assert agreement(photos, "000.jpg", scene(0)[1]) > 0.9


# ---------------------------------------------------------------- what is wrong with them
def mixed(i: int) -> Image.Image:
    return white(~scene(i)[1] if i < 2 else scene(i)[1])


DOUBTS: dict[str, tuple[Callable[[int], Image.Image], bool, str, str]] = {
    "inverted": (lambda i: white(~scene(i)[1]), True, "The masks seem inverted: in 6 of 6", "--masks-black-keeps"),
    "some inverted": (mixed, False, "2 of 6 masks seem inverted against the others: 000.png, 001.png.", "leave_out"),
    "white": (lambda i: white(np.ones(SIZE[::-1])), True, "All 6 masks keep the whole photo", "--no-masks"),
    "black": (lambda i: white(np.zeros(SIZE[::-1])), True, "All 6 masks are empty", "--no-masks"),
    "one white": (
        lambda i: white(scene(i)[1] | (i == 4)),
        False,
        "1 of 6 masks keep the whole photo: 004.png.",
        "--no-masks",
    ),
    "the next": (lambda i: white(scene(i + 1)[1]), False, "do not seem to belong to these photos", "`--masks`"),
    "turned": (lambda i: white(scene(i)[1][::-1, ::-1]), False, "They would fit turned by 180 degrees", "--no-masks"),
    "all the same": (lambda i: white(scene(0)[1]), False, "All 6 masks are one and the same picture", "--no-masks"),
    "coarse": (lambda i: white(scene(i)[1]).resize((64, 48)), False, "much smaller than their photos", "--no-masks"),
    "on its side": (lambda i: white(scene(i)[1].T), True, "240 x 320 pixels, 000.jpg is 320 x 240 (it lies", "make"),
}


@pytest.mark.parametrize("kind", DOUBTS)
def test_masks_that_make_no_sense_are_found(tmp_path: Path, caplog, kind: str):
    draw, impossible, message, hint = DOUBTS[kind]
    photos = write_set(tmp_path, draw=draw)
    result = check(photos, "--masks", tmp_path / "masks")
    assert message in said(result)
    assert hint in said(result)
    assert result.exit_code == (InputError.exit_code if impossible else 0)
    if impossible:
        with pytest.raises(InputError) as caught:
            ingest(photos, tmp_path / "masks")
        assert message in caught.value.message
        assert hint in caught.value.hint
    else:
        ingest(photos, tmp_path / "masks")
        assert message in caplog.text


@pytest.mark.parametrize("wider", [0, 3])
def test_right_masks_raise_no_doubt(tmp_path: Path, wider: int):
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * wider + 1,) * 2)
    photos = write_set(tmp_path, draw=lambda i: white(cv2.dilate(scene(i)[1].astype(np.uint8), disk) > 0))
    lines = check(photos, "--masks", tmp_path / "masks").stdout.splitlines()
    assert [line for line in lines if line.startswith("warning")] == [line for line in lines if "Only 6 photos" in line]


def test_an_outline_fits_its_own_photo_only():
    fits = np.array(
        [[fit is not None and fit.fits for fit in (outline_fit(scene(j)[1], scene(i)[0]) for j in range(4))]
         for i in range(4)]
    )  # fmt: skip
    assert fits.diagonal().all()
    assert fits[~np.eye(4, dtype=bool)].mean() < 0.2
    assert outline_fit(np.ones(SIZE[::-1], bool), scene(0)[0]) is None


def test_masks_of_the_development_sets_fit_and_those_of_others_do_not(data_dir: Path):
    def load(kind: str, name: str) -> list[np.ndarray]:
        files = sorted((data_dir / name / kind).iterdir())[::8]
        return [np.asarray(Image.open(file).convert("RGB" if kind == "images" else "L")) for file in files]

    photos, masks = load("images", "synth_helmet"), load("masks", "synth_helmet")

    def fitting(masks: list[np.ndarray]) -> float:
        fits = [outline_fit(mask > 127, photo) for photo, mask in zip(photos, masks, strict=True)]
        return float(np.mean([fit is not None and fit.fits for fit in fits]))

    assert fitting(masks) > 0.8
    assert fitting(load("masks", "synth_plaster")) < 0.2
    assert fitting(masks[1:] + masks[:1]) < 0.2


def test_black_keeps_where_the_user_says_so(tmp_path: Path):
    photos = write_set(tmp_path, draw=lambda i: white(~scene(i)[1]))
    ingest(photos, tmp_path / "masks", masks_keep="black")
    assert agreement(photos, "000.jpg", scene(0)[1]) == 1
    assert "inverted" not in said(check(photos, "--masks", tmp_path / "masks", "--masks-black-keeps"))
    sure = check(photos, "--masks", tmp_path / "masks", "--masks-white-keeps")
    assert (sure.exit_code, "The masks seem inverted" in said(sure)) == (0, True)


def test_a_workspace_remembers_what_black_means_and_that_no_masks_are_wanted(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for folder in ("photos", "masks"):
        (tmp_path / folder).mkdir()
        for i in range(3):
            (tmp_path / folder / f"{i}.png").write_text(f"{i}")

    def run(*arguments: str) -> None:
        result = CliRunner().invoke(build_app(TOY), ["run", *arguments, "-w", "ws"])
        assert result.exit_code == 0, result.stderr

    def kept() -> tuple[str, str]:
        lines = (tmp_path / "ws" / "config.yaml").read_text().splitlines()
        said = {key: value for key, _, value in (line.strip().partition(": ") for line in lines)}
        return said["masks_keep"], said["own_masks"]

    run("photos", "--masks", "masks", "--masks-black-keeps", "--preset", "tiny")
    run("photos", "--preset", "cpu")
    assert kept() == ("black", "true")
    run("--no-masks", "--masks-white-keeps")
    run("--preset", "tiny")
    assert kept() == ("white", "false")
    run("photos", "--masks", "masks", "--preset", "tiny")
    assert kept() == ("auto", "true")


def test_only_some_photos_have_masks(tmp_path: Path):
    photos = write_set(tmp_path, "photos/{stem}_mask.png")
    for i in (1, 3):
        (photos / f"{i:03d}_mask.png").unlink()
    assert [record.has_mask for record in ingest(photos).images] == [True, False, True, False, True, True]
    assert "Only 4 of 6 photos have a mask, so that training goes without masks." in said(check(photos))
    result = check(photos, "--masks", photos)
    assert result.exit_code == InputError.exit_code
    assert "2 of 6 photos have no mask in" in said(result)


def test_a_file_instead_of_a_folder_of_masks(tmp_path: Path):
    photos = write_set(tmp_path)
    result = check(photos, "--masks", tmp_path / "masks" / "000.png")
    assert result.exit_code == InputError.exit_code
    assert "is a file; a folder of masks is needed" in said(result)


# ---------------------------------------------------------------- mask_path in transforms.json
def write_transforms(folder: Path, mask_path: Callable[[int], object]) -> Path:
    frames = []
    for i in range(COUNT):
        pose = np.eye(4)
        pose[0, 3] = i
        frame = {"file_path": f"photos/{i:03d}.jpg", "transform_matrix": pose.tolist()}
        frames.append(frame | ({"mask_path": path} if (path := mask_path(i)) is not None else {}))
    data = {"fl_x": 150, "w": SIZE[0], "h": SIZE[1], "camera_model": "PINHOLE", "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(data))
    return folder / "transforms.json"


@pytest.mark.parametrize(
    ("masks", "mask_path", "folder"),
    [
        ("fg/m{stem}x.png", "./fg/m{i:03d}x.png", "fg"),
        ("fg/a{i}/1.png", "fg\\a{i}\\1.png", "fg"),
        ("photos/{stem}_fg.png", "photos/{i:03d}_fg.png", "photos"),
    ],
)
def test_mask_paths_are_used(tmp_path: Path, masks: str, mask_path: str, folder: str):
    photos = write_set(tmp_path, masks)
    file = write_transforms(tmp_path, lambda i: mask_path.format(i=i))
    assert masks_beside(file) == tmp_path / folder
    assert all(record.has_mask for record in ingest(photos, masks_beside(file), file).images)
    assert min(agreement(photos, f"{i:03d}.jpg", scene(i)[1]) for i in range(COUNT)) == 1
    assert "6 are used" in said(check(photos, "--poses", file))


def test_masks_that_are_named_replace_mask_paths(tmp_path: Path):
    photos = write_set(tmp_path)
    file = write_transforms(tmp_path, lambda i: f"gone/{i}.png")
    assert all(record.has_mask for record in ingest(photos, tmp_path / "masks", file).images)
    assert check(photos, "--poses", file, "--masks", tmp_path / "masks").exit_code == 0
    assert check(photos, "--poses", file, "--no-masks").exit_code == 0
    result = check(photos, "--poses", file)
    assert result.exit_code == InputError.exit_code
    assert "6 of 6 masks that" in said(result)
    assert "gone/0.png" in said(result)
    assert "--no-masks" in said(result)


def test_one_file_for_all_frames_is_no_mask_of_an_object(tmp_path: Path):
    photos = write_set(tmp_path, "")
    white(scene(0)[1]).save(tmp_path / "mask.png")
    file = write_transforms(tmp_path, lambda i: "mask.png")
    with pytest.raises(InputError, match="All 6 masks are one and the same picture") as caught:
        ingest(photos, masks_beside(file), file)
    assert "--no-masks" in caught.value.hint


def test_a_mask_path_that_is_no_text(tmp_path: Path):
    with pytest.raises(InputError, match=r"`mask_path` of photos/000\.jpg .* is 17"):
        read_poses(write_transforms(tmp_path, lambda i: 17))


@pytest.mark.slow
def test_case_10(cases_dir: Path, tmp_path: Path):
    case = tmp_path / "case"
    shutil.copytree(cases_dir / "10-nerfstudio-mask-path", case)
    result = check(case / "images", "--poses", case / "transforms.json")
    assert "24 are used, e.g. 000_fg.png for 000.jpg" in said(result)
    ran = CliRunner().invoke(
        app,
        [
            "ingest",
            str(case / "images"),
            "--poses",
            str(case / "transforms.json"),
            "-w",
            str(tmp_path / "ws"),
            "--json",
        ],
    )
    assert ran.exit_code == 0, ran.stderr
    assert json.loads(ran.stdout)["stages"][0]["numbers"]["masks"] == 24
