"""The process that toy stages of a fleet run in, and one that runs such a fleet. Presets lie where ENERF_TOY_PRESETS says."""

import os
from collections.abc import Sequence
from pathlib import Path

from pipeline.executors.serving import serve
from tests.workflows.toys import TOYS
from workflows.fleet.program import WorkflowProgram
from workflows.workflow import Workflow

CHILD = "tests.workflows.fleet_child"
PRESETS = "ENERF_TOY_PRESETS"


def run(arguments: Sequence[str]) -> int:
    """The command line on the toy workflow."""
    from workflows.cli.main import main

    return main(arguments, workflow())


def workflow() -> Workflow:
    return Workflow(TOYS, Path(os.environ[PRESETS]), CHILD)


if __name__ == "__main__":
    serve(WorkflowProgram(workflow()))
