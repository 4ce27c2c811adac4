"""Users' folders and files: what is walked, what is set aside, what a file is by content, how it is called."""

from __future__ import annotations

import io
import json
import os
import shutil
import struct
import tracemalloc
import unicodedata
import zlib
from contextlib import nullcontext, suppress
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_ingest import ingest, picture, reasons, write_photos
from typer.testing import CliRunner

from hineus_cli.app import app
from stages.artifacts import Pictures
from stages.capture import photo_reading
from stages.capture.listing import list_captures
from stages.capture.masks import load_mask, unused_folder
from stages.capture.photo_reading import UnusableError, read_head, read_photo, read_preview
from stages.capture.video import extract_frames
from stages.engine.fingerprint import SourceDigests
from stages.errors import InputError, WorkspaceError
from stages.inputs.bounded import read_bytes, reason
from stages.inputs.depth import read_depth
from stages.inputs.folders import MOST_BYTES, MOST_DEPTH, named_files, readable, short_name, unique_name
from stages.inputs.formats import Kind, kind_of, kind_of_head, open_image, register_formats
from stages.inputs.texts import read_json, read_text
from stages.posing.learned import corners_of


@pytest.fixture
def photos(tmp_path: Path) -> Path:
    folder = tmp_path / "photos"
    folder.mkdir()
    return folder


# ---------------------------------------------------------------- names
def test_every_spelling_of_a_name_is_read_alike():
    decomposed = unicodedata.normalize("NFD", "Käse.jpg")
    latin = os.fsdecode("Käse.jpg".encode("latin-1"))
    assert decomposed != "Käse.jpg" != latin
    assert readable(decomposed) == readable(latin) == readable("Käse.jpg") == "Käse.jpg"
    assert readable("a\nb\x1b[0m\tc.jpg") == "a_b_[0m_c.jpg"
    assert readable("Bild 1, \"x\" 'y' <b>\\.jpg") == "Bild 1, \"x\" 'y' <b>\\.jpg"


def test_long_names_are_cut_alike_whatever_their_suffix():
    long = "ü" * 125
    cut = short_name(f"a/{long}.jpg")
    assert len(cut.encode()) <= 2 + MOST_BYTES + 4
    assert cut.endswith(".jpg")
    assert cut.removesuffix(".jpg") == short_name(f"a/{long}.png").removesuffix(".png") == short_name(f"a/{long}")
    assert cut != short_name(f"a/{long[:-1]}e.jpg")
    assert short_name("a/b.jpg") == "a/b.jpg"


def test_unique_names():
    assert unique_name("a/b.jpg", {"a/b.jpg", "a/b~2.jpg"}) == "a/b~3.jpg"
    assert unique_name("B.jpg", {"b.jpg"}, str.lower) == "B~2.jpg"


ODD = ["-x.jpg", "a  b.jpg", " lead.jpg", "back\\slash.jpg", "comma, \"'.jpg", "new\nline.jpg", "%03d.jpg", "<b>&.jpg"]


@pytest.mark.parametrize("last", [b"f\xfcr.jpg", b"a" * 251 + b".jpg", "ü".encode() * 125 + b".jpg"])
def test_photos_of_any_name_are_taken(photos: Path, last: bytes):
    for i, name in enumerate([*ODD, os.fsdecode(last)]):
        picture(i).save(photos / name)
    images, out, numbers = ingest(photos)
    assert numbers["images"] == len(ODD) + 1
    assert all(record.name == short_name(record.source) for record in images.images)
    for record in images.images:
        assert record.name.encode().isascii() or record.name == readable(record.name)
        assert Pictures(out).path(record.name).is_file()


def test_long_names_leave_room_for_masks(photos: Path):
    names = write_photos(photos, 2)
    cut_out = picture(5)
    cut_out.putalpha(Image.fromarray((np.arange(96 * 72).reshape(72, 96) % 2 * 255).astype(np.uint8)))
    cut_out.save(photos / ("b" * 251 + ".png"))
    images, out, _ = ingest(photos)
    assert len(images.images) == len(names) + 1
    assert Pictures(out).mask(next(record.name for record in images.images if record.has_mask)) is not None


