"""Videos: the sharp frames, spread over the motion; through ingest they are photos of one camera."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from configs.params import IngestParams
from stages import artifacts
from stages.capture.photo_reading import UnusableError
from stages.capture.video import LOST, Look, choose_frames, extract_frames, motion, video_size
from stages.engine.stage import StageContext
from stages.ingest import INGEST

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
    assert all(artifacts.image_path(out, record.name).is_file() for record in image_set.images)
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
