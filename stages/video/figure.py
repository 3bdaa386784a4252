"""The sheet of chosen frames: sharpness and motion over time, and the frames themselves."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from efficientnerf.capture.frame_choice import BLUR, CHOSEN
from stages.figures.drawing import new_figure
from stages.figures.plots import contact_sheet
from stages.io.png import read_png

SHOWN = 24  # thumbnails of a video
COLUMNS = 8
THUMBNAIL = 150  # px


def write_frames_sheet(record: Sequence[Mapping[str, Any]], paths: Mapping[str, Path], target: Path) -> None:
    """Write a PNG; a plot and some of the chosen frames of each video, evenly spread.

    record, paths  as of `stages.video.frames.Chosen`
    """
    rows: list[list[np.ndarray]] = []
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
    figure, canvas = new_figure(10.0, 3.2 * len(record), 100)
    for place, video in enumerate(record):
        axes = figure.add_subplot(len(record), 1, place + 1)
        time, sharp, verdict = np.array(video["time"]), np.array(video["sharpness"]), np.array(video["verdict"])
        axes.plot(time, sharp, color="0.75", linewidth=1.0, label="all frames")
        for which, colour in ((CHOSEN, "tab:blue"), (BLUR, "tab:red")):
            axes.plot(time[verdict == which], sharp[verdict == which], ".", color=colour, label=f"{which}: {int((verdict == which).sum())}")
        axes.set(ylabel="sharpness", title=f"{video['video']}: {video['chosen']} of {len(time)} frames", ylim=(0.0, None))
        axes.set_xlabel("time / s")
        axes.legend(frameon=False, loc="lower left")
        other = axes.twinx()
        other.plot(time, np.array(video["motion"]), color="tab:orange", linewidth=1.0)
        other.set_ylabel("motion / diagonals", color="tab:orange")
    # without the program's name and version, for the same bytes
    canvas.print_png(target, metadata={"Software": None})