def test_names_that_differ_by_case_or_by_encoding_only_stay_apart(photos: Path):
    decomposed = unicodedata.normalize("NFD", "ä.jpg")
    for i, name in enumerate(["a.jpg", "A.JPG", "ä.jpg", decomposed, os.fsdecode(b"\xe4.jpg")]):
        picture(i).save(photos / name)
    if len(list(photos.iterdir())) < 5:
        pytest.skip("this file system takes some of these names for one")
    images, _, numbers = ingest(photos)
    names = [record.name.lower() for record in images.images]
    assert numbers["images"] == len(set(names)) == 5
    assert {"a.jpg", "A.JPG", "ä.jpg"} < {record.source for record in images.images}


def test_masks_are_found_whatever_the_encoding_of_their_names(photos: Path):
    masks = photos.parent / "masks"
    masks.mkdir()
    for i, name in enumerate(["ä", "ö", "ü"]):
        picture(i).save(photos / f"{unicodedata.normalize('NFD', name)}.jpg")
        mask = Image.new("L", (96, 72), 255)
        mask.paste(0, (0, 0, 48, 72))
        mask.save(masks / (f"{name}.png" if i else os.fsdecode(f"{name}.png".encode("latin-1"))))
    assert ingest(photos, masks)[2]["masks"] == 3


# ---------------------------------------------------------------- folders
def leave_companions(photos: Path) -> set[str]:
    """What cameras, NAS boxes and programs leave, with a picture in each place; returns where."""
    folders = ["@eaDir/a.jpg", ".thumbnails", "#recycle", "@Recycle", "__MACOSX", "X Previews.lrdata", "M4ROOT/THMBNL"]
    folders += ["M4ROOT/SUB", ".picasaoriginals", "$RECYCLE.BIN", "CaptureOne"]
    for i, folder in enumerate(folders):
        (photos / folder).mkdir(parents=True)
        picture(100 + i).save(photos / folder / "p.jpg")
    files = ["a.THM", "a.jpg_original", "a.jpg~", "a.bak", "a.xmp", "a.AAE", "Thumbs.db", "digikam4.db", "GL01.LRV"]
    for i, name in enumerate(files):
        picture(200 + i).save(photos / name, format="JPEG")
    for hidden in (".DS_Store", "._000.jpg"):
        (photos / hidden).write_bytes(b"0")
    return {*(folder.removesuffix("/a.jpg") for folder in folders), *files}


def test_what_programs_leave_beside_photos_is_set_aside(photos: Path):
    names = write_photos(photos)
    left = leave_companions(photos)
    images, _, numbers = ingest(photos)
    assert [record.source for record in images.images] == names
    assert reasons(images).keys() == left
    assert all(item.expected for item in images.skipped)
    assert numbers["skipped"] == 0
    assert numbers["companions"] == len(left)


def test_what_programs_leave_is_no_reason_to_run_again(photos: Path):
    write_photos(photos)
    before = SourceDigests({"photos": photos}).files("photos")
    leave_companions(photos)
    assert SourceDigests({"photos": photos}).files("photos") == before


def test_links_are_followed_once_and_never_in_a_circle(photos: Path, tmp_path: Path):
    names = write_photos(photos)
    (tmp_path / "other").mkdir()
    write_photos(tmp_path / "other", 2, first=10)
    (photos / "linked").symlink_to(tmp_path / "other")
    (photos / "twice").symlink_to(tmp_path / "other")
    (tmp_path / "other" / "back").symlink_to(photos)
    (photos / "loop").symlink_to(photos)
    (photos / "x.jpg").symlink_to(tmp_path / "other" / "011.jpg")
    (photos / "gone.jpg").symlink_to(tmp_path / "nowhere")
    images, _, _ = ingest(photos)
    assert [record.source for record in images.images] == [*names, "linked/010.jpg", "linked/011.jpg"]
    why = reasons(images)
    assert why["x.jpg"] == "same file as linked/011.jpg"
    assert why["gone.jpg"] == "a link to nothing"
    assert why["loop"] == "a link to a folder that this one is in"


def test_the_folder_itself_may_be_a_link(photos: Path):
    names = write_photos(photos)
    link = photos.parent / "link"
    link.symlink_to(photos)
    assert [record.source for record in ingest(link)[0].images] == names


def test_a_pipe_does_not_hold_anything_up(photos: Path):
    write_photos(photos)
    os.mkfifo(photos / "p.jpg")
    assert "pipe" in reasons(ingest(photos)[0])["p.jpg"]
    assert "p.jpg" not in SourceDigests({"photos": photos}).files("photos")


@pytest.mark.parametrize("read", [open_image, kind_of, lambda file: SourceDigests({"photos": file}).files("photos"),
                                  lambda file: list_captures(file), lambda file: read_depth(file)])  # fmt: skip
