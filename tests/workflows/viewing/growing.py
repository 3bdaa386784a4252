"""A run whose training goes on under our eyes: what it writes step by step."""

import json
from pathlib import Path

from pipeline.artifact import workplace
from pipeline.decide import decide
from pipeline.run import Run
from pipeline.stage import Stage
from tests.workflows.toys import TrainSettings

TRAIN = Stage("train", 1, TrainSettings, (), lambda job: None)
PNG = b"\x89PNG\r\n\x1a\n"


def scratch(run: Run) -> Path:
    """The scratch folder of the stage that is being made."""
    request = decide(TRAIN, run).request
    assert request is not None
    folder = workplace(run.path, "train", request).scratch
    folder.mkdir(parents=True, exist_ok=True)
    return folder


def put(folder: Path, steps: int, previews: list[int], picture: bytes | None = None) -> None:
    """A log of so many steps, and previews: `picture`, or bytes that tell one from another."""
    lines = [{"step": k, "seconds": k / 10, "psnr": 10 + k / 100, "preview_psnr": 9.5 if k in previews else None, "more": [1]} for k in range(steps)]
    (folder / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines), encoding="utf-8")
    for step in previews:
        (folder / f"preview_{step:06d}.png").write_bytes(picture or PNG + bytes([step % 256]))
