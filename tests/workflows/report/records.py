"""Manifests for the tests of pages: of what the artifacts of a run were made."""

import time
from pathlib import Path

from pipeline.manifest import NAME, Manifest, Output, Request, read_manifest
from stages.artifacts import SplatsOutputs
from stages.splats.settings import STAGE as SPLATS


def record(run: Path, stage: str, inputs: dict[str, str] | None = None, sha256: str = "0" * 64) -> None:
    """Write the manifest of a stage's folder, with one output of this digest."""
    (run / stage).mkdir(exist_ok=True)
    time.sleep(0.02)  # a tick of the file system's clock
    (run / stage / NAME).unlink(missing_ok=True)  # a new file sets the folder's ctime, as publishing does
    (run / stage / NAME).write_bytes(Manifest(Request(stage, 1, {}, inputs or {}), {"file": Output(sha256, 1)}).to_bytes())


def record_splats(run: Path) -> None:
    """Write the manifest of Gaussians that are of what the run holds; of inputs without a manifest that, too."""
    for need in SPLATS.needs:
        if not (run / need / NAME).exists():
            record(run, need)
    record(run, SplatsOutputs.stage, {need: read_manifest(run / need).digest for need in SPLATS.needs})
