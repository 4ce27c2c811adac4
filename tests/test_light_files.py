"""Lights as files: what is written comes back, readers that are not ours open it, and what is no light is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import OpenEXR
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from stages.errors import InputError
from stages.files.light_files import harmonics_json, read_light, rgbe, write_exr, write_hdr
from stages.inputs import light_maps
from stages.light.environment import directions, look_up
from stages.light.harmonics import basis, project

HEAD = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n"
GREY = bytes((128, 128, 128, 129))  # radiance 1


def some_light(height: int = 8) -> np.ndarray:
    """A dim room with a window ten thousand times as bright, and a black corner."""
    radiance = np.random.default_rng(0).random((height, 2 * height, 3)).astype(np.float32)
    radiance[1, 3] = 10_000, 8000, 5000
    radiance[2, 2] = 0
    return radiance


def refused(file: Path, sentence: str) -> None:
    with pytest.raises(InputError, match=sentence) as caught:
        read_light(file)
    assert len(caught.value.message) < 600
    assert caught.value.hint


def refused_bytes(folder: Path, data: bytes, sentence: str, name: str = "light.hdr") -> None:
    (folder / name).write_bytes(data)
    refused(folder / name, sentence)


# ---------------------------------------------------------------- round trips
def test_exr_comes_back_as_it_was(tmp_path: Path) -> None:
    write_exr(tmp_path / "light.exr", some_light())
    np.testing.assert_array_equal(read_light(tmp_path / "light.exr"), some_light())
    header = OpenEXR.File(str(tmp_path / "light.exr")).header()
    assert header["envmap"] == OpenEXR.ENVMAP_LATLONG


@pytest.mark.parametrize("read", [read_light, lambda file: cv2.imread(str(file), cv2.IMREAD_UNCHANGED)[..., ::-1]])
def test_hdr_comes_back_to_a_256th_of_the_brightest_channel(read: Callable[[Path], np.ndarray], tmp_path: Path) -> None:
    write_hdr(tmp_path / "light.hdr", some_light())
    error = np.abs(read(tmp_path / "light.hdr") - some_light())
    assert (error <= some_light().max(2, keepdims=True) / 256 + 1e-12).all()
    np.testing.assert_array_equal(read(tmp_path / "light.hdr")[2, 2], 0)


def test_the_runs_that_opencv_writes_are_read(tmp_path: Path) -> None:
    radiance = np.repeat(some_light(16)[:, ::4], 4, axis=1)  # with something to run
    cv2.imwrite(str(tmp_path / "light.hdr"), radiance[..., ::-1])
    assert (tmp_path / "light.hdr").stat().st_size < radiance.size / 3 * 4
    expected = cv2.imread(str(tmp_path / "light.hdr"), cv2.IMREAD_UNCHANGED)[..., ::-1]
    np.testing.assert_array_equal(read_light(tmp_path / "light.hdr"), expected)


@settings(deadline=None, max_examples=30)
@given(st.lists(st.floats(0, 2.0**60, width=32), min_size=6, max_size=6))
def test_rgbe_is_within_half_a_step(values: list[float]) -> None:
    pixels = np.asarray(values, dtype=np.float64).reshape(2, 3)
    stored = rgbe(pixels).astype(np.float64)
    back = stored[:, :3] * 2.0 ** (stored[:, 3:] - light_maps.EXPONENT)
    assert (np.abs(back - pixels) <= pixels.max(1, keepdims=True) / 256 + 2.0**-120).all()


def test_harmonics_say_their_convention_and_come_back() -> None:
    told = json.loads(json.dumps(harmonics_json(some_light(16))))
    for count, degree in ((9, 2), (16, 3)):
        np.testing.assert_allclose(
            told["coefficients"][str(count)], project(some_light(16), degree), atol=1e-6, rtol=1e-6
        )
    uniform = harmonics_json(np.ones((8, 16, 3)))
    assert uniform["coefficients"]["9"][0][0] == pytest.approx(3.545, abs=1e-3)
    assert "3.545" in uniform["convention"]["values"]
    assert "+Y up" in uniform["convention"]["frame"]


def test_the_axes_of_the_harmonics_are_those_that_the_file_names() -> None:
    from_x = np.zeros((16, 32, 3))
    from_x[directions(16)[..., 0] > 0.95] = 1
    first_degree = np.asarray(harmonics_json(from_x)["coefficients"]["9"])[1:4, 0]  # their y, z, x
    assert np.argmax(first_degree) == 0
    assert basis(np.array([1.0, 0, 0]))[1] == pytest.approx(0.488603)


# ---------------------------------------------------------------- other ways to say the same
def test_rows_from_below_and_an_exposure(tmp_path: Path) -> None:
    rows = bytes((128, 0, 0, 129)) * 4 + GREY * 4
    for sign, top in ((b"-", [1, 0, 0]), (b"+", [1, 1, 1])):
        (tmp_path / "light.hdr").write_bytes(HEAD[:-1] + b"EXPOSURE=2\nEXPOSURE=2\n\n" + sign + b"Y 2 +X 4\n" + rows)
        np.testing.assert_allclose(read_light(tmp_path / "light.hdr")[0, 0], np.divide(top, 4))


def test_grey_half_and_whole_exr_and_its_first_part_with_colours(tmp_path: Path) -> None:
    file, grey = tmp_path / "light.exr", np.arange(32, dtype=np.float32).reshape(4, 8)
    for kind in (np.float16, np.float32, np.uint32):
        OpenEXR.File({}, {"Y": grey.astype(kind)}).write(str(file))
        np.testing.assert_array_equal(read_light(file), np.repeat(grey[..., None], 3, axis=2))
    depth = OpenEXR.Part({"name": "depth"}, {"Z": grey})
    colours = OpenEXR.Part({"name": "colours"}, {"RGB": some_light(4), "Z": grey})
    OpenEXR.File([depth, colours]).write(str(file))
    np.testing.assert_array_equal(read_light(file), some_light(4))


def test_a_map_that_was_read_shows_the_light_where_it_was(tmp_path: Path) -> None:
    sun = np.zeros((32, 64, 3), np.float32)
    sun[8, 16] = 100
    write_hdr(tmp_path / "light.hdr", sun)
    np.testing.assert_allclose(look_up(read_light(tmp_path / "light.hdr"), directions(32)[8, 16]), 100, rtol=1e-5)


# ---------------------------------------------------------------- no lights
@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda light: light[:, :9], "9 x 8 pixels; an equirectangular map is twice"),
        (lambda light: light[:6], "16 x 6 pixels; an equirectangular map is twice"),
        (lambda light: np.where(light == 10_000, np.nan, light), "1 of its pixels are no number.*column 3, row 1: nan"),
        (lambda light: np.where(light == 5000, np.inf, light), "1 of its pixels are no number.*column 3, row 1: .*inf"),
        (lambda light: light - 0.5, "pixels are negative, the first in column 0, row 0"),
    ],
)
def test_maps_that_are_no_light(change: Callable[[np.ndarray], np.ndarray], sentence: str, tmp_path: Path) -> None:
    write_exr(tmp_path / "light.exr", change(some_light()))
    refused(tmp_path / "light.exr", sentence)


def test_exr_with_odd_channels(tmp_path: Path) -> None:
    file, plane = tmp_path / "light.exr", np.ones((2, 4), np.float32)
    OpenEXR.File({}, {"Z": plane, "normal.X": plane}).write(str(file))
    refused(file, r"no channels R, G and B \(nor Y alone\) but Z, normal.X")
    OpenEXR.File({}, {"Y": plane, "RY": plane, "BY": plane}).write(str(file))
    refused(file, "but BY, RY, Y")
    OpenEXR.File({}, {name: plane for name in "RG"}).write(str(file))
    refused(file, "but G, R")


def test_pictures_for_the_screen_and_other_files(tmp_path: Path) -> None:
    for suffix in ("png", "jpg", "tif"):
        cv2.imwrite(str(tmp_path / f"light.{suffix}"), np.full((4, 8, 3), 200, np.uint8))
        refused(tmp_path / f"light.{suffix}", "a picture for the screen, which holds no HDR light")
    (tmp_path / "renamed.hdr").write_bytes((tmp_path / "light.jpg").read_bytes())
    refused(tmp_path / "renamed.hdr", "a picture for the screen")
    refused_bytes(tmp_path, b"version https://git-lfs.github.com/spec/v1\n", "a pointer of Git LFS")
    refused_bytes(tmp_path, b"", "no HDR image but empty")
    refused(tmp_path / "absent.hdr", "No such file")
    refused(tmp_path, "a folder, a pipe")


def test_sizes_that_lie_take_no_memory(tmp_path: Path) -> None:
    refused_bytes(tmp_path, HEAD + b"-Y 99999999 +X 199999998\n" + GREY, "at most 8192 x 4096 are read")
    refused_bytes(tmp_path, HEAD + b"-Y 4096 +X 8192\n" + GREY, "it ends in row 0 of 4096")
    refused_bytes(tmp_path, HEAD + b"-Y 2\n" + GREY, "no size of the form")
    refused_bytes(tmp_path, HEAD + b"-Y 0 +X 0\n" + GREY, "0 x 0 pixels")
    refused_bytes(
        tmp_path, HEAD.replace(b"rgbe", b"xyze") + b"-Y 1 +X 2\n" + 2 * GREY, "its colours are 32-bit_rle_xyze"
    )
    refused_bytes(tmp_path, HEAD[:-1] + b"EXPOSURE=nan\n\n-Y 1 +X 2\n" + 2 * GREY, "an exposure of nan")
    refused_bytes(tmp_path, HEAD + b"-Y 1 +X 2\n" + bytes((1, 1, 1, 200)) * 2, "its runs are of a kind")
    row = b"-Y 8 +X 16\n\2\2\0"
    refused_bytes(tmp_path, HEAD + row + b"\x11" + GREY * 200, "row 0 says that it has another width")
    refused_bytes(tmp_path, HEAD + row + b"\x10" + b"\xff\x80" * 200, "a run in it is longer than its row")
    refused_bytes(tmp_path, HEAD + row + b"\x10" + b"\x90\x80" * 5, "it ends in row 1 of 8")


def test_an_exr_with_more_pixels_than_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "light.exr"
    write_exr(file, some_light())
    monkeypatch.setattr(light_maps, "MOST_ROWS", 7)
    refused(file, "at most 14 x 7 are read")
    monkeypatch.setattr(light_maps, "MOST_ROWS", 8)
    monkeypatch.setattr(light_maps, "MOST_DECODED", 8 * 16 * 12 - 1)
    refused(file, "its channels have 1536 bytes together")


def test_damaged_exr_files(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    write_exr(tmp_path / "light.exr", some_light(32))
    data = (tmp_path / "light.exr").read_bytes()
    for end in (5, 100, 400, len(data) // 2, len(data) - 5):
        refused_bytes(tmp_path, data[:end], "cannot be read as a light", "cut.exr")
    assert not capfd.readouterr().out


@settings(deadline=None, max_examples=100)
@given(data=st.data())
def test_whatever_is_wrong_is_a_sentence(tmp_path_factory: pytest.TempPathFactory, data: st.DataObject) -> None:
    folder = tmp_path_factory.mktemp("wrong")
    suffix, write = data.draw(st.sampled_from((("hdr", write_hdr), ("exr", write_exr))))
    write(folder / "valid", some_light())
    changed = bytearray((folder / "valid").read_bytes())
    for _ in range(data.draw(st.integers(1, 3))):
        changed[data.draw(st.integers(0, len(changed) - 1))] = data.draw(st.integers(0, 255))
    (folder / f"light.{suffix}").write_bytes(changed)
    try:
        radiance = read_light(folder / f"light.{suffix}")
    except InputError:
        return
    assert radiance.shape[1] == 2 * radiance.shape[0]
    assert ((radiance >= 0) & (radiance <= light_maps.LARGEST)).all()
