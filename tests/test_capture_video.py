"""Videos: the sharp frames, spread over the motion; through ingest they are photos of one camera."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
import pytest

from configs.params import IngestParams
from stages import artifacts
from stages.capture.photo_reading import UnusableError
from stages.capture.video import LOST, Look, _look, choose_frames, extract_frames, motion, video_size
from stages.engine.stage import StageContext
from stages.ingest import INGEST
from stages.inputs.formats import Kind

FPS, SIZE = 30, (160, 120)


def scene() -> np.ndarray:
    """A wide picture full of corners."""
    small = np.random.default_rng(0).integers(0, 256, (30, 200, 3), dtype=np.uint8)
    return cv2.resize(small, None, fx=4, fy=4, interpolation=cv2.INTER_CUBIC)


def write_video(path: Path, offsets: list[float], blurred: set[int] = frozenset()) -> Path:
    """A camera that pans over `scene`; frame i looks at `offsets[i]` pixels from its left side."""
    wide = scene()
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), FPS, SIZE)
    assert writer.isOpened()
    for i, offset in enumerate(offsets):
        frame = wide[:, round(offset) : round(offset) + SIZE[0]]
        writer.write(cv2.GaussianBlur(frame, (0, 0), 4) if i in blurred else np.ascontiguousarray(frame))
    writer.release()
    return path


def test_motion_is_the_shift_over_the_diagonal():
    grey = cv2.cvtColor(scene(), cv2.COLOR_BGR2GRAY)
    found = motion(grey[:, :160].copy(), grey[:, 5:165].copy())
    assert found == pytest.approx(5 / np.hypot(160, 120), rel=0.05)
    assert motion(grey[:, :160].copy(), grey[:, :160].copy()) < 1e-4


def test_a_turning_object_before_a_still_wall_is_motion():
    wide = cv2.cvtColor(scene(), cv2.COLOR_BGR2GRAY)
    before = wide[:, :160].copy()
    after = before.copy()
    after[20:100, 20:140] = wide[20:100, 24:144]  # two thirds of the frame moved by 4
    assert motion(before, after) == pytest.approx(4 / 200, rel=0.1)


def test_a_cut_is_the_largest_motion_there_is():
    noise = np.random.default_rng(1).integers(0, 256, (2, 120, 160), dtype=np.uint8)
    assert motion(cv2.GaussianBlur(noise[0], (0, 0), 3), np.full((120, 160), 128, np.uint8)) <= LOST


def test_frames_are_spread_by_motion_and_each_is_the_sharpest_of_its_stretch():
    sharp = [1, 9, 1, 1, 9, 1, 1, 9, 1, 1]
    looks = [Look(3 * i, sharp[i], 0.05) for i in range(10)]
    assert choose_frames(looks, 3) == [3, 12, 21]


def test_a_camera_that_stands_still_gives_one_frame_and_stretches_without_motion_none():
    still = [Look(i, 1.0 + i % 3, 0.0001) for i in range(50)]
    assert len(choose_frames(still, 20)) == 1
    moving = [Look(50 + i, 1.0, 0.02) for i in range(11)]
    chosen = choose_frames(still + moving, 10)
    assert len(chosen) == 10
    assert sum(frame < 50 for frame in chosen) == 1


def test_blurred_frames_of_a_file_are_passed_over(tmp_path: Path):
    offsets = [6.0 * i for i in range(90)]
    blurred = {i for i in range(90) if (i // 3) % 2}  # every second frame that is looked at
    video = write_video(tmp_path / "clip.mp4", offsets, blurred)
    told: list[float] = []
    frames = extract_frames(video, tmp_path / "frames", 8, told.append)
    numbers = [int(frame.stem) for frame in frames]
    assert len(numbers) == 8
    assert not blurred & set(numbers)
    assert np.diff(numbers).max() <= 21  # 90 / 8 frames a stretch, give or take half of one
    assert told == sorted(told)
    assert told[-1] <= 1
    got = cv2.imread(str(frames[2]))
    expected = scene()[:, round(offsets[numbers[2]]) : round(offsets[numbers[2]]) + SIZE[0]]
    assert np.abs(got.astype(int) - expected).mean() < 25  # the frames beside it are at about 60


def test_damaged_video_is_unusable(tmp_path: Path):
    (tmp_path / "clip.mp4").write_bytes(b"0" * 1000)
    with pytest.raises(UnusableError, match="cannot be read as a video"):
        extract_frames(tmp_path / "clip.mp4", tmp_path / "frames", 5)


@pytest.mark.parametrize("alone", [True, False])
def test_ingest_takes_videos_as_one_camera_each(tmp_path: Path, alone: bool):
    photos, out = tmp_path / "photos", tmp_path / "out"
    photos.mkdir()
    out.mkdir()
    video = write_video(photos / "clip.mp4", [5.0 * i for i in range(60)])
    if not alone:
        write_video(photos / "other.mp4", [300 - 5.0 * i for i in range(60)])
        (photos / "bad.mov").write_bytes(b"0" * 1000)
    context = StageContext(
        {}, {"photos": video if alone else photos}, out, tmp_path / "scratch", IngestParams(video_frames=5)
    )
    numbers = INGEST.run(context)
    image_set = artifacts.IMAGE_SET.load(out)
    assert numbers["images"] == (5 if alone else 10)
    assert numbers["cameras"] == numbers["videos"] == (1 if alone else 2)
    assert all(record.name.startswith(("clip.mp4/", "other.mp4/")) for record in image_set.images)
    assert all(artifacts.Pictures(out).path(record.name).is_file() for record in image_set.images)
    assert [item.source for item in image_set.skipped] == ([] if alone else ["bad.mov"])


def test_a_portrait_video_of_a_phone_is_read_upright(tmp_path: Path):
    """Phones store the sensor's landscape and note the turn in the track's matrix."""
    video = write_video(tmp_path / "clip.mp4", [5.0 * i for i in range(30)])
    data = bytearray(video.read_bytes())
    matrix = data.index(b"tkhd") + 4 + 40  # version 0: 40 bytes of times, ids and volume before it
    quarter_turn = (0, 1 << 16, 0, -(1 << 16), 0, 0, SIZE[1] << 16, 0, 1 << 30)
    data[matrix : matrix + 36] = struct.pack(">9i", *quarter_turn)
    video.write_bytes(data)
    assert video_size(video) == (30, SIZE[1], SIZE[0])
    frame = cv2.imread(str(extract_frames(video, tmp_path / "frames", 1)[0]))
    assert frame.shape == (SIZE[0], SIZE[1], 3)


def test_frames_are_looked_at_by_their_time_whatever_rate_the_file_notes(tmp_path: Path, monkeypatch):
    """As MediaRecorder's WebM (1000 frames a second, no count), phones of varying rates, streams without time."""
    video = write_video(tmp_path / "clip.mp4", [5.0 * i for i in range(90)])
    opened = cv2.VideoCapture

    class Stamped:
        """A capture whose file notes nonsense, and whose frames have the stamps of `stamps`."""

        stamps: ClassVar[list[float]] = []

        def __init__(self, *arguments: object) -> None:
            self.capture, self.frame = opened(*arguments), -1

        def grab(self) -> bool:
            self.frame += 1
            return self.capture.grab()

        def get(self, key: int) -> float:
            if key == cv2.CAP_PROP_POS_MSEC:
                return self.stamps[self.frame]
            return {cv2.CAP_PROP_FPS: 1000.0, cv2.CAP_PROP_FRAME_COUNT: -9.2e18}.get(key) or self.capture.get(key)

        def __getattr__(self, name: str) -> object:
            return getattr(self.capture, name)

    monkeypatch.setattr(cv2, "VideoCapture", Stamped)
    even = [1000 * i / 30 for i in range(90)]
    halting = [1000 * i / 60 if i < 45 else 750 + 1000 * (i - 45) / 15 for i in range(90)]
    for stamps, expected in ((even, 30), (halting, 7 + 23), ([0.0] * 90, 30)):
        Stamped.stamps = stamps
        assert abs(len(list(_look(video, lambda part: None))) - expected) <= 1
    assert video_size(video) == (90, *SIZE)


