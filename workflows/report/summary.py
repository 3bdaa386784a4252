"""Summary of a run: its files and metrics."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pipeline.runner import Outcome
from pipeline.text import printable
from stages.artifacts import BakeOutputs, EvaluateOutputs, MeshOutputs, PointsOutputs, PosesOutputs, SplatsOutputs, TrainOutputs, TurntableOutputs
from workflows.cli.progress import duration, size
from workflows.report.documents import Metrics, ResultProblem, ResultVerdict, sound

RUN = Path()
POSES, TRAIN, BAKE, EVALUATE = PosesOutputs.of_run(RUN), TrainOutputs.of_run(RUN), BakeOutputs.of_run(RUN), EvaluateOutputs.of_run(RUN)
TURNTABLE, MESH, POINTS, SPLATS = TurntableOutputs.of_run(RUN), MeshOutputs.of_run(RUN), PointsOutputs.of_run(RUN), SplatsOutputs.of_run(RUN)
# The files of a run that a user wants.
ARTIFACTS = {
    "scene": POSES.scene, "field": TRAIN.field, "asset": BAKE.asset, "metrics": EVALUATE.metrics, "verdict": EVALUATE.verdict,
    "captured_path": EVALUATE.captured_path, "strip_worst": EVALUATE.strip_worst, "strip_median": EVALUATE.strip_median, "strip_best": EVALUATE.strip_best,
    "turntable": TURNTABLE.video, "mesh_glb": MESH.glb, "mesh_obj": MESH.obj, "mesh_ply": MESH.ply, "points": POINTS.ply, "splats_ply": SPLATS.ply,
    "splats_spz": SPLATS.spz, "report": RUN / "report.html", "viewer": RUN / "viewer.html",
}  # fmt: skip
TITLES = {
    "asset": "asset", "captured_path": "video", "strip_worst": "strip", "turntable": "turntable", "mesh_glb": "mesh", "mesh_obj": "mesh", "mesh_ply": "mesh",
    "points": "points", "splats_ply": "splats", "splats_spz": "splats", "report": "report", "viewer": "viewer",
}  # fmt: skip


def artifacts(run: Path) -> dict[str, str]:
    """Name -> absolute path of the files that exist."""
    return {name: str(run / path) for name, path in ARTIFACTS.items() if (run / path).exists()}


def graded(run: Path, outcomes: Sequence[Outcome]) -> ResultVerdict | None:
    """The verdict on the result that these outcomes of stages made; None where they did not come so far. Of no outcomes: the one that is there."""
    reached = not outcomes or any(outcome.stage == EvaluateOutputs.stage for outcome in outcomes)
    found = sound(EvaluateOutputs.of_run(run).verdict, ResultVerdict) if reached else None
    return None if found is None else found[0]


def summary(run: Path, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """The facts of the last line of `enerf run --json`, less `ok` and `exit_code`."""
    outputs = EvaluateOutputs.of_run(run)
    result, metrics = sound(outputs.verdict, ResultVerdict), sound(outputs.metrics, Metrics)
    return {
        "run": str(run),
        "artifacts": artifacts(run),
        "result": None if result is None else result[1],
        "metrics": None if metrics is None else metrics[1],
        "seconds": {outcome.stage: outcome.seconds for outcome in outcomes},
        "stages": [
            {"name": each.stage, "action": each.action, "reason": each.reason, "seconds": each.seconds, "bytes": each.size, "digest": each.digest}
            for each in outcomes
        ],
    }


def in_words(run: Path, outcomes: Sequence[Outcome], elapsed: float) -> list[str]:
    """The summary as lines: the grade of the result first, where it was evaluated.

    elapsed  seconds of the command: less than those of its stages, where some ran side by side
    """
    verdict = graded(run, outcomes)
    ran = [outcome for outcome in outcomes if outcome.action == "ran"]
    if ran:
        parts = ", ".join(f"{outcome.stage} {duration(outcome.seconds)}" for outcome in ran)
        lines = [f"{run}: done in {duration(elapsed)} ({parts})" if len(ran) > 1 else f"{run}: {ran[0].stage} done in {duration(ran[0].seconds)}"]
    else:
        lines = [f"{run}: everything is up to date"]
    if verdict is not None:
        what = lines[0].removeprefix(f"{run}: ")
        lines = [f"{run}: good; {what}"] if verdict.grade == "good" else [f"{run}: {printable(verdict.summary, 400)}", f"  {what}"]
    for name, path in artifacts(run).items():
        if name in TITLES:
            shown = os.path.relpath(path) if not os.path.relpath(path).startswith("..") else path
            lines.append(f"  {TITLES[name]:<10} {shown}  ({size(os.stat(path).st_size)})")
    metrics = sound(EvaluateOutputs.of_run(run).metrics, Metrics)
    found = None if metrics is None else metrics[0]
    if (quality := quality_in_words(found)) is not None:
        lines.append(f"  {'quality':<10} {quality}")
    problems = [] if verdict is None else [problem_in_words(each) for each in verdict.problems]
    return lines + [f"  {'':<10} {text}" for text in (against_network(found), *problems) if text]


def problem_in_words(found: ResultProblem) -> str:
    """A problem of the result, its cause, what to do, and the picture that shows it."""
    return printable(f"{found.grade}: {found.sentence} {found.cause} {found.remedy} ({found.picture})", 1000)


def quality_in_words(found: Metrics | None) -> str | None:
    """`network 24.13 dB PSNR, 0.812 SSIM; asset ...; mesh ...`, on how many views."""
    if found is None:
        return None
    parts = []
    for name, part in (("network", found.network), ("asset", found.asset), ("mesh", found.mesh), ("splats", found.splats)):
        if part is not None and part.psnr is not None and part.ssim is not None:
            parts.append(f"{name} {part.psnr:.2f} dB PSNR, {part.ssim:.3f} SSIM")
    count = len(found.views)
    return "; ".join(parts) + (f" (on {count} {split_of(found)} view{'s' if count != 1 else ''})" if count else "") if parts else None


def against_network(found: Metrics | None) -> str | None:
    """`gap -0.19 dB, -0.012 SSIM; holes 0.02 %; floaters 0.31 %`: the asset against the network, as far as it was measured."""
    if found is None:
        return None
    parts = []
    if found.gap is not None and found.gap.psnr is not None:
        parts.append(f"gap {found.gap.psnr:+.2f} dB" + ("" if found.gap.ssim is None else f", {found.gap.ssim:+.3f} SSIM"))
    parts += [f"{name} {share:.2%}".replace("%", " %") for name, share in (("holes", found.holes), ("floaters", found.floaters)) if share is not None]
    return "; ".join(parts) or None


def split_of(found: Metrics | None) -> str:
    """The split that was measured on: test, unless the figures say otherwise."""
    return {"val": "validation", "train": "training"}.get(found.split, "test") if found is not None else "test"
