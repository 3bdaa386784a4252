"""Small videos made for tests: a textured picture that a camera moves over."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np

WIDTH, HEIGHT = 96, 64
LOSSLESS = {"libx264": {"qp": "0", "preset": "ultrafast"}, "libvpx-vp9": {"lossless": "1", "deadline": "realtime", "cpu-used": "8"}}


def texture(seed: int = 0, side: int = 400) -> np.ndarray:
    """(side, side, 3) uint8: soft spots of many sizes."""
    random = np.random.default_rng(seed)
    picture = sum(cv2.resize(random.normal(0, size, (side // size, side // size, 3)), (side, side), interpolation=cv2.INTER_CUBIC) for size in (4, 8, 20, 40))
    spread = np.asarray(picture) * 26 / np.std(picture)
    return np.clip(128 + spread, 0, 255).astype(np.uint8)


def pan(count: int, step: float = 3.0, *, width: int = WIDTH, height: int = HEIGHT, blur: Sequence[int] = (), length: int = 9) -> list[np.ndarray]:
    """Frames of a camera that moves over a texture by `step` pixels a frame; those of `blur` are blurred along the motion by `length` pixels."""
    picture = texture(side=max(height + 8, round(width + count * abs(step)) + 8))
    frames = []
    for index in range(count):
        start = index * step if step >= 0 else (index - count + 1) * step
        shift = np.array([[1.0, 0.0, -start], [0.0, 1.0, -4.0]])
        frame = cv2.warpAffine(picture, shift, (width, height), flags=cv2.INTER_LINEAR)
        frames.append(cv2.blur(frame, (length, 1)) if index in blur else frame)
    return frames


def write_clip(
    path: Path,
    frames: Sequence[np.ndarray],
    *,
    rate: int = 10,
    times: Sequence[int] | None = None,
    rotation: float = 0.0,
    mirrored: bool = False,
    codec: str = "libx264",
    pixels: str = "yuv444p",
    aspect: Fraction | None = None,
    **about: Any,
) -> Path:
    """Encode frames, without loss but for rounding.

    times     of each frame, in milliseconds
    rotation  counterclockwise, degrees, that the container asks for
    about     attributes of the codec context
    """
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate, options=LOSSLESS.get(codec, {}))
        stream.width, stream.height, stream.pix_fmt = frames[0].shape[1], frames[0].shape[0], pixels
        stream.thread_count = 1
        stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        for name, value in about.items():
            setattr(stream.codec_context, name, value)
        if aspect is not None:
            stream.codec_context.sample_aspect_ratio = aspect
        if rotation or mirrored:
            stream.set_display_rotation(rotation, hflip=mirrored)
        for index, frame in enumerate(frames):
            made = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
            colour = {"dst_colorspace": about.get("colorspace", 5), "dst_color_range": about.get("color_range", 1)}
            made = made.reformat(format=pixels, src_color_range=2, **colour)
            made.pts, made.time_base = (index * 1000 // rate if times is None else times[index]), Fraction(1, 1000)
            container.mux(stream.encode(made))
        container.mux(stream.encode())
    return path
