"""Ingest: what is kept, what is turned, what is left out, and the sentences for unusable input."""

from __future__ import annotations

import os
import shutil
import struct
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import psutil
import pytest
from PIL import Image

from configs.params import IngestParams
from stages import artifacts
from stages.artifacts import ImageSet
from stages.capture.exif import DIAGONAL_35MM
from stages.capture.photo_reading import UnusableError, read_head, read_preview
from stages.engine.stage import StageContext
from stages.errors import InputError
from stages.ingest import INGEST
from stages.inputs.formats import register_formats

SIZE = (96, 72)


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    return folder


def picture(seed: int, size: tuple[int, int] = SIZE) -> Image.Image:
    """Smooth colours, so that JPEG keeps them, different for each seed."""
    generator = np.random.default_rng(seed)
    small = Image.fromarray(generator.integers(0, 256, (4, 4, 3), dtype=np.uint8))
    return small.resize(size, Image.Resampling.BICUBIC)


def write_photos(folder: Path, count: int = 4, suffix: str = ".jpg", first: int = 0) -> list[str]:
    names = [f"{first + i:03d}{suffix}" for i in range(count)]
    for i, name in enumerate(names):
        picture(first + i).save(folder / name)
    return names


def exif_of(
    orientation: int | None = None,
    focal_mm: float | None = None,
    focal_35mm: int | None = None,
    pitch: tuple[float, int] | None = None,
    model: str | None = None,
    taken_width: int | None = None,
) -> Image.Exif:
    exif = Image.Exif()
    if orientation:
        exif[0x0112] = orientation
    if model:
        exif[0x0110] = model
    tags = exif.get_ifd(0x8769)
    if focal_mm:
        tags[0x920A] = focal_mm
    if focal_35mm:
        tags[0xA405] = focal_35mm
    if pitch:
        tags[0xA20E], tags[0xA210] = pitch
    if taken_width:
        tags[0xA002] = taken_width
    exif[0x8769] = dict(tags)  # without that, Pillow writes none to TIFF
    return exif


def ingest(photos: Path, masks: Path | None = None, **params: object) -> tuple[ImageSet, Path, dict[str, object]]:
    out, scratch = photos.parent / "out", photos.parent / "scratch"
    for folder in (out, scratch):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()
    sources = {"photos": photos} if masks is None else {"photos": photos, "masks": masks}
    numbers = INGEST.run(
        StageContext({}, sources, out, scratch, IngestParams(**params), workers=2)  # type: ignore[arg-type]
    )
    return artifacts.IMAGE_SET.load(out), out, numbers


def reasons(image_set: ImageSet) -> dict[str, str]:
    return {item.source: item.reason for item in image_set.skipped}


# ---------------------------------------------------------------- kept as it is
@pytest.mark.parametrize("suffix", [".jpg", ".png", ".tif", ".bmp", ".JPG"])
def test_plain_photo_is_copied_byte_for_byte_under_its_name(photos: Path, suffix: str):
    (photos / "left").mkdir()
    names = write_photos(photos, 3, suffix)
    shutil.copy(photos / names[0], photos / "left" / names[0])
    picture(9).save(photos / "left" / names[0])
    image_set, out, numbers = ingest(photos)
    assert [record.name for record in image_set.images] == [*names, f"left/{names[0]}"]
    assert numbers["images"] == 4
    for record in image_set.images:
        assert artifacts.Pictures(out).path(record.name).read_bytes() == (photos / record.source).read_bytes()
        assert (record.width, record.height) == SIZE


def test_a_second_run_gives_the_same_records(photos: Path):
    write_photos(photos, 6)
    write_photos(photos, 3, ".webp", first=3)
    assert ingest(photos)[0] == ingest(photos)[0]


