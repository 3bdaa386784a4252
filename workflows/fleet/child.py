"""The process that stages of a fleet run in; `pipeline.executors.child` starts it."""

from pipeline.executors.serving import serve
from workflows.asset import WORKFLOW
from workflows.fleet.program import WorkflowProgram

if __name__ == "__main__":
    serve(WorkflowProgram(WORKFLOW))