@pytest.mark.parametrize("target", ["pipe", "/dev/zero", "/dev/random", "nowhere"])
def test_what_is_no_file_is_not_waited_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, read, target: str):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("pipe")
    Path("x.mp4").symlink_to(target)
    with pytest.raises((OSError, ValueError, InputError)):
        read(Path("x.mp4"))


@pytest.mark.parametrize("given", ["loop", "a" * 300, "pipe", "pipe.mp4", "zero", "p --masks loop", "p --masks zero",
                                   "p --masks pipe", f"p --masks {'a' * 300}"])  # fmt: skip
def test_paths_that_lead_nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str):
    monkeypatch.chdir(tmp_path)
    Path("loop").symlink_to("loop")
    Path("zero").symlink_to("/dev/zero")
    Path("p").mkdir()
    for name in ("pipe", "pipe.mp4"):
        os.mkfifo(name)
    result = CliRunner().invoke(app, ["run", *given.split(), "--until", "ingest"])
    assert result.exit_code == InputError.exit_code
    assert "Unexpected" not in result.output


def test_folders_are_looked_into_as_deep_as_people_go(photos: Path):
    write_photos(photos)
    for i, (name, depth) in enumerate((("a", MOST_DEPTH), ("b", MOST_DEPTH + 1), ("c", 200))):
        folder = photos / Path(*name * depth)
        folder.mkdir(parents=True)
        picture(8 + i).save(folder / "x.jpg")
    images, _, _ = ingest(photos)
    assert len(images.images) == 5
    assert list(reasons(images).values()) == [f"more than {MOST_DEPTH} folders deep"] * 2


def test_a_file_that_is_all_hole_is_not_read_to_its_end(photos: Path):
    names = write_photos(photos)
    for name in ("x.jpg", "x.bin", "x.mp4"):
        shutil.copy(photos / names[0], photos / name)
        os.truncate(photos / name, 1 << 40)
    assert all("next to none" in reason for reason in reasons(ingest(photos)[0]).values())
    assert SourceDigests({"photos": photos}).files("photos").keys() == set(names)
    with pytest.raises(InputError, match="next to none"):
        SourceDigests({"photos": photos / "x.mp4"}).files("photos")


def test_what_is_missing_is_said_aloud(photos: Path):
    write_photos(photos)
    for name in (".IMG_9.heic.icloud", "IMG_8.jpg.part", "IMG_7.jpg.crdownload"):
        (photos / name).write_bytes(b"0")
    images, _, numbers = ingest(photos)
    assert reasons(images)[".IMG_9.heic.icloud"] == "only in iCloud: download it first"
    assert numbers["skipped"] == 3


def test_folders_of_a_card_with_the_same_names(photos: Path):
    for i, folder in enumerate(("DCIM/100CANON", "DCIM/101CANON")):
        (photos / folder).mkdir(parents=True)
        for k in range(2):
            picture(10 * i + k).save(photos / folder / f"IMG_000{k}.JPG")
    images, _, _ = ingest(photos)
    assert [record.name for record in images.images] == [record.source for record in images.images]
    assert len(images.images) == 4


@pytest.mark.parametrize(("original", "copy"), [
    ("IMG_1234.JPG", "IMG_E1234.JPG"), ("IMG_1.jpg", "IMG_1-edited.jpg"), ("a/b.jpg", "a/b_edited(1).jpg"),
    ("IMG_2.JPG", "IMG_2.HIF"), ("P.PORTRAIT-02.ORIGINAL.jpg", "P.PORTRAIT-01.COVER.jpg"),
])  # fmt: skip
def test_a_second_picture_of_a_shot_is_set_aside(photos: Path, original: str, copy: str):
    register_formats()
    write_photos(photos)
    for i, name in enumerate((original, copy)):
        (photos / name).parent.mkdir(exist_ok=True)
        picture(50 + i).save(photos / name, format="HEIF" if name.endswith("HIF") else "JPEG")
    images, _, numbers = ingest(photos)
    assert original in reasons(images)[copy]
    assert numbers["skipped"] == 0
    (photos / original).unlink()
    assert copy in {record.source for record in ingest(photos)[0].images}


# ---------------------------------------------------------------- formats
FORMATS = {"JPEG": "jpg", "PNG": "png", "TIFF": "tif", "BMP": "bmp", "WEBP": "webp", "HEIF": "heic", "AVIF": "avif"}


