"""Reading videos: orientation, times, colours, and what is no video."""

import contextlib
from pathlib import Path

import numpy as np
import pytest

from stages.video.reading import UnreadableVideo, opened
from tests.stages import clips

CODECS = {"clip.mp4": "libx264", "clip.mov": "libx264", "clip.mkv": "libx264", "clip.webm": "libvpx-vp9", "clip.avi": "mjpeg"}


def read(path: Path, threads: int = 1, longest: int = 1000) -> tuple[list[np.ndarray], list[float]]:
    with opened(path, threads) as video:
        frames = [(frame.rgb(longest), frame.time) for frame in video.frames()]
    return [frame for frame, _ in frames], [time for _, time in frames]


def assert_alike(found: list[np.ndarray], expected: list[np.ndarray], most: float = 2.5) -> None:
    assert [frame.shape for frame in found] == [frame.shape for frame in expected]
    assert all(float(np.abs(a.astype(float) - b).mean()) < most for a, b in zip(found, expected, strict=True))


@pytest.mark.parametrize("name", CODECS)
def test_every_kind_of_video_is_read(name: str, tmp_path: Path) -> None:
    frames = clips.pan(5)
    pixels = "yuvj444p" if CODECS[name] == "mjpeg" else "yuv444p"
    found, times = read(clips.write_clip(tmp_path / name, frames, codec=CODECS[name], pixels=pixels, color_range=2 if CODECS[name] == "mjpeg" else 1))
    assert_alike(found, frames, 12 if CODECS[name] == "mjpeg" else 2.5)
    np.testing.assert_allclose(times, np.arange(5) / 10, atol=0.002)


@pytest.mark.parametrize("rotation", [90, 180])
def test_frames_are_upright(rotation: int, tmp_path: Path) -> None:
    frames = clips.pan(2)
    found, _ = read(clips.write_clip(tmp_path / "clip.mp4", frames, rotation=rotation))
    assert_alike(found, [np.rot90(frame, rotation // 90) for frame in frames])
    with opened(tmp_path / "clip.mp4") as video:
        next(video.frames())
        assert (video.width, video.height) == ((clips.HEIGHT, clips.WIDTH) if rotation != 180 else (clips.WIDTH, clips.HEIGHT))


def test_times_are_those_of_the_file_at_any_rate(tmp_path: Path) -> None:
    times = [0, 33, 66, 500, 533, 1900]
    assert read(clips.write_clip(tmp_path / "clip.mkv", clips.pan(6), times=times))[1] == pytest.approx([time / 1000 for time in times], abs=0.002)


@pytest.mark.parametrize("colour", [{"color_range": 1, "colorspace": 1}, {"color_range": 2, "colorspace": 1}, {"color_range": 1, "colorspace": 5}, {}])
def test_colours_are_those_that_the_file_means(colour: dict[str, int], tmp_path: Path) -> None:
    colours = np.array([[[255, 255, 255], [0, 0, 0], [200, 40, 40]], [[40, 200, 40], [40, 40, 200], [128, 128, 128]]], np.uint8)
    patches = colours.repeat(32, 0).repeat(32, 1)
    found, _ = read(clips.write_clip(tmp_path / "clip.mp4", [patches] * 2, **colour))
    assert np.abs(found[0].astype(int) - patches).max() <= 6


@pytest.mark.parametrize("name", ["clip.mp4", "clip.mkv"])
def test_a_truncated_video_gives_what_is_there_or_a_reason(name: str, tmp_path: Path) -> None:
    frames = clips.pan(6)
    whole = clips.write_clip(tmp_path / name, frames).read_bytes()
    path = tmp_path / f"cut_{name}"
    counts = []
    for size in np.linspace(0, len(whole) - 1, 10).astype(int):
        path.write_bytes(whole[:size])
        found = []
        with contextlib.suppress(UnreadableVideo):
            found, _ = read(path)
        counts.append(len(found))
        assert_alike(found[:-1], frames[: max(0, len(found) - 1)])
    assert counts[0] == 0
    assert counts == sorted(counts)
    assert name == "clip.mp4" or counts[-1] >= 4


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"#EXTM3U\n#EXTINF:1,\nfile:///etc/passwd\n",
        b"ffconcat version 1.0\nfile /etc/passwd\n",
        b"\0\0\0\x18ftypisom" + bytes(90),
        b"\x1aE\xdf\xa3" + bytes(99),
    ],
)
def test_what_is_no_video_is_refused_whatever_its_name(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "clip.mp4"
    path.write_bytes(content)
    with pytest.raises(UnreadableVideo):
        read(path)
