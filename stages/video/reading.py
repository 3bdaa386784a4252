"""Frames of a video file, one after the other, upright and with square pixels.

The demuxer is chosen by the file's first bytes and is handed the open file alone: a playlist under a video's name leads nowhere. Frames are decoded on
several threads, which changes no bit of an intact stream; where one is damaged, what its concealment gives may, and it is read on one thread again.
"""

import os
import stat
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
from av.stream import Disposition
from av.video.reformatter import Colorspace, Interpolation

from pipeline.text import printable
from stages.io.photo import working_size
from stages.io.pictures import ERRORS_OF_THE_MACHINE, MAX_PIXELS, MAX_SIDE
from stages.video import KNOWN

MAX_FRAMES = 1_000_000  # that are looked at
MAX_DAMAGED = 1_000  # packets that cannot be decoded, after which the rest is not tried
FASTEST = 240.0  # frames a second that a file is believed to have; WebM that browsers record states no rate, and FFmpeg takes that of its clock, 1000, for it
USUAL = 30.0  # frames a second of a video of an unknown rate
HD = 720  # rows, from which a video that does not state its matrix has Rec. 709's
_BUFFER = 2**20  # bytes of a read
_TOLERANT: dict[str, Any] = {"metadata_errors": "replace"} if int(version("av").partition(".")[0]) < 19 else {}  # of text that is no UTF-8
_UNSPECIFIED, _PQ, _HLG = 2, 16, 18  # of ITU-T H.273: matrix; transfer characteristics
_FULL_RANGE, _STUDIO_RANGE = 2, 1


class UnreadableVideo(Exception):
    """A video that cannot be used; the text gives the reason, as "unreadable: ..."."""