@pytest.mark.parametrize("name", [
    "a.HIF", "a.heics", "a.jfif", "a.JPE", "a.jpeg", "a", "a.0001", "a.dat", "a.txt", "a.mp4", "a.jpg", "a.png",
])  # fmt: skip
@pytest.mark.parametrize("kind", FORMATS)
def test_photos_are_told_by_their_content(photos: Path, name: str, kind: str):
    register_formats()
    write_photos(photos, 2)
    picture(7).save(photos / name, format=kind)
    assert kind_of(photos / name) is Kind.PHOTO
    images, out, _ = ingest(photos)
    assert not images.skipped
    record = images.images[-1]
    assert record.name.startswith("a.0001" if name == "a.0001" else "a")
    with Image.open(Pictures(out).path(record.name)) as written:
        assert (
            written.format
            == {"jpg": "JPEG", "jpeg": "JPEG", "png": "PNG", "tif": "TIFF", "bmp": "BMP"}[
                Path(record.name).suffix.lower()[1:]
            ]
        )
        assert np.abs(np.asarray(written, int) - np.asarray(picture(7), int)).mean() < 6


@pytest.mark.parametrize(
    ("name", "target"), [("a.jfif", "a.jpg"), ("a.jpe", "a.jpg"), ("a", "a.jpg"), ("a.tif", "a.jpg")]
)
def test_a_jpeg_under_another_name_is_copied_not_encoded_anew(photos: Path, name: str, target: str):
    write_photos(photos, 2)
    picture(7).save(photos / name, format="JPEG")
    images, out, _ = ingest(photos)
    assert images.images[-1].name == target
    assert Pictures(out).path(target).read_bytes() == (photos / name).read_bytes()


def test_the_first_picture_of_a_stereo_pair_counts(photos: Path):
    write_photos(photos, 2)
    picture(7).save(photos / "z.MPO", format="MPO", save_all=True, append_images=[picture(8)])
    images, out, _ = ingest(photos)
    assert images.images[-1].name == "z.jpg"
    with Image.open(Pictures(out).path("z.jpg")) as written:
        assert np.abs(np.asarray(written, int) - np.asarray(picture(7), int)).mean() < 6


