"""The sheet of chosen frames: sharpness and motion over time, and the frames themselves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.capture.frame_choice import BLUR, CHOSEN
from stages.figures.axes import COLOURS, GREY, Series, plot
from stages.figures.plots import contact_sheet
from stages.io.png import read_png, write_png

SHOWN = 24  # thumbnails of a video
COLUMNS = 8
THUMBNAIL = 150  # px


def write_frames_sheet(record: Sequence[Mapping[str, Any]], paths: Mapping[str, Path], target: Path) -> None:
    """Write a PNG; a plot and some of the chosen frames of each video, evenly spread.

    record, paths  as of `stages.video.frames.Chosen`
    """
    rows: list[list[np.ndarray | None]] = []
    labels: list[list[str]] = []
    for video in record:
        chosen = [place for place, verdict in enumerate(video["verdict"]) if verdict == CHOSEN]
        picked = [chosen[i] for i in np.unique(np.linspace(0, len(chosen) - 1, min(SHOWN, len(chosen))).astype(int))]
        for first in range(0, len(picked), COLUMNS):
            part = picked[first : first + COLUMNS]
            rows.append([read_png(paths[f"{video['video']}/{video['frame'][place]:06d}.png"]) for place in part])
            labels.append([f"{video['time'][place]:.2f} s  {video['sharpness'][place]:.2f}" for place in part])
    count = sum(video["chosen"] for video in record)
    contact_sheet(rows, labels, target, thumbnail=THUMBNAIL, title=f"{count} frames chosen; some of them: time, sharpness")


def write_frames_plot(record: Sequence[Mapping[str, Any]], target: Path) -> None:
    """Write a PNG: sharpness of all frames over time, of the chosen and of the blurred as dots; motion below."""
    panels = []
    for video in record:
        time, sharp, verdict = np.array(video["time"]), np.array(video["sharpness"]), np.array(video["verdict"])
        series = [Series("all frames", time, sharp, GREY)]
        for which, colour in ((CHOSEN, COLOURS[0]), (BLUR, COLOURS[3])):
            series.append(Series(f"{which}: {int((verdict == which).sum())}", time[verdict == which], sharp[verdict == which], colour, line=False, dots=True))
        motion = Series("motion / diagonals", time, np.array(video["motion"], float), COLOURS[1])
        title = f"{video['video']}: {video['chosen']} of {len(time)} frames"
        panels.append(np.asarray(plot((1000, 320), series, x_label="time / s", y_label="sharpness", title=title, from_zero=True, right=motion)))
    write_png(np.concatenate(panels), target)
