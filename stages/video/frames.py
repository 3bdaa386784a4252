"""Videos to photographs: each is read twice, once to choose its frames, once to write those that are chosen.

    RUN/.work/.../video_0.json    what the first reading found
    RUN/.work/.../frames_0.json   which files the second one wrote, below frames_0/

Memory does not grow with the length of a video but for three numbers a frame.
"""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from PIL import Image
from PIL.ExifTags import Base

from efficientnerf.capture import frame_choice as choice
from efficientnerf.capture.frame_motion import DETAIL, TRACKED, Motion, sharpness
from pipeline.files import remove
from stages.io.png import FAST, write_png
from stages.scratch import note, noted, once, same_as
from stages.video.reading import UnreadableVideo, opened

SLOWEST = 12.0  # frames a second that are looked at at least; of videos with more than twice as many, every n-th
NEAREST = 0.25 / SLOWEST  # seconds between frames that are looked at, at least, of videos of an unknown rate
Progress = Callable[..., None]


@dataclass(frozen=True)
class FirstReading:
    """What the first reading of a video finds: number, time, sharpness and motion of each frame that is examined."""

    # width, height: upright, pixels
    width: int
    height: int
    duration: float
    maker: str
    hdr: str
    damaged: int
    index: list[int]
    time: list[float]
    sharpness: list[float]
    motion: list[float]


@dataclass(frozen=True)
class Chosen:
    """The frames of the videos."""

    paths: dict[str, Path]  # name -> PNG, in order of time within each video; a name is that of the video, /, the frame's number
    record: list[dict[str, object]]  # for frames.json


@dataclass(frozen=True)
class Reader:
    """What readers need of the stage."""

    threads: int  # that decode
    work: Path  # scratch folder
    progress: Progress
    safe_point: Callable[[], None]
    warn: Callable[[str], object]


def frames_of(videos: Mapping[str, Path], *, count: int, max_side: int, reader: Reader) -> Chosen:
    """Choose frames of videos and write them. Raises UnreadableVideo, whose text names the video.

    count     frames of all together, at most
    """
    looked = {name: _first_reading_of(name, path, place, reader) for place, (name, path) in enumerate(videos.items())}
    limits = choice.shares([found.motion[-1] for found in looked.values()], count)
    paths: dict[str, Path] = {}
    record: list[dict[str, object]] = []
    for place, (name, found) in enumerate(looked.items()):
        verdicts = choice.choose(np.array(found.motion), np.array(found.sharpness), limits[place])
        numbers = [number for number, verdict in zip(found.index, verdicts, strict=True) if verdict == choice.CHOSEN]
        written = _written(name, videos[name], place, numbers, max_side, found, reader)
        paths |= {f"{name}/{number:06d}.png": path for number, path in written.items()}
        # columns with an entry for each frame that was looked at
        record.append({
            "video": name,
            "size": [found.width, found.height],
            "duration": found.duration,
            "camera": found.maker,
            "frames": len(found.index),
            "chosen": verdicts.count(choice.CHOSEN),
            "frame": found.index,
            "time": found.time,
            "sharpness": [round(value, 5) for value in found.sharpness],
            "motion": [round(value, 5) for value in found.motion],
            "verdict": verdicts,
        })
    return Chosen(paths, record)


def _first_reading_of(name: str, path: Path, place: int, reader: Reader) -> FirstReading:
    """The first reading, or what an earlier call found."""
    file = reader.work / f"video_{place}.json"
    found = noted(file, FirstReading, once(reader.warn), _check)
    if found is None:
        reader.work.mkdir(parents=True, exist_ok=True)
        with _naming(name):
            found = first_reading(path, reader)
        note(file, asdict(found))
    if found.damaged:
        reader.warn(f"{name}: damaged: {found.damaged} frames or packets are skipped.")
    if found.hdr:
        reader.warn(f"{name}: high dynamic range ({found.hdr}); its colours are read as SDR and may be off. Film with HDR off.")
    return found


def _check(found: FirstReading, outputs: object) -> None:
    if not len(found.index) == len(found.time) == len(found.sharpness) == len(found.motion) >= 1:
        raise ValueError("lists of different lengths")


@contextlib.contextmanager
def _naming(name: str) -> Iterator[None]:
    """UnreadableVideo with the video's name before its text."""
    try:
        yield
    except UnreadableVideo as error:
        raise UnreadableVideo(f"{name}: {error}") from error


def first_reading(path: Path, reader: Reader) -> FirstReading:
    """Sharpness and motion of the frames of a video. Raises UnreadableVideo."""
    found = _read_once(path, reader, reader.threads)
    return _read_once(path, reader, 1) if found.damaged and reader.threads > 1 else found


def _read_once(path: Path, reader: Reader, threads: int) -> FirstReading:
    motion = Motion()
    rows: list[tuple[int, float, float, float]] = []
    with opened(path, threads) as video:
        every = max(1, int(video.rate / SLOWEST / 2)) if video.known_rate else 1
        for frame in video.frames():
            reader.safe_point()
            reader.progress(frame.index, max(video.count, frame.index + 1), "looking at frames")
            if frame.index % every or (not video.known_rate and rows and 0 <= frame.time - rows[-1][1] < NEAREST):
                continue
            grey = frame.grey(DETAIL)
            scale = TRACKED / max(grey.shape)
            small = cv2.resize(grey, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA) if scale < 1 else grey
            rows.append((frame.index, round(frame.time, 6), sharpness(grey), motion.add(small)))
        about = (video.width, video.height, round(video.duration, 3), video.maker, video.hdr, video.damaged)
    if not rows:
        raise UnreadableVideo("unreadable: no frame in it can be decoded (truncated?)")
    return FirstReading(*about, *(list(column) for column in zip(*rows, strict=True)))


def _written(name: str, path: Path, place: int, numbers: list[int], max_side: int, found: FirstReading, reader: Reader) -> dict[int, Path]:
    """The second reading: the chosen frames as PNG by number, or those that an earlier call wrote."""
    folder, file = reader.work / f"frames_{place}", reader.work / f"frames_{place}.json"
    targets = {number: folder / f"{number:06d}.png" for number in numbers}
    if noted(file, list[int], once(reader.warn), same_as(numbers)) is not None:
        return targets
    remove(folder)
    folder.mkdir(parents=True)
    left = set(numbers)
    with _naming(name), opened(path, 1 if found.damaged else reader.threads) as video:
        for frame in video.frames():
            reader.safe_point()
            if frame.index in left:
                exif = Image.Exif()
                exif[Base.Make] = video.maker or f"video {name}"  # photographs of one maker and size share a camera
                write_png(frame.rgb(max_side), targets[frame.index], compress_level=FAST, durable=False, exif=exif)
                left.remove(frame.index)
                reader.progress(len(numbers) - len(left), len(numbers), "writing frames")
            if not left:
                break
    if left:
        raise UnreadableVideo(f"{name}: unreadable: {len(left)} frames that were there a moment ago are not. Was the file changed?")
    note(file, numbers, list(targets.values()))
    return targets
