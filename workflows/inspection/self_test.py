"""`python -m workflows.inspection.self_test FOLDER`: cameras, field and asset of a small made scene, written into an empty folder."""

import sys
from pathlib import Path

from pipeline.run import Run
from pipeline.runner import run_stages
from workflows.asset import WORKFLOW
from workflows.cli.resolve import Settings, Table, read_preset, table_of
from workflows.precompilation.scene import write_scene

# Over the preset tiny: half of its time is plots and repetition, and no kernel depends on these.
SMALLER: Table = {
    "poses": {"format": "colmap"},
    "train": {"iterations": 20, "preview_every": "off"},
    "bake": {"resolution": 24, "refine_steps": 2},
}


def self_test(folder: Path) -> None:
    """Raises what a stage raises. No page is written, and nothing is compiled in the background: both would take the time of the test."""
    write_scene(folder / "source")
    settings = Settings(WORKFLOW.settings)
    settings.put_table(read_preset("tiny", WORKFLOW.presets).table, "preset tiny")
    settings.put_table(SMALLER, "the self-test")
    run_stages(Run.create(folder / "run", folder / "source", table_of(settings.resolved()), device="cpu"), WORKFLOW.stages, device="cpu", until="bake")


if __name__ == "__main__":
    self_test(Path(sys.argv[1]))
