"""The command `enerf`.

Only click is imported here and by the modules of the commands; what a command needs is imported when it runs, so that `--help` answers
at once.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING

import click

from workflows.cli import assets, files, paper, presets, run, state
from workflows.cli.failures import report_failure
from workflows.cli.output import exit_code, watched
from workflows.fleet.command import fleet

if TYPE_CHECKING:
    from workflows.asset import Workflow


INTERRUPTED = 128 + signal.SIGINT  # exit code


@click.group(
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    epilog="Exit codes: 0 done; 2 usage or bad input; 3 a stage failed, or output could not be written; 4 corrupt artifact; 5 run locked; "
    "6 assets differ, or a result that --fail-on names; 130, 143 interrupted.",
)
@click.version_option(package_name="efficientnerf", prog_name="enerf")
def enerf() -> None:
    """Photographs or posed data sets in, a baked 3D asset out.

    \b
    enerf run photos/ --out runs/mine      everything, from photographs to asset, turntable, mesh and points
    enerf run --out runs/mine              resume
    """


for command in (
    run.run,
    run.stage,
    fleet,
    state.check,
    state.status,
    state.verify,
    state.report,
    files.export,
    files.render,
    files.inspect,
    assets.diff,
    assets.convert,
    assets.view,
    presets.presets,
    paper.paper,
):
    enerf.add_command(command)


def main(arguments: Sequence[str] | None = None, workflow: Workflow | None = None) -> int:
    """Run the command line on a workflow, that of `workflows.asset` by default; returns the exit code.

    Errors are one or two lines on standard error, and a JSON object with --json.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    as_json, debug = "--json" in given, "--debug" in given
    with watched(debug=debug) as out:
        try:
            result = enerf.main(args=given, prog_name="enerf", standalone_mode=False, obj=workflow)
            code = result if isinstance(result, int) else 0
        except BaseException as error:
            code = report_failure(error, as_json=as_json, debug=debug)
            if code == INTERRUPTED and arguments is None:
                # The process ends now: another Ctrl-C shall not raise in what Python tidies up, and be printed with a traceback.
                signal.signal(signal.SIGINT, signal.SIG_DFL)
        return exit_code(out, code, as_json=as_json)


if __name__ == "__main__":
    sys.exit(main())
