"""The states of a run's stages, as `enerf status --json` and the live page report them."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.decide import Decision
from pipeline.locks.lock import holder_of
from pipeline.run import Run
from stages.artifacts import EvaluateOutputs, PosesOutputs
from workflows.report.documents import Verdict, sound


def run_status(run: Run, decisions: Sequence[Decision]) -> dict[str, Any]:
    """A run, who is writing it, and its stages."""
    holder = holder_of(run.path)
    facts: dict[str, Any] = {"run": str(run.path), "source": run.source, "also": run.also, "preset": run.preset, "seed": run.seed, "device": run.device}
    facts |= {"verdict": camera_verdict(run.path), "result": result_verdict(run.path), "written_by": None if holder is None else holder.text()}
    return {**facts, "stages": [_stage(each) for each in decisions]}


def camera_verdict(run: Path) -> dict[str, Any] | None:
    """The grade of the cameras and a sentence; None where there are none yet, or they say nothing that can be read."""
    return _verdict(PosesOutputs.of_run(run).verdict)


def result_verdict(run: Path) -> dict[str, Any] | None:
    """The same of what was made."""
    return _verdict(EvaluateOutputs.of_run(run).verdict)


def _verdict(path: Path) -> dict[str, Any] | None:
    found = sound(path, Verdict)
    return None if found is None else {"grade": found[0].grade, "summary": found[0].summary}


def _stage(decision: Decision) -> dict[str, Any]:
    made = decision.manifest
    return {
        "name": decision.stage,
        "state": decision.state,
        "reason": decision.reason,
        "note": decision.note,
        "seconds": None if made is None else made.seconds,
        "bytes": None if made is None else made.size,
        "peak_memory": None if made is None else made.peak_memory,
        "digest": None if made is None else made.digest,
        "extra": list(decision.extra),
    }