# ---------------------------------------------------------------- re-encoded
@pytest.mark.parametrize("orientation", range(2, 9))
def test_exif_orientation_is_applied_and_gone(photos: Path, orientation: int):
    write_photos(photos, 3)
    upright = picture(7)
    upright.transpose(UNDONE[orientation]).save(photos / "turned.jpg", quality=97, exif=exif_of(orientation))
    image_set, out, _ = ingest(photos)
    record = image_set.images[-1]
    assert record.name == "turned.jpg"
    assert (record.width, record.height) == SIZE
    with Image.open(artifacts.Pictures(out).path(record.name)) as written:
        assert written.getexif().get(0x0112, 1) == 1
        difference = np.abs(np.asarray(written, dtype=int) - np.asarray(upright, dtype=int))
    assert difference.mean() < 4  # JPEG twice; a wrong turn differs by about 60


UNDONE = {
    1: None,
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_90,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_270,
}


@pytest.mark.parametrize("suffix", [".png", ".webp"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_alpha_channels_are_upright_in_previews(photos: Path, suffix: str, orientation: int):
    upright, undo = picture(7), UNDONE[orientation]
    opacity = np.zeros(upright.size[::-1], np.uint8)
    opacity[:20, :50] = 255
    upright.putalpha(Image.fromarray(opacity))
    stored = upright if undo is None else upright.transpose(undo)
    stored.save(photos / f"0{suffix}", exif=exif_of(orientation))
    _, alpha = read_preview(photos / f"0{suffix}")
    assert alpha is not None
    assert np.array_equal(alpha, opacity > 127)


@pytest.mark.parametrize("suffix", [".jpg", ".tif", ".png", ".webp"])
@pytest.mark.parametrize("orientation", range(1, 9))
def test_photos_are_upright_for_every_reader(photos: Path, suffix: str, orientation: int):
    """Pillow, OpenCV with and without regard to EXIF, and COLMAP see one picture; its record and masks fit it."""
    import cv2
    import pycolmap

    upright, undo = picture(7), UNDONE[orientation]
    stored = upright if undo is None else upright.transpose(undo)
    exif = exif_of(orientation, focal_mm=8.0, pitch=(20.0 * 25.4, 2), taken_width=stored.width, model="A")
    for i in range(3):  # one camera, so that nothing is left out
        stored.point(lambda value, i=i: max(0, value - i)).save(photos / f"{i}{suffix}", quality=97, exif=exif)
    masks = write_masks(photos.parent / "masks", ["0.x", "1.x", "2.x"])
    images, out, _ = ingest(photos, masks)
    record = images.images[0]
    assert (record.width, record.height) == SIZE
    assert record.focal_px == pytest.approx(160)
    assert read_head(photos / f"0{suffix}", "0", 3200).width == SIZE[0]
    assert np.abs(read_preview(photos / f"0{suffix}")[0].astype(int) - np.asarray(upright)).mean() < 5
    path = artifacts.Pictures(out).path(record.name)
    with Image.open(path) as written:
        seen = [np.asarray(written.convert("RGB"))]
    seen += [cv2.imread(str(path), flags)[:, :, ::-1] for flags in (1, 1 | cv2.IMREAD_IGNORE_ORIENTATION)]
    seen.append(pycolmap.Bitmap.read(str(path), True).to_array())
    for pixels in seen:
        assert np.abs(pixels.astype(int) - np.asarray(upright)).mean() < 5
    np.testing.assert_array_equal(artifacts.Pictures(out).mask(record.name), half_mask())


@pytest.mark.parametrize(("folder", "count"), [("photos", 8), ("photos_180", 16)])
def test_case_07(cases_dir: Path, tmp_path: Path, folder: str, count: int):
    (tmp_path / "photos").symlink_to(cases_dir / "07-tiff-orientation" / folder)
    images, _, numbers = ingest(tmp_path / "photos")
    assert numbers["images"] == count
    assert {(record.width, record.height) for record in images.images} == {(480, 360)}
    assert {Path(record.name).suffix for record in images.images} == {".png"}


def test_formats_colmap_cannot_read_are_encoded_anew(photos: Path):
    write_photos(photos, 2)
    picture(2).save(photos / "web.webp")
    picture(3).convert("L").save(photos / "grey.png")
    picture(4).convert("CMYK").save(photos / "cmyk.jpg")
    picture(5).convert("P").save(photos / "palette.png")
    Image.fromarray(np.arange(96 * 72, dtype=np.uint16).reshape(72, 96) * 9).save(photos / "deep.png")
    image_set, out, _ = ingest(photos)
    assert not image_set.skipped
    names = {record.source: record.name for record in image_set.images}
    assert names["web.webp"] == "web.jpg"
    for record in image_set.images:
        with Image.open(artifacts.Pictures(out).path(record.name)) as written:
            assert written.mode == "RGB"
            assert written.size == SIZE
    with Image.open(artifacts.Pictures(out).path("deep.png")) as written:
        assert np.asarray(written).max() == 96 * 72 * 9 // 257  # scaled to 8 bits, not clipped


@pytest.mark.parametrize(("suffix", "orientation"), [(".avif", 6), (".heic", 1)])
def test_formats_of_phones_are_read_upright_with_their_exif(photos: Path, suffix: str, orientation: int):
    register_formats()
    write_photos(photos, 2)
    upright = picture(7)
    exif = exif_of(orientation, focal_mm=4.0, focal_35mm=28, model="A")
    stored = upright.transpose(Image.Transpose.ROTATE_90) if orientation == 6 else upright
    stored.save(photos / f"z{suffix}", quality=95, exif=exif)
    image_set, out, numbers = ingest(photos)
    assert not image_set.skipped
    record = image_set.images[-1]
    assert (record.name, record.width, record.height) == ("z.jpg", *SIZE)
    assert record.focal_px == pytest.approx(28 / DIAGONAL_35MM * 120)
    assert numbers["with_focal"] == 1
    with Image.open(artifacts.Pictures(out).path(record.name)) as written:
        difference = np.abs(np.asarray(written, dtype=int) - np.asarray(upright, dtype=int))
    assert difference.mean() < 6


@pytest.mark.parametrize("kind", ["HEIF", "AVIF", "WEBP"])
def test_another_format_under_the_name_of_a_jpeg_is_encoded_anew(photos: Path, kind: str):
    register_formats()
    write_photos(photos, 2)
    picture(7).save(photos / "z.jpg", format=kind)
    image_set, out, _ = ingest(photos)
    assert image_set.images[-1].name == "z.jpg"
    with Image.open(artifacts.Pictures(out).path("z.jpg")) as written:
        assert written.format == "JPEG"


def test_sixteen_bits_a_channel_become_eight(photos: Path):
    import cv2

    write_photos(photos, 2)
    colours = np.asarray(picture(7))
    for name in ("deep.png", "deep.tif"):
        shade = colours[:, ::-1] if name == "deep.tif" else colours
        cv2.imwrite(str(photos / name), shade[:, :, ::-1].astype(np.uint16) * 257)
    image_set, out, _ = ingest(photos)
    assert not image_set.skipped
    for name in ("deep.png", "deep.tif"):
        source = next(record for record in image_set.images if record.source == name)
        with Image.open(artifacts.Pictures(out).path(source.name)) as written:
            assert written.mode == "RGB"
            shade = colours[:, ::-1] if name == "deep.tif" else colours
            assert np.abs(np.asarray(written, dtype=int) - shade).max() <= 1


def write_dng(path: Path, level: int, size: tuple[int, int] = (128, 96), orientation: int = 1) -> None:
    """A raw file of a grey wall: 16-bit RGGB samples of `level` of 65535, neutral white balance."""
    width, height = size
    pixels = np.full((height, width), level, dtype="<u2").tobytes()
    model, head = b"Test Camera\0", 8
    matrix = struct.pack("<18i", *(part for k in range(9) for part in (int(k % 4 == 0), 1)))
    neutral = struct.pack("<6I", 1, 1, 1, 1, 1, 1)
    extra = {271: model, 272: model, 50708: model, 50721: matrix, 50728: neutral}
    offsets, place = {}, head + len(pixels)
    for tag, data in extra.items():
        offsets[tag], place = place, place + len(data)
    text = lambda tag: (tag, 2, len(model), offsets[tag])  # noqa: E731
    entries = [
        (254, 4, 1, 0), (256, 4, 1, width), (257, 4, 1, height), (258, 3, 1, 16), (259, 3, 1, 1), (262, 3, 1, 32803),
        text(271), text(272), (273, 4, 1, head), (274, 3, 1, orientation), (277, 3, 1, 1), (278, 4, 1, height),
        (279, 4, 1, len(pixels)), (33421, 3, 2, 2 | 2 << 16), (33422, 1, 4, 0 | 1 << 8 | 1 << 16 | 2 << 24),
        (50706, 1, 4, 1 | 4 << 8), text(50708), (50714, 4, 1, 0), (50717, 4, 1, 65535),
        (50721, 10, 9, offsets[50721]), (50728, 5, 3, offsets[50728]),
    ]  # fmt: skip
    table = struct.pack("<H", len(entries)) + b"".join(struct.pack("<HHII", *entry) for entry in entries) + b"\0" * 4
    path.write_bytes(struct.pack("<2sHI", b"II", 42, place) + pixels + b"".join(extra.values()) + table)


def test_raw_files_are_developed_alike_and_upright(photos: Path):
    pytest.importorskip("rawpy")
    write_photos(photos, 2)
    write_dng(photos / "bright.dng", 16000)
    write_dng(photos / "dark.dng", 8000, orientation=6)
    picture(9).save(photos / "both.jpg")
    write_dng(photos / "both.dng", 9000)
    image_set, out, _ = ingest(photos)
    assert reasons(image_set) == {"both.dng": "the raw file of both.jpg"}
    records = {record.source: record for record in image_set.images}
    assert (records["dark.dng"].width, records["dark.dng"].height) == (96, 128)
    assert records["bright.dng"].camera.startswith("Test Camera")
    head = read_head(photos / "dark.dng", "dark.dng", 3200)  # undeveloped
    assert (head.width, head.height, head.camera) == (96, 128, records["dark.dng"].camera)
    means = [np.asarray(Image.open(artifacts.Pictures(out).path(f"{name}.png"))).mean() for name in ("bright", "dark")]
    assert means[0] / means[1] == pytest.approx(2 ** (1 / 2.222), rel=0.1)  # one stop apart: no automatic brightness


def test_raw_files_without_rawpy_are_left_out_with_the_package_to_install(photos: Path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rawpy", None)
    write_photos(photos, 3)
    write_dng(photos / "z.dng", 9000)
    assert "pip install 'hineus[raw]'" in reasons(ingest(photos)[0])["z.dng"]


def test_raw_files_that_are_no_good_are_told_by_name_and_jpegs_under_their_names_are_read(photos: Path, monkeypatch):
    class LibRawError(Exception):
        pass

    def imread(path: str):
        raise LibRawError(b"Input/output error")  # as rawpy words it

    monkeypatch.setitem(sys.modules, "rawpy", SimpleNamespace(imread=imread, LibRawError=LibRawError))
    write_photos(photos, 3)
    (photos / "000.jpg").rename(photos / "renamed.CR2")
    write_dng(photos / "cut.NEF", 9000)
    os.truncate(photos / "cut.NEF", 9000)
    (photos / "empty.ARW").touch()
    image_set, _, _ = ingest(photos)
    assert "renamed.CR2" in {record.source for record in image_set.images}
    found = reasons(image_set)
    assert found.keys() == {"cut.NEF", "empty.ARW"}
    assert "cut off, damaged" in found["cut.NEF"]
    assert "(Input/output error): copy it from the card once more" in found["cut.NEF"]
    assert "empty" in found["empty.ARW"]


def test_the_clip_of_a_live_photo_is_no_video(photos: Path):
    write_photos(photos, 3)
    (photos / "001.MOV").write_bytes(b"0")
    assert reasons(ingest(photos)[0]) == {"001.MOV": "the clip of the live photo 001.jpg"}


def test_names_stay_unique_when_suffixes_change(photos: Path):
    write_photos(photos, 2)
    picture(5).save(photos / "a.jpg")
    picture(6).save(photos / "a.webp")
    picture(7).save(photos / "a.png")
    image_set, _, _ = ingest(photos)
    names = {record.source: record.name for record in image_set.images}
    assert names["a.jpg"] == "a.jpg"
    assert names["a.png"] == "a.png"
    assert names["a.webp"] == "a.webp.jpg"


def test_large_photos_are_reduced_and_the_focal_prior_with_them(photos: Path):
    for i in range(3):
        picture(i, (400, 300)).save(photos / f"{i}.jpg", exif=exif_of(focal_35mm=50))
    image_set, _, _ = ingest(photos, max_side=100)
    record = image_set.images[0]
    assert (record.width, record.height) == (100, 75)
    assert record.focal_px == pytest.approx(50 / DIAGONAL_35MM * 125)


def available(monkeypatch: pytest.MonkeyPatch, megabytes: float) -> None:
    monkeypatch.setattr(psutil, "virtual_memory", lambda: SimpleNamespace(available=megabytes * 1e6, total=24e9))


@pytest.mark.slow
def test_a_photo_of_108_megapixels_is_reduced_while_it_is_decoded(photos: Path, monkeypatch, recwarn):
    write_photos(photos, 2)
    picture(7, (12000, 9000)).save(photos / "z.jpg", quality=30, exif=exif_of(focal_35mm=24))
    available(monkeypatch, 300)  # decoded whole it would take four times as much
    images, _, _ = ingest(photos)
    record = images.images[-1]
    assert (record.width, record.height) == (3200, 2400)
    assert record.focal_px == pytest.approx(24 / DIAGONAL_35MM * 4000)
    assert not [warning for warning in recwarn if "Decompression" in str(warning.category)]


def test_the_limit_is_the_memory_that_is_free(photos: Path, monkeypatch):
    write_photos(photos)
    Image.new("L", (10000, 8000)).save(photos / "z.png")  # 80 megapixels, and next to nothing as a file
    available(monkeypatch, 700)
    images, _, _ = ingest(photos)
    assert reasons(images)["z.png"] == "10000 x 8000 pixels take 1.2 GiB of memory to read, 0.7 are free"
    with pytest.raises(UnusableError, match=r"1\.2 GiB of memory"):
        read_head(photos / "z.png", "z.png", 3200)


def test_case_05(cases_dir: Path, tmp_path: Path):
    (tmp_path / "photos").symlink_to(cases_dir / "05-200mp" / "photos")
    images, _, _ = ingest(tmp_path / "photos")
    assert not images.skipped
    sizes = {record.source: (record.width, record.height) for record in images.images}
    assert sizes["A_200mp.jpg"] == (3200, 2400)


# ---------------------------------------------------------------- focal prior and cameras
def test_focal_prior_from_35mm_equivalent_is_by_the_diagonal(photos: Path):
    write_photos(photos, 2)
    picture(2, (120, 90)).save(photos / "z.jpg", exif=exif_of(focal_35mm=28))
    image_set, _, numbers = ingest(photos)
    assert image_set.images[0].focal_px is None
    assert image_set.images[-1].focal_px == pytest.approx(28 / DIAGONAL_35MM * 150)
    assert numbers["with_focal"] == 1


@pytest.mark.parametrize(("unit", "per_mm"), [(2, 25.4), (3, 10.0), (4, 1.0)])
def test_focal_prior_from_the_pixel_pitch(photos: Path, unit: int, per_mm: float):
    write_photos(photos, 2)
    # 20 pixels a mm on a sensor of 192 pixels, since halved to 96
    exif = exif_of(focal_mm=8.0, pitch=(20.0 * per_mm, unit), taken_width=192)
    picture(2).save(photos / "z.jpg", exif=exif)
    assert ingest(photos)[0].images[-1].focal_px == pytest.approx(8.0 * 20.0 / 2)


def test_contradicting_pixel_pitch_is_not_believed(photos: Path):
    write_photos(photos, 2)
    picture(2).save(photos / "z.jpg", exif=exif_of(focal_mm=8.0, focal_35mm=35, pitch=(25.4 * 500, 2)))
    assert ingest(photos)[0].images[-1].focal_px == pytest.approx(35 / DIAGONAL_35MM * 120)


def test_cameras_are_told_apart_by_model_focal_length_and_size(photos: Path):
    for i in range(2):
        picture(i).save(photos / f"a{i}.jpg", exif=exif_of(model="A", focal_mm=4.0))
    picture(2).save(photos / "b.jpg", exif=exif_of(model="B", focal_mm=4.0))
    picture(3).save(photos / "c.jpg", exif=exif_of(model="A", focal_mm=8.0))
    picture(4, (72, 96)).save(photos / "d.jpg", exif=exif_of(model="A", focal_mm=4.0))
    image_set, _, numbers = ingest(photos)
    cameras = [record.camera for record in image_set.images]
    assert cameras[0] == cameras[1]
    assert len(set(cameras)) == numbers["cameras"] == 4


def test_without_exif_each_folder_and_size_is_a_camera(photos: Path):
    for folder in ("left", "right"):
        (photos / folder).mkdir()
        for i in range(2):
            picture(i + 10 * len(folder)).save(photos / folder / f"{i}.jpg")
            picture(i + 10 * len(folder) + 5).save(photos / folder / f"a{i}.jpg", exif=exif_of(model="A", focal_mm=4))
    picture(99, (120, 90)).save(photos / "left" / "z.jpg")
    image_set, _, numbers = ingest(photos)
    cameras = {record.name: record.camera for record in image_set.images}
    assert cameras["left/0.jpg"] == cameras["left/1.jpg"] != cameras["right/0.jpg"] == cameras["right/1.jpg"]
    assert cameras["left/a0.jpg"] == cameras["right/a0.jpg"]  # one body and zoom, whatever the folder
    assert numbers["cameras"] == 4


def test_digital_zoom_is_another_camera(photos: Path):
    write_photos(photos, 2)
    for equivalent in (26, 52):
        picture(equivalent).save(photos / f"{equivalent}.jpg", exif=exif_of(None, 6.8, equivalent, model="Phone"))
    assert ingest(photos)[2]["cameras"] == 3


def test_blur_is_lower_for_the_blurred(photos: Path):
    write_photos(photos, 2)
    noise = Image.fromarray(np.random.default_rng(0).integers(0, 256, (72, 96, 3), dtype=np.uint8))
    noise.save(photos / "sharp.png")
    noise.resize((24, 18)).resize(SIZE).save(photos / "soft.png")
    blur = {record.name: record.blur for record in ingest(photos)[0].images}
    assert blur["soft.png"] < 0.2 * blur["sharp.png"]


# ---------------------------------------------------------------- left out, not fatal
def test_unusable_files_are_named_and_counted(photos: Path):
    names = write_photos(photos, 4)
    whole = (photos / names[0]).read_bytes()
    (photos / "cut.jpg").write_bytes(whole[: len(whole) // 2])
    (photos / "text.jpg").write_text("not a picture")
    (photos / "notes.txt").write_text("lens: 50 mm")
    (photos / "clip.mp4").write_bytes(b"0")
    (photos / "twin.jpg").write_bytes(whole)
    picture(0, (32, 32)).save(photos / "icon.png")
    (photos / ".DS_Store").write_bytes(b"0")
    image_set, _, numbers = ingest(photos)
    why = reasons(image_set)
    assert [record.name for record in image_set.images] == names
    assert len(why) == 6
    assert (numbers["skipped"], numbers["companions"]) == (5, 1)
    assert "truncated" in why["cut.jpg"]
    assert why["text.jpg"].startswith("no image, whatever its name says")
    assert why["notes.txt"] == "not an image (.txt)"
    assert "video" in why["clip.mp4"]
    assert why["twin.jpg"] == "same file as 000.jpg"
    assert why["icon.png"] == "only 32 x 32 pixels"


# ---------------------------------------------------------------- sentences
def test_missing_folder(tmp_path: Path):
    (tmp_path / "x").mkdir()
    with pytest.raises(InputError, match=r"The photo folder .*nowhere does not exist\."):
        ingest(tmp_path / "x" / "nowhere")


def test_a_file_instead_of_a_folder(photos: Path):
    name = write_photos(photos, 1)[0]
    shutil.move(photos / name, photos.parent / name)
    with pytest.raises(InputError, match="is a file; a folder of photos or a video is needed"):
        ingest(photos.parent / name)


def test_empty_folder(photos: Path):
    with pytest.raises(InputError, match=r"is empty: found 0 photos, need at least 3\."):
        ingest(photos)


def test_folder_of_text_files(photos: Path):
    for i in range(5):
        (photos / f"{i}.txt").write_text(str(i))
    with pytest.raises(InputError) as caught:
        ingest(photos)
    assert "Found 0 usable photos" in caught.value.message
    assert "need at least 3" in caught.value.message
    assert "5 files left out: 5 x not an image (.txt), e.g. 0.txt" in caught.value.message
    assert caught.value.hint


def test_two_photos(photos: Path):
    write_photos(photos, 2)
    with pytest.raises(InputError, match=r"Found 2 usable photos in .*, need at least 3\."):
        ingest(photos)


# ---------------------------------------------------------------- masks
def half_mask(size: tuple[int, int] = SIZE, value: int = 255) -> np.ndarray:
    mask = np.zeros(size[::-1], dtype=np.uint8)
    mask[: size[1] // 2] = value
    return mask


def write_masks(folder: Path, names: list[str], pattern: str = "{stem}.png", value: int = 255) -> Path:
    folder.mkdir()
    for name in names:
        target = folder / pattern.format(stem=Path(name).stem, name=name)
        Image.fromarray(half_mask(value=value)).save(target)
    return folder


@pytest.mark.parametrize("pattern", ["{stem}.png", "{name}.png", "{stem}_mask.png", "{stem}.bmp"])
@pytest.mark.parametrize("value", [255, 1])
def test_masks_are_found_by_name(photos: Path, pattern: str, value: int):
    names = write_photos(photos, 3)
    masks = write_masks(photos.parent / "masks", names, pattern, value)
    image_set, out, numbers = ingest(photos, masks)
    assert numbers["masks"] == 3
    assert all(record.has_mask for record in image_set.images)
    written = np.asarray(Image.open(artifacts.Pictures(out).mask_path(names[0])))
    np.testing.assert_array_equal(written, half_mask())


def test_mask_folder_inside_the_photo_folder_is_not_taken_for_photos(photos: Path):
    names = write_photos(photos, 3)
    masks = write_masks(photos / "masks", names)
    image_set, _, _ = ingest(photos, masks)
    assert [record.name for record in image_set.images] == names


def test_mask_is_reduced_and_turned_with_its_photo(photos: Path):
    write_photos(photos, 2)
    picture(2).save(photos / "z.jpg", exif=exif_of(orientation=6))
    masks = write_masks(photos.parent / "masks", ["000.jpg", "001.jpg", "z.jpg"])  # drawn on the stored pixels
    image_set, out, _ = ingest(photos, masks, max_side=72)
    assert (image_set.images[-1].width, image_set.images[-1].height) == (54, 72)
    written = np.asarray(Image.open(artifacts.Pictures(out).mask_path("z.jpg")))
    assert written.shape == (72, 54)
    assert written[:, -20:].min() == 255  # the stored top is the upright right
    assert written[:, :20].max() == 0


def test_alpha_channel_is_the_mask(photos: Path):
    for i in range(3):
        image = picture(i)
        image.putalpha(Image.fromarray(half_mask()))
        image.save(photos / f"{i}.png")
    opaque = picture(3)
    opaque.putalpha(255)
    opaque.save(photos / "opaque.png")
    image_set, out, numbers = ingest(photos)
    assert numbers["masks"] == 3
    assert [record.has_mask for record in image_set.images] == [True, True, True, False]
    np.testing.assert_array_equal(np.asarray(Image.open(artifacts.Pictures(out).mask_path("0.png"))), half_mask())
    assert Image.open(artifacts.Pictures(out).path("0.png")).mode == "RGB"


def test_missing_masks(photos: Path):
    names = write_photos(photos, 5)
    masks = write_masks(photos.parent / "masks", names[:3])
    with pytest.raises(InputError, match=r"2 of 5 photos have no mask in .*: 003\.jpg, 004\.jpg\.") as caught:
        ingest(photos, masks)
    assert "--no-masks" in caught.value.hint


def test_mask_of_the_wrong_size(photos: Path):
    names = write_photos(photos, 3)
    masks = write_masks(photos.parent / "masks", names)
    Image.fromarray(half_mask((50, 40))).save(masks / "001.png")
    with pytest.raises(InputError, match=r"mask 001\.png is 50 x 40 pixels, .*001\.jpg is 96 x 72"):
        ingest(photos, masks)


def test_unreadable_mask_and_missing_mask_folder(photos: Path):
    names = write_photos(photos, 3)
    masks = write_masks(photos.parent / "masks", names)
    (masks / "001.png").write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"The mask .*001\.png cannot be read"):
        ingest(photos, masks)
    with pytest.raises(InputError, match=r"mask folder .* does not exist"):
        ingest(photos, photos / "none")


def test_photo_with_an_empty_mask_is_left_out(photos: Path):
    names = write_photos(photos, 4)
    masks = write_masks(photos.parent / "masks", names)
    Image.fromarray(np.zeros(SIZE[::-1], np.uint8)).save(masks / "002.png")
    image_set, _, _ = ingest(photos, masks)
    assert reasons(image_set) == {"002.jpg": "its mask is empty (002.png)"}


@pytest.mark.data
@pytest.mark.parametrize(("name", "count", "with_focal"), [("banana", 16, 16), ("viking", 49, 0)])
def test_real_photos_are_kept_with_the_focal_length_their_exif_gives(tmp_path, data_dir, name, count, with_focal):
    out = tmp_path / "out"
    out.mkdir()
    context = StageContext({}, {"photos": data_dir / name / "images"}, out, tmp_path, IngestParams())
    numbers = INGEST.run(context)
    assert (numbers["images"], numbers["skipped"], numbers["with_focal"]) == (count, 0, with_focal)


# ---------------------------------------------------------------- GPS
def gps_exif(ref: str = "NE", altitude: float | None = 408.5, below_sea: bool = False) -> Image.Exif:
    exif = Image.Exif()
    exif[0x0110] = "Drone"  # without any tag of its own, Pillow writes none to PNG
    tags = exif.get_ifd(0x8825)
    tags[1], tags[2] = ref[0], (47.0, 22.0, 36.84)
    tags[3], tags[4] = ref[1], (8.0, 32.0, 30.12)
    if altitude is not None:
        tags[5], tags[6] = b"\x01" if below_sea else b"\x00", altitude
    return exif


@pytest.mark.parametrize("suffix", [".jpg", ".png", ".webp"])
def test_gps_positions_are_read(photos: Path, suffix: str):
    write_photos(photos)
    picture(7).save(photos / f"z{suffix}", exif=gps_exif())
    picture(8).save(photos / f"y{suffix}", exif=gps_exif("SW", below_sea=True))
    picture(9).save(photos / f"x{suffix}", exif=gps_exif(altitude=None))
    images, _, numbers = ingest(photos)
    gps = {Path(record.source).stem: record.gps for record in images.images}
    assert gps["z"] == pytest.approx((47.3769, 8.5417, 408.5), abs=1e-6)
    assert gps["y"] == pytest.approx((-47.3769, -8.5417, -408.5), abs=1e-6)
    assert gps["x"] is None
    assert gps["000"] is None
    assert numbers["with_gps"] == 2
