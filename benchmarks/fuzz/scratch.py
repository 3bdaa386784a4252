"""Readers of scratch that a killed stage goes on from, and of the trained field."""

import contextlib
import dataclasses
import hashlib
import json
import tempfile
from functools import cache
from pathlib import Path
from random import Random
from typing import Any
from unittest import mock

import numpy as np

from benchmarks.fuzz import datasets, json_text, lines, safetensors_bytes
from benchmarks.fuzz.reader import Opened, Reader, bytes_of

QUICK = {"iterations": 13, "sample_batch_size": 256, "log2_hashmap_size": 8, "occupancy_resolution": 4}

STEP = 5  # of the checkpoints
CELLS = 6  # of the error map


@cache
def _trainer() -> Any:
    import torch

    from efficientnerf.geometry.spaces import space_from
    from efficientnerf.model import model
    from efficientnerf.training import loop
    from tests.efficientnerf.balls import BOUNDS, settings

    torch.set_num_threads(1)
    return loop.trainer(model(space_from(BOUNDS, contracted=False), settings(**QUICK), (1.0, 1.0, 1.0), "cpu", (1.0, 5.0)))


def _digest(t: Any) -> str:
    from efficientnerf.training.loop import state_of
    from stages.io.field_file import digest_of

    return digest_of({name: tensor.detach() for name, tensor in state_of(t).items()})


def checkpoint_seeds() -> list[bytes]:
    from efficientnerf.training.loop import state_of
    from stages.io.field_file import write_tensors

    t = dataclasses.replace(_trainer(), step=STEP)
    return [bytes_of(lambda path: write_tensors(state_of(t), {"step": STEP, "seconds": 1.5}, path))]


def field_changed(rng: Random, data: bytes) -> bytes:
    """A change of the tensors, the metadata or the file, the digest put right in most."""
    kind = rng.random()
    found = safetensors_bytes.with_metadata(rng, data, "field") if kind < 0.35 else safetensors_bytes.changed(rng, data)
    return found if rng.random() < 0.15 else with_digest(found)


def with_digest(data: bytes) -> bytes:
    """The file with the SHA-256 of its tensors in its metadata."""
    from safetensors.torch import load

    from stages.io.field_file import digest_of

    return safetensors_bytes.restated(
        data, lambda header, body: {"field": json.dumps({**json.loads(header["__metadata__"]["field"]), "sha256": digest_of(load(data))})}
    )


def open_checkpoint(folder: Path) -> Opened:
    """Restoring takes all of a checkpoint or nothing of it."""
    from efficientnerf.training.loop import restore, state_of
    from pipeline.stage import Job
    from stages.train.checkpoints import Checkpoints

    t = _trainer()
    job = Job(settings=None, out=folder / "out", work=folder / "work")
    t.step = 1  # not that of the checkpoint
    before = {name: tensor.detach().clone() for name, tensor in state_of(t).items()}
    digest = _digest(t)

    path = job.work / f"checkpoint_{STEP:08d}.safetensors"

    def read(data: bytes) -> None:
        path.write_bytes(data)
        try:
            seconds = Checkpoints(job).restore(t, QUICK["iterations"])
            assert np.isfinite(seconds), "seconds that are not finite"
            assert t.step == (STEP if path.exists() else 1), "another step than the checkpoint's"
            assert path.exists() or _digest(t) == digest, "half of a refused checkpoint was restored"
        finally:
            restore(t, before)
            for left in job.work.iterdir():
                left.unlink()

    return Opened(read)


def field_seeds() -> list[bytes]:
    import torch

    from efficientnerf.training.exposure.model import Exposure
    from stages.io.field_file import save_model

    t = _trainer()
    exposure = Exposure(torch.zeros(2, 3), torch.zeros(1, 4), torch.zeros(2, dtype=torch.int64))
    return [bytes_of(lambda path: save_model(t.model, 1.0, 5.0, path, (["images/a.png", "images/b.png"], exposure), t.schedule))]


def open_field(folder: Path) -> Opened:
    from stages.artifacts import TrainOutputs
    from stages.io.field_file import load_exposure, load_renderer

    def read(data: bytes) -> None:
        TrainOutputs(folder).field.write_bytes(data)
        load_renderer(folder)
        load_exposure(folder)

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
    from stages.train import log

    path = folder / "log.jsonl"

    def read(data: bytes) -> None:
        path.write_bytes(data)
        log.TrainLog(path, 20, 1.0, lambda: 0.5, lambda: 0.0).flush()
        assert all(line["step"] <= 20 for line in log.read_lines(path)), "a line after the step"
        with mock.patch.object(log, "curve", lambda path, *_, **__: path.touch()):  # drawing takes a hundred times longer than reading
            log.TrainLog(path, 20, 1.0, lambda: 0.5, lambda: 0.0).draw_curve(folder / "curve.png")

    return Opened(read)


def schedule_seeds() -> list[bytes]:
    return [json.dumps(_trainer().schedule.state()).encode()]