@dataclass(frozen=True, eq=False)
class Frame:
    """A frame as it was decoded."""

    index: int  # of the frame in the file, from 0
    time: float  # seconds, as the file states it
    _decoded: Any
    _size: tuple[int, int]
    _matrix: tuple[int, int, int, int]

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) as stored."""
        return self._decoded.width, self._decoded.height

    def grey(self, longest: int) -> np.ndarray:
        """(h, w) uint8 luminance, as stored, reduced until the longest side is at most `longest`."""
        scale = min(1.0, longest / max(self.size))
        width, height = (max(2, round(side * scale)) for side in self.size)
        exact = Interpolation.AREA | Interpolation.ACCURATE_RND | Interpolation.BITEXACT
        found = self._decoded.reformat(width=width, height=height, format="gray", interpolation=exact, threads=1, **self._colours())
        return np.asarray(found.to_ndarray())

    def rgb(self, longest: int) -> np.ndarray:
        """(h, w, 3) uint8 sRGB, upright, with square pixels, reduced by area until the longest side is at most `longest`."""
        exact = Interpolation.BICUBIC | Interpolation.ACCURATE_RND | Interpolation.BITEXACT | Interpolation.FULL_CHR_H_INT
        found = self._decoded.reformat(format="rgb24", interpolation=exact, threads=1, **self._colours(), dst_color_range=_FULL_RANGE).to_ndarray()
        pixels = np.ascontiguousarray(upright(np.asarray(found), self._matrix))
        size = working_size(*self._size, longest)
        if pixels.shape[1::-1] == size:
            return pixels
        return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if pixels.shape[1] >= size[0] else cv2.INTER_LINEAR))

    def _colours(self) -> dict[str, Any]:
        frame = self._decoded
        ours = {"src_color_range": frame.color_range or (_FULL_RANGE if frame.format.name.startswith("yuvj") else _STUDIO_RANGE)}
        if frame.colorspace == _UNSPECIFIED:
            ours["src_colorspace"] = Colorspace.ITU709 if min(self.size) >= HD else Colorspace.ITU601
        return {} if frame.format.is_rgb else ours


class Video:
    """An open video."""

    def __init__(self, container: Any, stream: Any) -> None:
        self._container, self._stream = container, stream
        about = {**container.metadata, **stream.metadata}
        names = [str(about.get(f"com.apple.quicktime.{part}") or about.get(f"com.android.{part}") or "") for part in ("make", "manufacturer", "model")]
        self.maker = printable(" ".join(part for part in names if part), 100)  # the camera that took it, where the file says so
        # seconds, as the file states it; 0 where it does not
        self.duration = float(stream.duration * stream.time_base) if stream.duration and stream.time_base else (container.duration or 0) / 1e6
        stated = float(stream.average_rate or stream.guessed_rate or 0)
        self.known_rate = 0 < stated <= FASTEST  # whether the file states its rate; else the times of frames alone tell
        self.rate = stated if self.known_rate else USUAL  # frames a second
        self.count = int(stream.frames or max(1, round(self.duration * self.rate)))  # frames, as the file states or by its duration; an estimate
        self.hdr = {_PQ: "PQ", _HLG: "HLG"}.get(stream.codec_context.color_trc, "")  # where its colours are of high dynamic range
        self.damaged = 0  # packets that could not be decoded, and frames that were left out for it
        self._matrix: tuple[int, int, int, int] | None = None
        aspect = stream.sample_aspect_ratio
        self._aspect = float(aspect) if aspect and 0.1 < float(aspect) < 10 else 1.0
        self.width, self.height = 0, 0  # of its upright frames with square pixels, once there was one
        self.stored = stream.codec_context.width, stream.codec_context.height  # of a frame as stored

    def frames(self) -> Iterator[Frame]:
        """Those that are whole, in the order in which they are shown."""
        time = -1.0 / self.rate
        for index, decoded in enumerate(self._decoded()):
            time = time + 1.0 / self.rate if decoded.pts is None else float(decoded.time)
            if decoded.is_corrupt:
                self.damaged += 1
            else:
                if self._matrix is None:
                    self._matrix = _display_matrix(decoded)
                    wide = (max(1, round(decoded.width * self._aspect)), decoded.height)  # square pixels
                    self.width, self.height = wide if self._matrix[0] else wide[::-1]
                yield Frame(index, time, decoded, (self.width, self.height), self._matrix or (1, 0, 0, 1))
            if index + 1 >= MAX_FRAMES:
                return

    def _decoded(self) -> Iterator[Any]:
        try:
            for packet in self._container.demux(self._stream):
                try:
                    yield from packet.decode()
                except av.error.MemoryError:
                    raise
                except av.error.FFmpegError:
                    self.damaged += 1
                    if self.damaged > MAX_DAMAGED:
                        return
        except av.error.MemoryError as error:
            raise MemoryError(str(error)) from error
        except av.error.FFmpegError:  # the file ends, or makes no sense from here on
            self.damaged += 1


@contextmanager
def opened(path: Path, threads: int = 1) -> Iterator[Video]:
    """A video file. Raises UnreadableVideo, also for a file without a stream of pictures; OSError where it cannot be read now."""
    try:
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        with os.fdopen(descriptor, "rb") as file:
            if not stat.S_ISREG(os.fstat(descriptor).st_mode):
                raise UnreadableVideo("unreadable: not a regular file")
            name = _format(file.read(12))
            file.seek(0)
            limits = {"max_pixels": str(MAX_PIXELS)}
            with av.open(file, "r", format=name, options=limits, buffer_size=_BUFFER, **_TOLERANT) as container:
                # the largest stream of pictures that is no cover
                streams = [each for each in container.streams.video if not each.disposition & Disposition.attached_pic and each.codec_context is not None]
                if not streams:
                    raise UnreadableVideo("unreadable: no stream of pictures in it")
                stream = max(streams, key=lambda each: (each.codec_context.width * each.codec_context.height, -each.index))
                width, height = stream.codec_context.width, stream.codec_context.height
                if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and width * height <= MAX_PIXELS):
                    raise UnreadableVideo(f"unreadable: {width}x{height} pixels; at most {MAX_SIDE} a side and {MAX_PIXELS // 10**6} million in all are read")
                stream.codec_context.options = limits
                stream.codec_context.thread_count, stream.codec_context.thread_type = threads, "AUTO"
                yield Video(container, stream)
    except av.error.FFmpegError as error:
        if getattr(error, "errno", None) in ERRORS_OF_THE_MACHINE:
            raise
        raise UnreadableVideo(f"unreadable: {_reason(error)}") from error


def _format(head: bytes) -> str:
    """The name of FFmpeg's demuxer; UnreadableVideo for any other kind of file."""
    if head[4:8] in (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip", b"pnot"):
        return "mov"
    if head[:4] == b"\x1aE\xdf\xa3":
        return "matroska"
    if head[:4] == b"RIFF" and head[8:12] == b"AVI ":
        return "avi"
    raise UnreadableVideo(f"unreadable: no video in a format that is read ({KNOWN}), or damaged at its start")


def _display_matrix(decoded: Any) -> tuple[int, int, int, int]:
    """(a, b, c, d), each -1, 0 or 1: a pixel (x, y) is shown at (a x + c y, b x + d y), as the container states it."""
    data = decoded.side_data.get("DISPLAYMATRIX")
    if data is None:
        return 1, 0, 0, 1
    a, b, _, c, d = np.frombuffer(bytes(data), np.int32)[:5].tolist()
    if abs(a) + abs(d) >= abs(b) + abs(c):
        return (-1 if a < 0 else 1), 0, 0, (-1 if d < 0 else 1)
    return 0, (-1 if b < 0 else 1), (-1 if c < 0 else 1), 0


def upright(pixels: np.ndarray, matrix: tuple[int, int, int, int]) -> np.ndarray:
    """The pixels (H, W, ...) as a container's display matrix (a, b, c, d) shows them."""
    a, b, c, d = matrix
    if not a:
        pixels = pixels.swapaxes(0, 1)
    return pixels[:: -1 if b + d < 0 else 1, :: -1 if a + c < 0 else 1]


def _reason(error: Any) -> str:
    text = printable(error.strerror or str(error), 100)
    return f"{text} (truncated, or not a video)" if "nvalid data" in text else text
