"""Rendering a camera path: PNG and EXR frames, and the video of them."""

from collections import deque
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from efficientnerf.asset.camera_paths import similarity_of
from efficientnerf.asset.rendering import Rendering, render
from efficientnerf.asset.tree import NerfTree
from efficientnerf.geometry.cameras import Camera
from stages.formats.exporters.exr import write_exr
from stages.formats.exporters.frames import NAMED, frame_background, frame_from_rendering, over_background
from stages.formats.exporters.video import write_mp4
from stages.formats.exporters.writing import SourceFrame
from stages.io.png import USUAL, read_png, write_png
from stages.scratch import Warn, note, noted, once

AHEAD = 2  # frames that are rendered and not written yet


@dataclass(frozen=True)
class RenderOptions:
    """How a camera path is rendered."""

    # white, black, transparent or #rrggbb; transparent: PNG with alpha, the video on white; auto: the asset's environment, white where it has none
    background: str = "auto"
    supersample: int = 1  # rays along each side of a pixel
    exr: str = "first"  # "off", "first" or "all": which frames are written as EXR too
    # fps, crf: of the video
    fps: int = 30
    crf: int = 18
    compress_level: int = USUAL  # of the PNGs


def render_frames(
    tree: NerfTree, cameras: Sequence[Camera], folder: Path, options: RenderOptions, progress: Callable[[int, int], None], *, reuse: bool = False,
    draw: Callable[..., Rendering] | None = None, warn: Warn = lambda text: None,
) -> list[Path]:
    """Write frame_0000.png and so on (and .exr) to a folder; returns the files in order.

    progress  called with (frames done, frames) before each and at the end; may raise to stop
    reuse     keep frames that are complete by their note: only for a scratch folder of this very request
    draw      `efficientnerf.asset.rendering.render`, unless another is given
    """
    background, of_capture = frame_background(options.background), SourceFrame(similarity_of(tree), bool(tree.metadata.get("metric", False)))
    surrounded = options.background == "auto" and tree.environment is not None
    if tree.environment is not None and not surrounded:
        tree = replace(tree, environment=None)
    draw, warn = draw or render, once(warn)
    folder.mkdir(parents=True, exist_ok=True)
    written: list[Path] = []
    writing: deque[Future[None]] = deque()
    with ThreadPoolExecutor(1, "frames") as writer:  # a frame is compressed while the next ones are rendered
        for k, camera in enumerate(cameras):
            progress(k, len(cameras))
            png, exr = folder / f"frame_{k:04d}.png", folder / f"frame_{k:04d}.exr"
            with_exr = options.exr == "all" or (options.exr == "first" and k == 0)
            outputs = [png, exr] if with_exr else [png]
            record = folder / f"frame_{k:04d}.json" if reuse else None
            if record is None or noted(record, list[str], warn, partial(_check, outputs, camera)) is None:
                output = draw(tree, camera, supersample=options.supersample, normals=with_exr)
                if surrounded:
                    output = replace(output, opacity=np.ones_like(output.opacity))  # nothing shows through the environment
                writing.append(writer.submit(_write_frame, output, camera, of_capture, background, outputs, record, options.compress_level))
            while len(writing) > AHEAD:
                writing.popleft().result()
            written += outputs
        for frame in writing:
            frame.result()
    progress(len(cameras), len(cameras))
    return written


def _write_frame(
    output: Rendering, camera: Camera, of_capture: SourceFrame, background: tuple[float, float, float] | None, outputs: Sequence[Path],
    record: Path | None, level: int,
) -> None:
    """outputs  a PNG, and an EXR where one is wanted; `record` is their note, None where they are not kept for later."""
    for exr in outputs[1:]:
        passes = {"colour": output.colour, "opacity": output.opacity, "depth": output.depth, "normal": output.normal}
        write_exr(exr, **passes, camera=camera, frame=of_capture)
    write_png(frame_from_rendering(output.colour, output.opacity, background), outputs[0], compress_level=level, durable=record is None)
    if record is not None:
        note(record, [path.name for path in outputs], outputs)


def _check(outputs: Sequence[Path], camera: Camera, value: list[str], names: Collection[str]) -> None:
    """Raises where a frame's files are not all there, or its PNG is none of this size."""
    if {path.name for path in outputs} != {*names}:
        raise ValueError("files are missing")
    if read_png(outputs[0]).shape[:2] != (camera.height, camera.width):
        raise ValueError(f"{outputs[0].name} is of another size")


def encode_frames(frames: Sequence[Path], path: Path, options: RenderOptions, each: Callable[[], None] | None = None) -> None:
    """Encode PNGs as an MP4."""
    write_mp4((over_background(read_png(frame), NAMED["white"]) for frame in frames), path, fps=options.fps, crf=options.crf, each=each)
