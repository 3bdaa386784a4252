"""Readers of scratch that a killed stage goes on from, and of the trained field."""

from __future__ import annotations

import contextlib
import json
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from benchmarks.fuzz import datasets, json_text, lines, safetensors_bytes
from benchmarks.fuzz.reader import Opened, Reader

QUICK = {"iterations": 13, "sample_batch_size": 256, "log2_hashmap_size": 6, "occupancy_resolution": 4}


@cache
def _trainer() -> Any:
    import torch

    from efficientnerf.geometry.spaces import space_from
    from efficientnerf.model import model
    from efficientnerf.training import loop
    from stages.io import field_file
    from tests.efficientnerf.balls import BOUNDS, settings

    torch.set_num_threads(1)
    assert field_file
    return loop.trainer(model(space_from(BOUNDS, contracted=False), settings(**QUICK), (1.0, 1.0, 1.0), "cpu", (1.0, 5.0)), 4)


def _digest(t: Any) -> str:
    from efficientnerf.training.loop import state_of
    from stages.io.field_file import digest_of

    return digest_of({name: tensor.detach() for name, tensor in state_of(t).items()})


def checkpoint_seeds() -> list[bytes]:
    import tempfile

    from efficientnerf.training.loop import state_of
    from stages.io.field_file import write_tensors

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "checkpoint.safetensors"
        write_tensors(state_of(_trainer()), {"step": 5, "seconds": 1.5}, path)
        return [path.read_bytes()]


def field_changed(rng: Random, data: bytes) -> bytes:
    """A change of the tensors, the metadata or the file, the digest put right in most."""
    kind = rng.random()
    found = safetensors_bytes.with_metadata(rng, data, "field") if kind < 0.35 else safetensors_bytes.changed(rng, data)
    return found if rng.random() < 0.15 else with_digest(found)


def with_digest(data: bytes) -> bytes:
    """The file with the SHA-256 of its tensors in its metadata."""
    from safetensors.torch import load

    from stages.io.field_file import digest_of

    parts = safetensors_bytes.parts(data)
    if parts is None:
        return data
    with contextlib.suppress(Exception):
        about = json.loads(parts[0]["__metadata__"]["field"])
        about["sha256"] = digest_of(load(data))
        return safetensors_bytes.joined({**parts[0], "__metadata__": {"field": json.dumps(about)}}, parts[1])
    return data


def open_checkpoint(folder: Path) -> Opened:
    """Restoring takes all of a checkpoint or nothing of it."""
    from efficientnerf.training.loop import restore, state_of
    from pipeline.stage import Job
    from stages.training.checkpoints import Checkpoints

    t = _trainer()
    job = Job(settings=None, out=folder / "out", work=folder / "work")
    before = {name: tensor.detach().clone() for name, tensor in state_of(t).items()}
    digest = _digest(t)

    def read(data: bytes) -> None:
        (job.work / "checkpoint_00000005.safetensors").write_bytes(data)
        try:
            seconds = Checkpoints(job).restore(t)
            taken = (job.work / "checkpoint_00000005.safetensors").exists()
            assert np.isfinite(seconds), "seconds that are not finite"
            assert taken or _digest(t) == digest, "half of a refused checkpoint was restored"
        finally:
            restore(t, before)
            for left in job.work.iterdir():
                left.unlink()

    return Opened(read)


def field_seeds() -> list[bytes]:
    import tempfile

    from stages.io.field_file import save_model

    t = _trainer()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "field.safetensors"
        save_model(t.model, 1.0, 5.0, path, {"images/a.png": np.ones(3), "images/b.png": np.ones(3)}, t.schedule)
        return [path.read_bytes()]


def open_field(folder: Path) -> Opened:
    from stages.artifacts import TrainOutputs
    from stages.io.field_file import load_gains, load_renderer

    def read(data: bytes) -> None:
        TrainOutputs(folder).field.write_bytes(data)
        load_renderer(folder)
        load_gains(folder)

    return Opened(read)


def log_seeds() -> list[bytes]:
    row = {"step": 10, "seconds": 1.5, "step_seconds": 0.1, "loss": 0.1, "psnr": 10.0, "preview_psnr": None, "rays": 100, "occupied": 0.5}
    return [b"".join(json.dumps({**row, "step": step, "preview_psnr": 12.5 if step == 20 else None}).encode() + b"\n" for step in (10, 20, 30))]


def log_changed(rng: Random, data: bytes) -> bytes:
    """A line's JSON, or lines."""
    rows = data.split(b"\n")
    at = rng.randrange(len(rows))
    if rng.random() < 0.7 and rows[at]:
        rows[at] = json_text.changed(rng, rows[at])
        return b"\n".join(rows)
    return lines.changed(rng, data)


def open_log(folder: Path) -> Opened:
    """The log that training goes on with, and the curve of it."""
    from stages.figures import plots
    from stages.training.log import TrainLog, read_lines

    path = folder / "log.jsonl"

    def read(data: bytes) -> None:
        path.write_bytes(data)
        TrainLog(path, 20, 1.0, lambda: 0.5, lambda: 0.0).flush()
        assert all(line["step"] <= 20 for line in read_lines(path)), "a line after the step"
        curve, plots.curve = plots.curve, lambda *_, **__: None  # drawing takes a hundred times longer than reading
        try:
            TrainLog(path, 20, 1.0, lambda: 0.5, lambda: 0.0).draw_curve(folder / "curve.png")
        finally:
            plots.curve = curve

    return Opened(read)


def schedule_seeds() -> list[bytes]:
    return [json.dumps(_trainer().schedule.state()).encode()]


def open_schedule(folder: Path) -> Opened:
    from stages.training.budget import FILE, Budget
    from tests.efficientnerf.balls import settings

    chosen = settings(**QUICK, time_budget=10.0)

    def read(data: bytes) -> None:
        (folder / FILE).write_bytes(data)
        budget = Budget(chosen, folder)
        budget.schedule.fraction(5)
        budget.after(5)

    return Opened(read)


def open_blocks(folder: Path) -> Opened:
    """Arrays that a bake goes on from."""
    from stages.baking.scratch import read_npy

    path = folder / "block_000000.npy"

    def read(data: bytes) -> None:
        path.write_bytes(data)
        read_npy(path)

    return Opened(read)


READERS = {
    reader.name: reader
    for reader in (
        Reader("checkpoint", "checkpoints of a training run", checkpoint_seeds, field_changed, open_checkpoint),
        Reader("field", "field.safetensors, the trained field", field_seeds, field_changed, open_field, share=0.25),
        Reader("log", "log.jsonl of a training run", log_seeds, log_changed, open_log, share=0.25),
        Reader("schedule", "schedule.json of a time budget", schedule_seeds, json_text.changed, open_schedule, share=0.25),
        Reader("blocks", "arrays that a bake goes on from", datasets.npy_seeds, datasets.npy_changed, open_blocks, share=0.25),
    )
}
