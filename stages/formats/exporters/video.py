"""MP4 with H.264, 4:2:0, Rec. 709, index in front: what every browser plays. The same frames are the same bytes."""

from collections.abc import Callable, Iterable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.reformatter import ColorRange, Colorspace, Interpolation

from pipeline.files import atomic


def write_mp4(frames: Iterable[np.ndarray], path: Path, *, fps: int, crf: int = 18, each: Callable[[], None] | None = None) -> int:
    """Encode frames; returns how many.

    frames  (H, W, 3) uint8 sRGB, all of one size; an odd width or height is padded by repeating the last column or row
    crf     x264's quality, 0 lossless to 51 worst
    each    called before each frame; may raise to stop

    The file appears whole or not at all. Raises ValueError where there is no frame or their sizes differ.
    """
    count, size = 0, None
    # bitexact: no names or versions of libraries, no dates. One thread: x264's decisions depend on their number. cpu-independent: x264's kernels for
    # AVX-512 lookahead kernels vary from run to run; without them every processor writes the same bytes.
    encoding = {"crf": str(crf), "preset": "medium", "flags": "+bitexact", "x264-params": "cpu-independent=1"}
    options = {"movflags": "+faststart", "fflags": "+bitexact"}
    with atomic(path) as temporary, av.open(str(temporary), "w", format="mp4", container_options=options) as container:
        stream = container.add_stream("libx264", rate=fps, options=encoding)
        stream.thread_count = 1
        stream.pix_fmt = "yuv420p"
        stream.time_base = Fraction(1, fps)
        for attribute in ("colorspace", "color_primaries", "color_trc", "color_range"):
            setattr(stream.codec_context, attribute, 1)  # Rec. 709, studio range: untagged video is guessed at by its size
        for frame in frames:
            if each is not None:
                each()
            if size is None:
                size = frame.shape
                stream.width, stream.height = size[1] + size[1] % 2, size[0] + size[0] % 2
            if frame.shape != size:
                raise ValueError(f"{path}: frame {count} has shape {frame.shape}, the first has {size}")
            # Rec. 709 YCbCr 4:2:0, studio range, padded to even sides
            height, width = frame.shape[:2]
            even = np.pad(frame, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
            video_frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(even), format="rgb24").reformat(
                format="yuv420p",
                src_color_range=ColorRange.JPEG,
                dst_colorspace=Colorspace.ITU709,
                dst_color_range=ColorRange.MPEG,
                interpolation=Interpolation.BICUBIC | Interpolation.ACCURATE_RND | Interpolation.BITEXACT,
                threads=1,
            )
            # Not the stream's time base: the container changes that when it writes its header.
            video_frame.pts, video_frame.time_base = count, Fraction(1, fps)
            container.mux(stream.encode(video_frame))
            count += 1
        if not count:
            raise ValueError(f"{path}: a video of no frames")
        container.mux(stream.encode())
    return count
