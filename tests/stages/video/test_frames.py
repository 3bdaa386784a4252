"""Videos become photographs: which frames, under which names, again after a kill."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipeline.errors import BadInput, Interrupted
from pipeline.stage import Job
from stages.formats.importers import candidates, files
from stages.io.material import find_material, photographs_of, with_frames
from stages.io.photo import read_photo
from stages.poses.settings import PosesSettings
from stages.video.frames import Chosen, Reader, first_reading, frames_of
from stages.video.reading import opened
from tests.stages import captures, clips

BLURRED = (4, 5, 9, 13, 17, 18)


def job_for(source: Path, out: Path, **settings: Any) -> tuple[Job, list[str]]:
    events: list[dict[str, Any]] = []
    warnings: list[str] = []

    def report(event: dict[str, Any]) -> None:
        events.append(event)
        if event["event"] == "warning":
            warnings.append(event["text"])

    return Job(settings=PosesSettings(**settings), out=out / "poses", work=out / "work", source=source, stage="poses", report=report), warnings


def chosen(source: Path, work: Path, count: int = 8, safe_point: Callable[[], None] = lambda: None) -> tuple[Chosen, list[str]]:
    """The chosen frames of a clip, and warnings."""
    warnings: list[str] = []
    reader = Reader(1, work, lambda *values: None, safe_point, warnings.append)
    return frames_of({source.name: source}, count=count, max_side=1000, reader=reader), warnings


def contents(found: Chosen) -> dict[str, bytes]:
    return {name: path.read_bytes() for name, path in found.paths.items()}


def record_of(source: Path, out: Path, **settings: Any) -> tuple[dict[str, Path], dict[str, Any], list[str]]:
    """Names and files, frames.json, warnings."""
    job, warnings = job_for(source, out, **settings)
    found = with_frames(job, find_material({"": source}, False, job.warn), 1000, job.warn)
    return found.paths, json.loads((out / "poses" / "frames.json").read_text()), warnings


def clip(folder: Path, name: str = "clip.mp4", **options: Any) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    return clips.write_clip(folder / name, clips.pan(24, 6.0, blur=BLURRED), **options)


def test_the_sharp_frames_of_a_clip_are_chosen_and_recorded(tmp_path: Path) -> None:
    paths, record, warnings = record_of(clip(tmp_path), tmp_path, frames=8)
    (video,) = record["videos"]
    numbers = [int(Path(name).stem) for name in paths]
    assert [name.split("/")[0] for name in paths] == ["clip.mp4"] * len(paths)
    assert numbers == sorted(numbers)
    assert 6 <= len(numbers) <= 8
    assert not set(numbers) & set(BLURRED)
    assert numbers == [number for number, verdict in zip(video["frame"], video["verdict"], strict=True) if verdict == "chosen"]
    assert len(video["time"]) == len(video["sharpness"]) == len(video["motion"]) == 24
    assert video["time"] == pytest.approx([i / 10 for i in range(24)])
    assert not warnings
    frames = clips.pan(24, 6.0, blur=BLURRED)
    for number, path in zip(numbers, paths.values(), strict=True):
        assert np.abs(np.asarray(Image.open(path)).astype(float) - frames[number]).mean() < 2.5
    for sheet in ("frames.png", "frames_plot.png"):
        with Image.open(tmp_path / "poses" / sheet) as image:
            assert image.width > 500


def test_frames_of_one_video_share_a_camera_and_those_of_two_do_not(tmp_path: Path) -> None:
    clip(tmp_path, "a.mp4")
    clip(tmp_path, "b.mov")
    reader = Reader(1, tmp_path / "work", lambda *values: None, lambda: None, lambda text: None)
    found = frames_of(find_material({"": tmp_path}, False, lambda text: None).videos, count=12, max_side=1000, reader=reader)
    assert [video["video"] for video in found.record] == ["a.mp4", "b.mov"]
    assert {name: {read_photo(path, 1000).maker for other, path in found.paths.items() if other.startswith(name)} for name in ("a.mp4", "b.mov")} == {
        "a.mp4": {"video a.mp4"},
        "b.mov": {"video b.mov"},
    }


def test_killed_at_any_moment_it_gives_the_same_frames(tmp_path: Path) -> None:
    source = clip(tmp_path)
    expected = contents(chosen(source, tmp_path / "whole")[0])
    for moment in (3, 20, 26, 5):  # the last two while frames are written
        points = iter(range(1000))

        def stop(points: Any = points, moment: int = moment) -> None:
            if next(points) == moment:
                raise Interrupted(2)

        with pytest.raises(Interrupted):
            chosen(source, tmp_path / "killed", safe_point=stop)
    assert contents(chosen(source, tmp_path / "killed")[0]) == expected


def test_a_video_is_the_source_of_a_run_by_its_content(tmp_path: Path) -> None:
    source = clip(tmp_path)
    settings = PosesSettings()
    assert candidates(source) == ["photographs"]
    assert files(source, settings) == [source]
    assert files(tmp_path, settings) == [source]


def test_panoramas_become_views_and_photographs_beside_them_stay(tmp_path: Path) -> None:
    about = b'<x:xmpmeta GPano:ProjectionType="equirectangular"/>'
    captures.write_picture(tmp_path / "source" / "360.jpg", captures.picture(width=64, height=32), xmp=about)
    captures.write_picture(tmp_path / "source" / "plain.jpg", captures.picture(width=64, height=32))
    views = [f"360.jpg/{degrees:03d}.png" for degrees in range(0, 360, 45)]
    for lens, expected in (("auto", ["plain.jpg", *views]), ("perspective", ["360.jpg", "plain.jpg"])):
        job, _ = job_for(tmp_path / "source", tmp_path / lens, lens=lens)
        assert list(photographs_of(job, job.warn).paths) == expected
    job, _ = job_for(tmp_path / "source", tmp_path / "all", lens="equirectangular")
    assert len(photographs_of(job, job.warn).paths) == 16
    captures.write_picture(tmp_path / "source" / "x.jpg", captures.picture())
    with pytest.raises(BadInput, match=r"x\.jpg: 32x24"):
        photographs_of(job, job.warn)


def without_rate(path: Path) -> Path:
    """A WebM file as browsers record it: without its duration, and without that of a frame; FFmpeg then takes the clock's 1000 a second for its rate."""
    data = bytearray(path.read_bytes())
    for element in (b"\x23\xe3\x83", b"\x44\x89"):  # DefaultDuration, Duration
        at = data.index(element)
        length = data[at + len(element)] & 0x7F
        data[at : at + len(element) + 1 + length] = b"\xec" + bytes([0x80 | (len(element) - 1 + length)]) + bytes(len(element) - 1 + length)  # Void
    path.write_bytes(data)
    return path


def test_video_of_an_unknown_rate_is_looked_at_by_its_times(tmp_path: Path) -> None:
    for milliseconds, expected in ((33, 60), (8, 20)):  # every frame of 30 a second; of 120 every third
        times = [index * milliseconds + index % 2 for index in range(60)]
        path = without_rate(clips.write_clip(tmp_path / f"{milliseconds}.webm", clips.pan(60, 2.0), times=times, codec="libvpx-vp9"))
        with opened(path) as video:
            assert not video.known_rate
        looked = first_reading(path, Reader(1, tmp_path / "work", lambda *values: None, lambda: None, lambda text: None))
        assert len(looked.index) == expected
        assert np.diff(looked.time).min() >= 0.02