def open_schedule(folder: Path) -> Opened:
    from stages.train.budget import FILE, training_budget
    from tests.efficientnerf.balls import settings

    chosen = settings(**QUICK, time_budget=10.0)

    def read(data: bytes) -> None:
        (folder / FILE).write_bytes(data)
        budget = training_budget(chosen, folder)
        budget.schedule.fraction(5)
        budget.after(5)

    return Opened(read)


def open_blocks(folder: Path) -> Opened:
    """Arrays that a bake goes on from, noted as they are."""
    from stages.bake.scratch import read_arrays
    from stages.scratch import note

    piece = folder / "block_000000"
    path = folder / "block_000000_values.npy"

    def read(data: bytes) -> None:
        path.write_bytes(data)
        note(piece.with_name("block_000000.json"), ["values"], [path])
        arrays = read_arrays(piece, {"values": ("float64", 2)}, lambda text: None)
        assert arrays is None or (arrays["values"].dtype == "float64" and arrays["values"].ndim == 2), "an array of another type"

    return Opened(read)


def note_seeds() -> list[bytes]:
    return [bytes_of(_write_note)]


def _write_note(path: Path) -> None:
    from stages.scratch import note

    files = [path.with_name(name) for name in ("a.png", "b.png")]
    for file in files:
        file.write_bytes(b"pixels")
    note(path, {"name": "a", "asset": {"psnr": 20.5, "width": 4, "ssim": None}}, files)


def note_changed(rng: Random, data: bytes) -> bytes:
    """A change of a value, the digest put right in most."""
    found = json_text.changed(rng, data)
    document = json_text.parsed(found)
    if rng.random() < 0.3 or not isinstance(document, dict):
        return found
    with contextlib.suppress(KeyError, ValueError, RecursionError):
        document["sha256"] = hashlib.sha256(json.dumps([document["value"], document["files"]]).encode()).hexdigest()
        return json.dumps(document).encode()
    return found


def open_note(folder: Path) -> Opened:
    """What a stage noted of a piece that is done."""
    from stages.scratch import noted

    path = folder / "view_00000.json"
    _write_note(path)

    def read(data: bytes) -> None:
        path.write_bytes(data)
        value = noted(path, dict[str, str | dict[str, int | float | None] | None], lambda text: text.encode())
        assert value is None or isinstance(value, dict), "a value of another type"

    return Opened(read)


def _refinement() -> tuple[Any, Any]:
    """A tree and the state of its refinement half way."""
    from efficientnerf.asset.refinement.state import initial_state
    from tests.efficientnerf.hostile import tiny

    tree = tiny()
    state = initial_state(tree, 1.0)
    state.step, state.errors = STEP, np.full((2, CELLS), 0.25, np.float32)
    return tree, state


def refinement_seeds() -> list[bytes]:
    from efficientnerf.asset.refinement.schedule import stated_schedule
    from pipeline.stage import Job
    from stages.bake.refine import checkpoint

    with tempfile.TemporaryDirectory() as folder:
        job = Job(settings=None, out=Path(folder) / "out", work=Path(folder) / "work")
        checkpoint.save(job, checkpoint.Point(_refinement()[1], stated_schedule(2 * STEP)))
        return [(job.work / checkpoint.CHECKPOINT).read_bytes()]


def refinement_changed(rng: Random, data: bytes) -> bytes:
    """A change, the digest put right in most."""
    from safetensors.numpy import load

    from stages.bake.refine.checkpoint import digest_of

    found = safetensors_bytes.changed(rng, data)
    return found if rng.random() < 0.15 else safetensors_bytes.restated(found, lambda header, body: {"sha256": digest_of(load(found))})


def open_refinement(folder: Path) -> Opened:
    """The state that a refinement goes on from."""
    from efficientnerf.asset.refinement.schedule import stated_schedule
    from pipeline.stage import Job
    from stages.bake.refine import checkpoint

    tree, _ = _refinement()
    job = Job(settings=None, out=folder / "out", work=folder / "work")

    def read(data: bytes) -> None:
        (job.work / checkpoint.CHECKPOINT).write_bytes(data)
        found = checkpoint.restored(job, tree, stated_schedule(2 * STEP), cells=CELLS)
        assert found is None or 0 <= found.state.step <= 2 * STEP, "a step out of range"

    return Opened(read)


READERS = (
    Reader("checkpoint", "checkpoints of a training run", checkpoint_seeds, field_changed, open_checkpoint),
    Reader("field", "field.safetensors, the trained field", field_seeds, field_changed, open_field, share=0.25),
    Reader("log", "log.jsonl of a training run", log_seeds, log_changed, open_log, share=0.25),
    Reader("schedule", "schedule.json of a time budget", schedule_seeds, json_text.changed, open_schedule, share=0.25),
    Reader("blocks", "arrays that a bake goes on from", datasets.npy_seeds, datasets.npy_changed, open_blocks, share=0.25),
    Reader("note", "notes of what a stage has done", note_seeds, note_changed, open_note, share=0.25),
    Reader("refinement", "checkpoints of a bake's refinement", refinement_seeds, refinement_changed, open_refinement, share=0.25),
)