@pytest.mark.parametrize("text", [
    "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{secret}\n#EXT-X-ENDLIST\n",
    "ffconcat version 1.0\nfile {secret}\n",
    "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nt=0 0\nm=video 5004 RTP/AVP 96\n",
    '<?xml version="1.0"?><MPD xmlns="urn:mpeg:dash:schema:mpd:2011"><BaseURL>{secret}</BaseURL></MPD>',
    "<ASX><ENTRY><REF HREF={secret}></ENTRY></ASX>",
])  # fmt: skip
def test_a_list_of_other_files_is_no_video(tmp_path: Path, text: str):
    secret = write_video(tmp_path / "secret.mp4", [5.0 * i for i in range(30)])
    for name in ("clip.mp4", "clip.m3u8"):
        (tmp_path / name).write_text(text.format(secret=secret.name))
        with pytest.raises(UnusableError, match="cannot be read as a video"):
            extract_frames(tmp_path / name, tmp_path / "frames", 5)


def test_ffmpeg_itself_may_read_only_this_file(tmp_path: Path, monkeypatch):
    """Where a file is made to look like a video to us and like a playlist to FFmpeg."""
    secret = write_video(tmp_path / "secret.mp4", [5.0 * i for i in range(30)])
    (tmp_path / "clip.mp4").write_text(f"ffconcat version 1.0\nfile {secret.name}\n")
    monkeypatch.setattr("stages.capture.video.kind_of", lambda file: Kind.VIDEO)
    with pytest.raises(UnusableError):
        extract_frames(tmp_path / "clip.mp4", tmp_path / "frames", 5)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -1e300])