def test_nothing_but_photo_formats_is_opened(photos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Pillow starts Ghostscript for PostScript, whatever the file is called."""
    program = tmp_path / "gs"
    program.write_text(f"#!/bin/sh\ntouch {tmp_path}/started\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    write_photos(photos)
    (photos / "x.jpg").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 96 72\n%%EndComments\nshowpage\n")
    assert "PostScript" in reasons(ingest(photos)[0])["x.jpg"]
    with pytest.raises(OSError, match="cannot identify"):
        corners_of(photos / "x.jpg", None, None)  # type: ignore[arg-type]
    assert not (tmp_path / "started").exists()


def test_pictures_are_opened_in_one_place():
    sources = [file for top in ("stages", "hineus_cli") for file in (Path(__file__).parents[1] / top).rglob("*.py")]
    assert [file.name for file in sources if "Image.open(" in file.read_text(encoding="utf-8")] == ["formats.py"]


@pytest.mark.parametrize(("data", "words"), [
    (b"", "(empty)"), (b"version https://git-lfs.github.com/spec/v1\n", "git lfs pull"), (b"GIF89a", "a GIF"),
    (b"\xff\x0a\0\0", "JPEG XL image, which is not read: convert it"), (b"8BPS\0\1", "Photoshop document"),
    (b"<!DOCTYPE html>", "a web page"), (b"\0" * 4000, "damaged, or another format"),
])  # fmt: skip
def test_what_else_is_found_under_the_name_of_a_photo_is_named(photos: Path, data: bytes, words: str):
    write_photos(photos)
    (photos / "x.jpg").write_bytes(data)
    images, _, numbers = ingest(photos)
    assert words in reasons(images)["x.jpg"]
    assert numbers["skipped"] == 1


@pytest.mark.parametrize(("head", "suffix", "kind"), [
    (b"II*\0\x08\0\0\0", ".nef", Kind.RAW), (b"II*\0\x08\0\0\0", ".tif", Kind.PHOTO),
    (b"II*\0\x10\0\0\0CR\2\0", ".jpg", Kind.RAW), (b"FUJIFILMCCD-RAW ", ".jpg", Kind.RAW),
    (b"\0\0\0\x18ftypcrx ", ".cr3", Kind.RAW), (b"\0\0\0\x18ftypqt  ", ".jpg", Kind.VIDEO),
    (b"\0\0\0\x18ftypmif1", ".jpg", Kind.PHOTO), (b"\0\0\0\x18ftypM4A ", ".m4a", Kind.OTHER),
    (b"\0\0\0\x08wide\0\0\0\0mdat", ".mov", Kind.VIDEO), (b"\x1aE\xdf\xa3", "", Kind.VIDEO),
    ((b"G" + bytes(187)) * 3, ".mts", Kind.VIDEO), (b"RIFF\0\0\0\0AVI ", ".dat", Kind.VIDEO),
    (b"BMW is a car", ".txt", Kind.OTHER), (b"RIFF\0\0\0\0WAVE", ".wav", Kind.OTHER),
])  # fmt: skip
def test_kinds(head: bytes, suffix: str, kind: Kind):
    assert kind_of_head(head, suffix) is kind


def test_an_unstitched_picture_is_named(photos: Path):
    write_photos(photos)
    picture(9).save(photos / "IMG_1.insp", format="JPEG")
    assert "two fisheye lenses: stitch" in reasons(ingest(photos)[0])["IMG_1.insp"]


def test_a_copy_that_was_cut_off_is_named_where_its_end_is_zeros(photos: Path):
    write_photos(photos)
    whole = (photos / "000.jpg").read_bytes()
    (photos / "x.jpg").write_bytes(whole[: len(whole) // 2] + bytes(len(whole)))
    assert reasons(ingest(photos)[0])["x.jpg"] == "half-copied: its end is zeros"


def test_damaged_exif_is_no_reason_to_lose_a_photo(photos: Path):
    write_photos(photos)
    picture(9).save(photos / "x.jpg", exif=b"Exif\0\0II*\0\xff\xff\xff\x7f" + b"\xff" * 40)
    assert "x.jpg" in {record.source for record in ingest(photos)[0].images}


# ---------------------------------------------------------------- claims are held against the bytes that are there
def tags(count: int, size: int) -> bytes:
    """A TIFF of a grey picture, with further tags that all stand for the same bytes: `count` times `size` in all."""
    width, height = 96, 72
    known = {256: width, 257: height, 258: 8, 259: 1, 262: 1, 273: 8, 277: 1, 278: height, 279: width * height}
    entries = [struct.pack("<HHLL", tag, 4, 1, value) for tag, value in known.items()]
    entries += [struct.pack("<HHLL", 1000 + i, 7, size, 8) for i in range(count)]
    pixels = bytes(max(size, width * height))
    return b"".join([b"II*\0", struct.pack("<L", 8 + len(pixels)), pixels, struct.pack("<H", len(entries)), *entries])


def chunk(kind: bytes, data: bytes, length: int | None = None) -> bytes:
    """Of a PNG; it claims to be `length` bytes long."""
    stated = struct.pack(">L", len(data) if length is None else length)
    return stated + kind + data + struct.pack(">L", zlib.crc32(kind + data))


def encoded(image: Image.Image, kind: str, **options: object) -> bytes:
    stream = io.BytesIO()
    image.save(stream, kind, **options)
    return stream.getvalue()


def half() -> Image.Image:
    """Black and white, as a mask is."""
    return Image.fromarray(np.repeat(np.repeat(np.array([[0, 255]], np.uint8), 72, 0), 48, 1))


def crowded(kind: str) -> bytes:
    """A picture of 140 kB or less with tags of 200 MB."""
    exif = tags(2000, 100_000)
    if kind == "tif":
        return exif
    whole = encoded(half(), {"jpg": "JPEG", "png": "PNG"}[kind])
    if kind == "png":
        return whole[:33] + chunk(b"eXIf", exif) + whole[33:]
    parts = [b"Exif\0\0" + exif[at : at + 60_000] for at in range(0, len(exif), 60_000)]
    return whole[:2] + b"".join(b"\xff\xe1" + struct.pack(">H", 2 + len(part)) + part for part in parts) + whole[2:]


def test_a_camera_with_an_endless_name(photos: Path):
    write_photos(photos)
    exif = Image.Exif()
    exif[0x0110] = "x" * 50_000
    picture(9).save(photos / "x.jpg", exif=exif)
    images, _, _ = ingest(photos)
    assert len(images.images) == 5
    assert max(len(record.camera) for record in images.images) < 200


def test_a_damaged_picture_of_a_workspace_is_not_given_to_opencv(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    import cv2

    (tmp_path / "images").mkdir()
    whole = encoded(half(), "PNG")
    (tmp_path / "images" / "x.png").write_bytes(whole)
    assert Pictures(tmp_path).image("x.png").shape == (72, 96, 3)
    at = whole.index(b"IDAT") - 4
    (tmp_path / "images" / "x.png").write_bytes(whole[:at] + struct.pack(">L", 0x7FFFFFFF) + whole[at + 4 :])
    monkeypatch.setattr(cv2, "imread", lambda *arguments: pytest.fail("read"))
    with pytest.raises(WorkspaceError, match=r"x\.png cannot be read"):
        Pictures(tmp_path).image("x.png")


@pytest.mark.parametrize("kind", ["tif", "jpg", "png"])
def test_tags_of_more_bytes_than_the_file_has_take_no_memory(tmp_path: Path, kind: str):
    file, size = tmp_path / f"x.{kind}", (96, 72)
    file.write_bytes(crowded(kind))
    tracemalloc.start()
    for read in (lambda: read_head(file, "x", 1000), lambda: read_preview(file), lambda: read_photo(file, 1000),
                 lambda: load_mask(file, "x", size, size, 1)):  # fmt: skip
        with suppress(UnusableError, InputError) if kind == "tif" else nullcontext():  # of others EXIF alone is lost
            read()
    assert tracemalloc.get_traced_memory()[1] < 20e6
    tracemalloc.stop()


@pytest.mark.parametrize("progressive", [False, True])
def test_a_jpeg_of_next_to_no_bytes_is_cut_off(photos: Path, progressive: bool):
    write_photos(photos)
    data = bytearray(encoded(picture(0), "JPEG", progressive=progressive))
    at = data.index(b"\xff\xc2" if progressive else b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", 65500, 65500)
    (photos / "x.jpg").write_bytes(data)
    assert "too few for 65500 x 65500 pixels" in reasons(ingest(photos)[0])["x.jpg"]


def test_pictures_made_to_fill_the_memory_are_refused_however_much_is_free(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(photo_reading, "available_memory", lambda: 1 << 50)
    blank = chunk(b"IHDR", struct.pack(">LLBBBBB", 60_000, 60_000, 1, 0, 0, 0, 0)) + chunk(b"IDAT", b"")
    (tmp_path / "x.png").write_bytes(b"\x89PNG\r\n\x1a\n" + blank + chunk(b"IEND", b""))
    for read in (lambda file: read_head(file, "x", 1000), read_preview, lambda file: read_photo(file, 1000)):
        with pytest.raises(UnusableError, match="60000 x 60000 pixels, which its 57 bytes cannot be"):
            read(tmp_path / "x.png")
    with pytest.raises(InputError, match="60000 x 60000 pixels"):
        load_mask(tmp_path / "x.png", "photo", (160, 120), (160, 120), 1)


@pytest.mark.parametrize("size", [(16, 60_000), (60_000, 16), (1, 20_000), (20_000, 1)])
def test_strips_are_no_photos(photos: Path, size: tuple[int, int]):
    write_photos(photos)
    Image.new("RGB", size).save(photos / "x.png")
    assert reasons(ingest(photos)[0])["x.png"] == f"only {size[0]} x {size[1]} pixels"


def test_pages_of_a_tiff_are_not_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """There may be a hundred thousand, and Pillow looks through all of them for each."""
    from PIL.TiffImagePlugin import TiffImageFile

    def count(image: TiffImageFile) -> int:
        raise AssertionError("counted")

    picture(0).save(tmp_path / "x.tif", save_all=True, append_images=[picture(1)])
    monkeypatch.setattr(TiffImageFile, "n_frames", property(count))
    assert read_photo(tmp_path / "x.tif", 1000).as_is == ()


def test_a_png_whose_end_lies_is_encoded_anew(photos: Path):
    """OpenCV would take 4 GB for it."""
    write_photos(photos)
    whole = encoded(picture(9), "PNG")
    (photos / "x.png").write_bytes(whole[:-12] + chunk(b"tEXt", b"a", 0x7FFFFFFF))
    images, out, _ = ingest(photos)
    written = Pictures(out).path(images.images[-1].name)
    assert images.images[-1].source == "x.png"
    assert written.read_bytes() != (photos / "x.png").read_bytes()
    assert (np.asarray(Image.open(written)) == np.asarray(picture(9))).all()


def test_a_tiff_that_others_cannot_read_is_encoded_anew(photos: Path):
    write_photos(photos)
    data = bytearray(encoded(picture(9), "TIFF"))
    directory = struct.unpack_from("<L", data, 4)[0]
    tags_of = [struct.unpack_from("<H", data, directory + 2 + 12 * i)[0] for i in range(data[directory])]
    at = directory + 2 + 12 * tags_of.index(278)  # rows of a strip
    data[at + 4 : at + 8] = struct.pack("<L", 0)
    (photos / "x.tif").write_bytes(data)
    images, out, _ = ingest(photos)
    assert images.images[-1].source == "x.tif"
    assert Pictures(out).image(images.images[-1].name).shape == (72, 96, 3)


def test_depth_whose_chunks_lie_is_not_given_to_opencv(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    import cv2

    whole = encoded(Image.fromarray(np.full((72, 96), 20_000, np.uint16)), "PNG")
    (tmp_path / "x-depth.png").write_bytes(whole)
    assert read_depth(tmp_path / "x-depth.png").shape == (72, 96)
    at = whole.index(b"IDAT") - 4
    (tmp_path / "x-depth.png").write_bytes(whole[:at] + struct.pack(">L", 0x7FFFFFFF) + whole[at + 4 :])
    monkeypatch.setattr(cv2, "imdecode", lambda *arguments: pytest.fail("read"))
    with pytest.raises(ValueError, match="no 16-bit depth image"):
        read_depth(tmp_path / "x-depth.png")


def test_a_picture_for_which_a_decoder_finds_no_memory_is_left_out(photos: Path, monkeypatch: pytest.MonkeyPatch):
    def refuse(image: Image.Image) -> None:
        raise MemoryError

    write_photos(photos)
    picture(9).save(photos / "x.bmp")
    from PIL.BmpImagePlugin import BmpImageFile

    monkeypatch.setattr(BmpImageFile, "load", refuse)
    assert "more memory than there is" in reasons(ingest(photos)[0])["x.bmp"]


def test_case_17(cases_dir: Path, tmp_path: Path):
    (tmp_path / "photos").symlink_to(cases_dir / "17-hif" / "photos")
    assert ingest(tmp_path / "photos")[2]["images"] == 6


@pytest.mark.slow
def test_case_11_names_that_are_not_utf_8_get_poses(cases_dir: Path, photos: Path, tmp_path: Path):
    frames = extract_frames(cases_dir / "13-mediarecorder-webm" / "capture.webm", tmp_path / "frames", 80)
    for i, frame in enumerate(frames):
        name = f"f\xfcr{i:02d}.jpg".encode("latin-1" if i % 2 else "utf-8")
        frame.rename(photos / os.fsdecode(name))
    arguments = ["sfm", str(photos), "-w", str(tmp_path / "ws"), "--preset", "tiny", "--json"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.stderr
    placed = json.loads(result.stdout)["stages"][-1]["numbers"]
    assert (placed["registered"], placed["images"]) == (24, 24)


# ---------------------------------------------------------------- texts
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16"])
def test_texts_of_any_editor_are_read(tmp_path: Path, encoding: str):
    file = tmp_path / "t.txt"
    file.write_bytes("# Käse\r\n1 2\r\n".encode(encoding))
    assert read_text(file) == "# Käse\n1 2\n"


def test_names_in_texts_that_are_not_utf_8_match_those_of_files(tmp_path: Path):
    (tmp_path / "t.txt").write_bytes(b"f\xfcr.jpg")
    (tmp_path / os.fsdecode(b"f\xfcr.jpg")).touch()
    assert readable(read_text(tmp_path / "t.txt")) in named_files(tmp_path)[0]


@pytest.mark.parametrize(
    ("text", "expected"),
    [("[1, -2.5e3, true, null]", [1, -2500.0, True, None]), ("9007199254740993", 2**53 + 1), ("1" + "0" * 50, 1e50)],
)
def test_json_is_read(tmp_path: Path, text: str, expected: object):
    (tmp_path / "t.json").write_text(text)
    assert read_json(tmp_path / "t.json") == expected


@pytest.mark.parametrize("text", ["NaN", "[-Infinity]", "1e999", "9" * 400, "9" * 5000, "[" * 100_000, "", "{"])
def test_json_with_numbers_that_are_none_is_refused(tmp_path: Path, text: str):
    (tmp_path / "t.json").write_text(text)
    with pytest.raises((ValueError, RecursionError)) as caught:
        read_json(tmp_path / "t.json")
    assert len(reason(caught.value)) < 250


def test_only_files_of_a_bounded_size_are_read(tmp_path: Path):
    (tmp_path / "large").write_bytes(bytes(11))
    os.mkfifo(tmp_path / "pipe")
    for name, sentence in (("large", "11 bytes, at most 10"), ("pipe", "is no file"), (".", "is no file")):
        with pytest.raises(ValueError, match=sentence):
            read_bytes(tmp_path / name, 10)
    with pytest.raises(ValueError, match="is no file"):
        read_bytes(Path("/dev/zero"), 10)
    assert read_bytes(tmp_path / "large", 11) == bytes(11)


@pytest.mark.parametrize(
    "data", [b"", b"\x89PNG", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + b"\0\1\0\0" * 2, b"%!PS", bytes(99)]
)
def test_depth_images_that_are_none_are_refused(tmp_path: Path, data: bytes):
    (tmp_path / "0-depth.png").write_bytes(data)
    with pytest.raises(ValueError, match="is no"):
        read_depth(tmp_path / "0-depth.png")


def test_a_folder_that_cannot_be_read_is_told_of(photos: Path, monkeypatch: pytest.MonkeyPatch):
    write_photos(photos)
    (photos / "locked").mkdir()
    listed = Path.iterdir

    def refused(path: Path):
        if path.name == "locked":
            raise PermissionError(13, "Permission denied")
        return listed(path)

    monkeypatch.setattr(Path, "iterdir", refused)
    _, _, skipped = list_captures(photos)
    assert [(item.source, item.reason) for item in skipped] == [("locked", "a folder that may not be read")]
    shutil.rmtree(photos)
    with pytest.raises(InputError, match="does not exist"):
        list_captures(photos)


@pytest.mark.parametrize("place", [".", "photos"])
def test_folders_whose_files_may_not_be_seen(photos: Path, monkeypatch: pytest.MonkeyPatch, place: str):
    """One below the photos is left out; the photos' own is named."""
    write_photos(photos)
    locked = (photos / "locked" if place == "." else photos).resolve()
    locked.mkdir(exist_ok=True)
    stat, listed = Path.stat, Path.iterdir

    def refuse(path: Path) -> None:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "stat", lambda path, **how: refuse(path) if path.parent == locked else stat(path, **how))
    monkeypatch.setattr(Path, "iterdir", lambda path: refuse(path) if path == locked else listed(path))
    if place == ".":
        found, _, skipped = list_captures(photos)
        assert found
        assert [(item.source, item.reason) for item in skipped] == [("locked", "a folder that may not be read")]
    else:
        with pytest.raises(InputError, match=r"photos cannot be read \(Permission denied\)"):
            list_captures(photos)


