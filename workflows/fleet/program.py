"""The workflow's part of a fleet, unknown to the engine: how a scene becomes a run, what is shown of it, its pages. As a program it is the process that
stages run in, which `pipeline.executors.child` starts."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pipeline.executors.serving import serve
from pipeline.run import NAME, Run
from pipeline.runner import refuse_what_cannot_work
from pipeline.stage import Stage, settings_of
from stages.artifacts import BakeOutputs, EvaluateOutputs
from workflows.asset import WORKFLOW
from workflows.cli.request import Options, plan_run
from workflows.cli.target import resume_command
from workflows.inspection.status import camera_verdict, result_verdict
from workflows.report.documents import Metrics, sound
from workflows.report.pages import has_pages, write_pages
from workflows.workflow import Workflow

_PARTS = ("network", "asset", "mesh", "splats")


@dataclass(frozen=True)
class WorkflowProgram:
    """`pipeline.executors.serving.Program` of a workflow."""

    workflow: Workflow

    @property
    def stages(self) -> Sequence[Stage]:
        return self.workflow.stages

    def prepare(self, run: Path, scene: dict[str, Any], memory: int | None) -> list[str]:
        """As `enerf run` does it: of a run that is there, settings that the manifest does not have become those of its preset again."""
        preset = scene["preset"] or (self._open(run).preset if (run / NAME).is_file() else None)
        sources = [Path(source) for source in scene["sources"]]
        facts = {"preset": preset, "seed": scene["seed"], "table": scene["settings"], "share": memory}
        options = Options(source=sources[0] if sources else None, also=tuple(sources[1:]), **facts)
        plan = plan_run(run, self.workflow, options)
        with plan.written() as written:
            refuse_what_cannot_work(self.stages, written)
            return plan.warnings

    def describe(self, run: Path) -> dict[str, Any]:
        """The verdicts on its cameras and on what was made, PSNR and SSIM of that, and the size of its asset."""
        measured = sound(EvaluateOutputs.of_run(run).metrics, Metrics)
        found = {} if measured is None else measured[1]
        shown = {part: {name: found[part].get(name) for name in ("psnr", "ssim")} for part in _PARTS if found.get(part)}
        try:
            size = BakeOutputs.of_run(run).asset.stat().st_size
        except OSError:
            size = 0
        return {"metrics": shown, "bytes": size, "verdict": camera_verdict(run), "result": result_verdict(run)}

    def needs(self, run: Path, stage: str, device: str, memory: int | None) -> tuple[int, int | None]:
        opened = self._open(run)
        about = stage, run, tuple(opened.sources.values()), settings_of(self.stages, opened.settings)
        return self.workflow.space(*about, memory), self.workflow.memory(*about, device)

    def _open(self, run: Path) -> Run:
        return Run.open(run, resume_command, frozenset(stage.name for stage in self.stages))

    def is_finished(self, run: Path) -> bool:
        return has_pages(self._open(run), self.stages)

    def finish(self, run: Path) -> None:
        opened = self._open(run)
        with opened.locked():
            write_pages(opened, self.stages)


if __name__ == "__main__":
    serve(WorkflowProgram(WORKFLOW))
