"""The process that toy stages of a fleet run in. Presets lie where ENERF_TOY_PRESETS says."""

from __future__ import annotations

import os
from pathlib import Path

from pipeline.executors.serving import serve
from tests.workflows.toys import TOYS
from workflows.asset import Workflow
from workflows.fleet.program import WorkflowProgram

CHILD = "tests.workflows.fleet_child"
PRESETS = "ENERF_TOY_PRESETS"

if __name__ == "__main__":
    serve(WorkflowProgram(Workflow(TOYS, Path(os.environ[PRESETS]), CHILD)))