def test_masks_are_not_looked_for_where_nothing_may_be_listed(photos: Path, monkeypatch: pytest.MonkeyPatch):
    (photos.parent / "masks").mkdir()
    Image.new("L", (8, 8)).save(photos.parent / "masks/a.png")
    assert unused_folder(photos, ["a.jpg"]) == photos.parent.resolve() / "masks"

    def refused(path: Path):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "iterdir", refused)
    assert unused_folder(photos, ["a.jpg"]) is None


def test_masks_behind_a_link_among_the_photos_are_no_photos(photos: Path):
    write_photos(photos)
    alone = list(list_captures(photos)[0])
    real = photos.parent / "outlines"
    real.mkdir()
    Image.new("L", (80, 60)).save(real / "other.png")
    (photos / "sil").symlink_to(real, target_is_directory=True)
    assert list(list_captures(photos, photos / "sil")[0]) == alone
    assert list(list_captures(photos)[0]) == sorted([*alone, "sil/other.png"])
    assert list(list_captures(photos, photos)[0]) == sorted([*alone, "sil/other.png"])


@pytest.mark.parametrize("mode", ["L", "RGB", "RGBA"])
def test_tiffs_that_exif_turns_keep_their_pixels(tmp_path: Path, mode: str) -> None:
    shape = (30, 50) if mode == "L" else (30, 50, len(mode))
    pixels = np.random.default_rng(0).integers(0, 255, shape, dtype=np.uint8)
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(pixels).save(tmp_path / "turned.tif", exif=exif)
    with open_image(tmp_path / "turned.tif") as stored:
        stored.load()
        np.testing.assert_array_equal(np.asarray(stored), np.rot90(pixels, -1))
