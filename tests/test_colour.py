"""Colours of photos: what a profile means arrives in sRGB, whatever the format; broken profiles are told of."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from stages.capture.colour import (
    ADOBE_GAMMA,
    ADOBE_RGB,
    BRADFORD,
    D50_XYZ,
    D65,
    DISPLAY_P3,
    SRGB,
    Colours,
    colours_of,
    in_srgb,
    matrix_profile,
)
from stages.capture.photo_reading import read_head, read_photo
from stages.inputs.formats import register_formats
from stages.light.srgb import decoded

PROPHOTO = ((0.7347, 0.2653), (0.1596, 0.8404), (0.0366, 0.0001))
D50 = (0.3457, 0.3585)
SPACES = {
    "adobe": (ADOBE_RGB, D65, lambda v: v**ADOBE_GAMMA, lambda v: v ** (1 / ADOBE_GAMMA)),
    "p3": (
        DISPLAY_P3,
        D65,
        decoded,
        lambda v: np.where(v <= 0.0031308, 12.92 * v, 1.055 * v ** (1 / 2.4) - 0.055),
    ),
    "prophoto": (PROPHOTO, D50, lambda v: v**1.8, lambda v: v ** (1 / 1.8)),
}
COLOURS = np.array([(200, 40, 60), (40, 190, 50), (60, 80, 220), (240, 220, 60), (128, 128, 128), (255, 255, 255)])


def xyz_from_rgb(primaries, white) -> np.ndarray:
    """Under D50, by the textbook; [3, 3]."""
    columns = np.array([[x / y, 1.0, (1 - x - y) / y] for x, y in (*primaries, white)]).T
    matrix = columns[:, :3] * np.linalg.solve(columns[:, :3], columns[:, 3])
    adaptation = np.linalg.inv(BRADFORD) @ np.diag((BRADFORD @ D50_XYZ) / (BRADFORD @ columns[:, 3])) @ BRADFORD
    return adaptation @ matrix


def encoded(space: str, colours: np.ndarray = COLOURS) -> np.ndarray:
    """sRGB values 0 to 255 as those of another space, 0 to 1."""
    primaries, white, _, encode = SPACES[space]
    linear = decoded(colours / 255) @ xyz_from_rgb(SRGB, D65).T @ np.linalg.inv(xyz_from_rgb(primaries, white)).T
    return encode(linear.clip(0, 1))


def profile(space: str) -> bytes:
    primaries, white, decode, _ = SPACES[space]
    return matrix_profile(space, primaries, decode, white)


def patches(values: np.ndarray) -> np.ndarray:
    """Fields of 32 x 32 pixels in a row."""
    return np.repeat(np.repeat(values[None], 32, 0)[:, :, None], 32, 2).reshape(32 * 1, -1, 3).repeat(2, 0)


def fields(image: Image.Image) -> np.ndarray:
    """The colours of those fields."""
    return np.asarray(image)[16, 16::32].astype(int)


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize(("suffix", "options"), [
    (".jpg", {"quality": 98, "subsampling": 0}), (".png", {}), (".tif", {}), (".webp", {"lossless": True}),
    (".heic", {"quality": 98}), (".avif", {"quality": 98}),
])  # fmt: skip
def test_wide_gamuts_become_srgb_in_every_format(tmp_path: Path, space: str, suffix: str, options: dict):
    register_formats()
    pixels = patches(np.rint(encoded(space) * 255)).astype(np.uint8)
    file = tmp_path / f"z{suffix}"
    Image.fromarray(pixels).save(file, icc_profile=profile(space), **options)
    photo = read_photo(file, 3200)
    assert np.abs(fields(photo.rgb) - COLOURS).max() <= (3 if suffix in (".png", ".tif", ".webp") else 10)
    assert photo.colours.name == space
    assert not photo.as_is
    assert read_head(file, "z", 3200).colours == photo.colours


def test_the_pure_green_of_srgb_in_adobe_rgb():
    image = Image.new("RGB", (8, 8), (112, 199, 47))
    assert np.abs(np.array(in_srgb(image, Colours(profile("adobe"))).getpixel((4, 4))) - (0, 200, 0)).max() <= 2


def test_srgb_by_any_name_is_left_as_it_is(tmp_path: Path):
    file = tmp_path / "z.jpg"
    Image.fromarray(patches(COLOURS).astype(np.uint8)).save(
        file, icc_profile=matrix_profile("My camera", SRGB, decoded)
    )
    assert read_photo(file, 3200).as_is == (".jpg", ".jpeg")


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_sixteen_bits_and_a_wide_gamut(tmp_path: Path, suffix: str):
    import cv2

    pixels = patches(np.rint(encoded("prophoto") * 65535)).astype(np.uint16)
    file = tmp_path / f"z{suffix}"
    cv2.imwrite(str(file), pixels[:, :, ::-1])
    with Image.open(file) as stored:
        assert stored.mode == "RGB"
    colours = Colours(profile("prophoto"), "ProPhoto")
    assert np.abs(fields(in_srgb(read_photo(file, 3200).rgb, colours)) - COLOURS).max() <= 3


def test_alpha_is_no_colour(tmp_path: Path):
    pixels = np.dstack([patches(np.rint(encoded("adobe") * 255)), np.full((64, 192), 255)]).astype(np.uint8)
    pixels[:32, :, 3] = 0
    Image.fromarray(pixels).save(tmp_path / "z.png", icc_profile=profile("adobe"))
    photo = read_photo(tmp_path / "z.png", 3200)
    assert np.abs(np.asarray(photo.rgb)[48, 16::32].astype(int) - COLOURS).max() <= 3
    assert photo.alpha.mean() == 0.5


def test_a_photo_that_is_reduced_is_converted_too(tmp_path: Path):
    pixels = patches(np.rint(encoded("p3") * 255)).astype(np.uint8)
    Image.fromarray(pixels).resize((1536, 512), Image.Resampling.NEAREST).save(
        tmp_path / "z.jpg", quality=98, icc_profile=profile("p3")
    )
    photo = read_photo(tmp_path / "z.jpg", 192)
    assert photo.rgb.size == (192, 64)
    assert np.abs(fields(photo.rgb) - COLOURS).max() <= 8


def grey_profile(gamma: float) -> bytes:
    """Of a grey scanner: only a curve."""
    curve = (np.linspace(0, 1, 256) ** gamma * 65535).round().astype(">u2")
    white = struct.pack(">4sI3i", b"XYZ ", 0, *(round(value * 65536) for value in D50_XYZ))
    text = struct.pack(">4sII", b"desc", 0, 5) + b"grey\0" + bytes(78)
    tags = {b"desc": text, b"wtpt": white, b"kTRC": struct.pack(">4sII", b"curv", 0, 256) + curve.tobytes()}
    return icc(b"mntr", b"GRAY", b"XYZ ", tags)


def ink_profile() -> bytes:
    """Of a press whose inks are ideal at full coverage: CMYK to Lab by a table of two levels an ink."""
    identity = struct.pack(">9i", *(65536 * int(i % 4 == 0) for i in range(9)))
    ramp = bytes(range(256))
    lab = {(c, m, y): (255 - 60 * (c + m + y), 128, 128) for c in (0, 1) for m in (0, 1) for y in (0, 1)}
    lab[(0, 1, 1)] = (136, 208, 195)  # sRGB's red
    table = bytes(
        value
        for c in (0, 1) for m in (0, 1) for y in (0, 1) for k in (0, 1)
        for value in ((0, 128, 128) if k else lab[c, m, y])
    )  # fmt: skip
    data = struct.pack(">4sI4B", b"mft1", 0, 4, 3, 2, 0) + identity + 4 * ramp + table + 3 * ramp
    text = struct.pack(">4sII", b"desc", 0, 4) + b"ink\0" + bytes(78)
    white = struct.pack(">4sI3i", b"XYZ ", 0, *(round(value * 65536) for value in D50_XYZ))
    return icc(b"prtr", b"CMYK", b"Lab ", {b"desc": text, b"wtpt": white, b"A2B0": data})


def icc(kind: bytes, space: bytes, connection: bytes, tags: dict[bytes, bytes]) -> bytes:
    table, body, start = struct.pack(">I", len(tags)), b"", 132 + 12 * len(tags)
    for tag, data in tags.items():
        table += struct.pack(">4sII", tag, start + len(body), len(data))
        body += data + bytes(-len(data) % 4)
    head = struct.pack(">I4sI4s4s4s", start + len(body), b"none", 0x02100000, kind, space, connection)
    head += bytes(12) + b"acsp" + bytes(28) + struct.pack(">3i", *(round(value * 65536) for value in D50_XYZ))
    return head.ljust(128, b"\0") + table + body


@pytest.mark.parametrize("deep", [False, True])
def test_grey_photos_with_a_curve_of_their_own(tmp_path: Path, deep: bool):
    linear = np.linspace(0.1, 0.9, 96)[None].repeat(64, 0)  # stored as they are: gamma 1
    pixels = np.rint(linear * 65535).astype(np.uint16) if deep else np.rint(linear * 255).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "z.png", icc_profile=grey_profile(1.0))
    found = np.asarray(read_photo(tmp_path / "z.png", 3200).rgb)[10, :, 0] / 255
    assert np.abs(decoded(found) - linear[10]).max() < 0.01


def test_inks_are_converted_by_their_profile(tmp_path: Path):
    inks = Image.new("CMYK", (96, 72), (0, 255, 255, 0))
    inks.save(tmp_path / "z.jpg", quality=98, icc_profile=ink_profile())
    photo = read_photo(tmp_path / "z.jpg", 3200)
    assert photo.colours.name == "ink"
    assert np.abs(np.array(photo.rgb.getpixel((40, 30))) - (255, 0, 0)).max() <= 12
    inks.save(tmp_path / "bare.jpg", quality=98)
    assert read_photo(tmp_path / "bare.jpg", 3200).rgb.mode == "RGB"


@pytest.mark.parametrize(("data", "words"), [
    (b"junk", "broken"), (profile("adobe")[:200], "broken"), (grey_profile(2.2), "is for GRAY, its pixels are RGB"),
])  # fmt: skip
def test_profiles_that_cannot_be_used_are_told_of_and_the_photo_is_kept(tmp_path: Path, data: bytes, words: str):
    Image.fromarray(patches(COLOURS).astype(np.uint8)).save(tmp_path / "z.png", icc_profile=data)
    photo = read_photo(tmp_path / "z.png", 3200)
    assert words in photo.colours.problem
    assert (fields(photo.rgb) == COLOURS).all()


def test_cameras_that_write_adobe_rgb_without_a_profile(tmp_path: Path):
    """DCF's option files: `_MG_0001.JPG`, "uncalibrated", interoperability index R03."""
    exif = Image.Exif()
    exif.get_ifd(0x8769)[0xA005] = {1: "R03"}
    exif.get_ifd(0x8769)[0xA001] = 0xFFFF
    pixels = patches(np.rint(encoded("adobe") * 255)).astype(np.uint8)
    Image.fromarray(pixels).save(tmp_path / "z.jpg", quality=98, subsampling=0, exif=exif)
    assert np.abs(fields(read_photo(tmp_path / "z.jpg", 3200).rgb) - COLOURS).max() <= 8