def test_counts_and_stamps_that_are_no_numbers(tmp_path: Path, monkeypatch, value: float):
    video = write_video(tmp_path / "clip.mp4", [5.0 * i for i in range(30)])
    opened = cv2.VideoCapture

    class Odd:
        def __init__(self, *arguments: object) -> None:
            self.capture = opened(*arguments)

        def get(self, key: int) -> float:
            stated = (cv2.CAP_PROP_FRAME_COUNT, cv2.CAP_PROP_FPS, cv2.CAP_PROP_POS_MSEC)
            return value if key in stated else self.capture.get(key)

        def __getattr__(self, name: str) -> object:
            return getattr(self.capture, name)

    monkeypatch.setattr(cv2, "VideoCapture", Odd)
    assert video_size(video) == (30, *SIZE)
    assert extract_frames(video, tmp_path / "frames", 5)


def test_a_video_of_far_more_frames_than_bytes_is_not_decoded_to_its_end(tmp_path: Path, monkeypatch):
    video = write_video(tmp_path / "clip.mp4", [0.0] * 60)
    monkeypatch.setattr("stages.capture.video.PIXELS_OF_ANY", 0)
    monkeypatch.setattr("stages.capture.video.PIXELS_PER_BYTE", 40 * 3e5 / video.stat().st_size)
    with pytest.raises(UnusableError, match="a video of more than 40 frames in"):
        extract_frames(video, tmp_path / "frames", 5)


@pytest.mark.parametrize(("size", "words"), [((2000, 16), "only 2000 x 16 pixels"), ((320, 240), "of 320 x 240 pix")])
def test_frames_of_sizes_that_no_camera_has(tmp_path: Path, monkeypatch, size: tuple[int, int], words: str):
    writer = cv2.VideoWriter(str(tmp_path / "x.avi"), cv2.VideoWriter_fourcc(*"MJPG"), FPS, size)
    for _ in range(3):
        writer.write(np.zeros((*size[::-1], 3), np.uint8))
    writer.release()
    monkeypatch.setattr("stages.capture.video.LARGEST_FRAME", 320 * 240 - 1)
    for read in (video_size, lambda file: extract_frames(file, tmp_path / "frames", 5)):
        with pytest.raises(UnusableError, match=words):
            read(tmp_path / "x.avi")


def test_a_pipe_is_no_video(tmp_path: Path):
    os.mkfifo(tmp_path / "x.mp4")
    with pytest.raises(UnusableError, match="a pipe"):
        extract_frames(tmp_path / "x.mp4", tmp_path / "frames", 5)


@pytest.mark.parametrize("name", ["clip", "clip.jpg", "CLIP.MOV", "%03d.mp4", "http:x.mp4", "f\udcfcr.mp4", "-i.mp4"])
def test_videos_are_told_by_their_content(tmp_path: Path, name: str):
    write_video(tmp_path / "clip.mp4", [5.0 * i for i in range(60)]).rename(tmp_path / name)
    photos, out = tmp_path / "photos", tmp_path / "out"
    for folder in (photos, out):
        folder.mkdir()
    (tmp_path / name).rename(photos / name)
    context = StageContext({}, {"photos": photos}, out, tmp_path / "scratch", IngestParams(video_frames=5))
    assert INGEST.run(context)["images"] == 5


def test_case_13(cases_dir: Path, tmp_path: Path):
    video = cases_dir / "13-mediarecorder-webm" / "capture.webm"
    assert video_size(video) == (144, 480, 360)
    assert len(extract_frames(video, tmp_path / "frames", 80)) == 24
