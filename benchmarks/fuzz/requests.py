"""Readers of what a user hands to a command with the source: a configuration, settings on the command line, a camera path."""

import copy
import json
import shutil
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.fuzz import json_text, lines, toml_text
from benchmarks.fuzz.reader import Opened, Reader
from tests.stages import captures

CONFIG = b"""preset = "tiny"
device = "cpu"
seed = 3

[poses]
max_image_size = 512
crop_box = [-1, -1, -1, 1, 1, 1.0]
up = "auto"
strict = false

[train]
iterations = 200
learning_rate = 0.01
time_budget = "off"

[bake]
[turntable]
frames = 8
background = "#ffffff"
"""
OPTIONS = [
    b"train.iterations=200",
    b"poses.crop_box=0,0,0,1,1,1\nturntable.background=#ffffff",
    b"poses.crop_box=[0,0,0,1,1,1]",
    b"poses.up=auto",
    b"train.time_budget=10m\nposes.strict=true",
]


def open_config(folder: Path) -> Opened:
    """A configuration read and resolved to the settings of every stage."""
    from workflows.cli.resolve import read_config, table_of

    path, source = folder / "config.toml", folder / "source"
    captures.write_pictures(source, ["a.png", "b.png", "c.png"])

    def read(data: bytes) -> None:
        path.write_bytes(data)
        config, settings = read_config(path), _settings()
        settings.put_table(config.table, f"--config {path}")
        json.dumps([table_of(settings.resolved()), dict(config.options)], allow_nan=False)

    command = ("run", str(source), "--out", str(folder / "run"), "--config", str(path), "--dry-run")
    return Opened(read, (command, (*command, "--json")), lambda data: shutil.rmtree(folder / "run", ignore_errors=True))


def open_options(folder: Path) -> Opened:
    """The lines of the input as --set, their values as --budget too."""
    from pipeline.errors import UsageError
    from workflows.cli.resolve import seconds_of, table_of

    def read(data: bytes) -> None:
        refused: Exception | None = None
        for text in filter(None, data[:500].decode("utf-8", "surrogateescape").split("\n")):  # a message repeats what was typed
            settings = _settings()
            for call in (settings.put_option, lambda text: settings.put("train", "time_budget", [seconds_of(text.partition("=")[2])], "--budget")):  # noqa: B023
                try:
                    call(text)
                except UsageError as error:
                    refused = error
            json.dumps(table_of(settings.resolved()), allow_nan=False)
        if refused is not None:
            raise refused

    return Opened(read)


@cache
def _described() -> Any:
    from workflows.asset import WORKFLOW
    from workflows.cli.resolve import Settings

    return Settings({stage.name: stage.settings for stage in WORKFLOW.stages})


def _settings() -> Any:
    """The settings of all stages, none of them set; describing them takes longer than all the rest."""
    settings = copy.copy(_described())
    settings.values = {stage: {} for stage in settings.values}
    return settings


def path_seeds() -> list[bytes]:
    matrix = np.eye(4)
    matrix[2, 3] = 4.0
    entries = [{"camera_to_world": matrix.ravel().tolist(), "fov": 50, "aspect": 1.0} for _ in range(2)]
    document = {"camera_type": "perspective", "render_width": 32, "render_height": 24, "fps": 24, "seconds": 1, "camera_path": entries}
    return [
        json.dumps(each).encode() for each in (document, {**document, "default_fov": 60, "camera_path": [{"camera_to_world": entries[0]["camera_to_world"]}]})
    ]


def open_path(folder: Path) -> Opened:
    """A camera path read, and rendered by the command line at the smallest size."""
    from efficientnerf.asset.format import save
    from efficientnerf.geometry.cameras import Similarity
    from stages.io.camera_path import read_camera_path
    from tests.efficientnerf.hostile import tiny

    path, asset, out = folder / "path.json", folder / "a.nerftree", folder / "frames"
    save(tiny(), asset)

    def read(data: bytes) -> None:
        path.write_bytes(data)
        for size in ({}, {"width": 16}, {"height": 16}):
            for camera in read_camera_path(path, Similarity.identity(), **size).cameras:
                assert np.isfinite(camera.world_from_camera).all(), "a camera that is not finite"
                assert np.isfinite(camera.params).all(), "a lens that is not finite"
                assert 0 < camera.width <= 65536, "a width out of bounds"
                assert 0 < camera.height <= 65536, "a height out of bounds"

    command = ("render", str(asset), "--out", str(out), "--path", str(path), "--width", "16", "--height", "16", "--quiet")
    return Opened(read, (command,), lambda data: shutil.rmtree(out, ignore_errors=True))


READERS = (
    Reader("config", "TOML configurations", lambda: [CONFIG], toml_text.changed, open_config),
    Reader("options", "--set and --budget", lambda: OPTIONS, lines.changed, open_options, share=0.25),
    Reader("camera_path", "camera paths", path_seeds, json_text.changed, open_path, every=100),
)