def test_heif_that_states_its_primaries_by_number():
    exif = Image.Exif()
    image = Image.fromarray(patches(np.rint(encoded("p3") * 255)).astype(np.uint8))
    wide = colours_of({"nclx_profile": {"color_primaries": 12, "transfer_characteristics": 13}}, exif, "RGB")
    assert np.abs(fields(in_srgb(image, wide)) - COLOURS).max() <= 3
    hdr = colours_of({"nclx_profile": {"color_primaries": 9, "transfer_characteristics": 16}}, exif, "RGB")
    assert "HDR picture (PQ)" in hdr.problem


def test_lab_tiffs_are_read(tmp_path: Path):
    Image.new("LAB", (96, 72), (136, 208, 195)).save(tmp_path / "z.tif")
    assert np.abs(np.array(read_photo(tmp_path / "z.tif", 3200).rgb.getpixel((40, 30))) - (255, 0, 0)).max() <= 12


@pytest.mark.parametrize("name", ["000.jpg", "024.jpg"])
def test_case_06_comes_out_in_srgb(cases_dir: Path, name: str):
    file = cases_dir / "06-icc" / "photos" / name
    photo = read_photo(file, 3200)
    with Image.open(file) as stored:
        assert photo.colours.profile == stored.info["icc_profile"]
        wide = np.asarray(stored).astype(int)
    there = encoded("adobe", np.asarray(photo.rgb).reshape(-1, 3)[::97])
    assert np.abs(there * 255 - wide.reshape(-1, 3)[::97]).mean() < 1.5
