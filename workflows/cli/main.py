"""The command `enerf`. The module of a command is imported when the command is used, so that `--help` answers at once."""

import signal
import sys
from collections.abc import Sequence
from importlib import import_module

import click

from pipeline.executors.cores import keep_to_quota
from workflows.cli.failures import report_failure
from workflows.cli.output import exit_code, watched
from workflows.workflow import Workflow

INTERRUPTED = 128 + signal.SIGINT  # exit code


COMMANDS = {  # name -> its module, and what `enerf --help` says of it
    "run": ("workflows.cli.run", "Run all stages on photographs or a data set, or resume a run."),
    "stage": ("workflows.cli.run", "Run one stage on the artifacts of a run."),
    "fleet": ("workflows.fleet.command", "Run many scenes, here or on many machines; a failed scene stops no other."),
    "board": ("workflows.board", "Write a sheet of markers to print, for lengths in metres."),
    "measure": ("workflows.measure", "Measure lengths in a run, or give it metres by lengths that you know."),
    "orient": ("workflows.measure", "Set which way is up in a run, by places on the ground."),
    "check": ("workflows.inspection.check", "Check photographs before a run."),
    "doctor": ("workflows.inspection.doctor", "Show what is installed and what works, for a bug report."),
    "cache": ("workflows.inspection.doctor", "Show or remove compiled kernels and features."),
    "status": ("workflows.inspection.status", "Show which stages are up to date, and why not."),
    "verify": ("workflows.cli.verify", "Check every file against its recorded hash."),
    "report": ("workflows.report.pages", "Write a page about a run: renders, metrics, settings."),
    "export": ("workflows.cli.files", "Write meshes, points, splats, volumes, a viewer or cameras."),
    "render": ("workflows.cli.files", "Render a turntable, or the cameras of a JSON path."),
    "inspect": ("workflows.cli.files", "Describe an asset, a run, a data set, a mesh or points."),
    "diff": ("workflows.inspection.compare", "Compare two assets: metadata, tensors, renders."),
    "convert": ("workflows.inspection.convert", "Write an asset in another layout, resolution or degree."),
    "view": ("workflows.viewing.serving", "Show a run or an asset in a browser."),
    "presets": ("workflows.cli.presets", "List presets and settings with their defaults and meaning."),
}


class _Commands(click.Group):
    """The commands of the table."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        command: click.Command = getattr(import_module(COMMANDS[cmd_name][0]), cmd_name)
        return command

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl([(name, COMMANDS[name][1]) for name in sorted(COMMANDS)])


@click.group(
    cls=_Commands,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110},
    epilog="Exit codes: 0 done; 2 usage or bad input; 3 a stage failed, or output could not be written; 4 corrupt artifact; 5 run locked; "
    "6 assets differ, or --fail-on applies; 130, 143 interrupted.",
)
@click.version_option(package_name="efficientnerf", prog_name="enerf")
def enerf() -> None:
    """Turn photographs or posed data sets into a baked 3D asset.

    \b
    enerf run photos/ --out runs/mine      everything, from photographs to asset, turntable, mesh and points
    enerf run --out runs/mine              resume
    """


def main(arguments: Sequence[str] | None = None, workflow: Workflow | None = None) -> int:
    """Run the command line on a workflow, that of `workflows.asset` by default; returns the exit code.

    Errors are one or two lines on standard error, and a JSON object with --json.
    """
    given = list(sys.argv[1:] if arguments is None else arguments) or ["--help"]
    as_json, debug = "--json" in given, "--debug" in given
    keep_to_quota()
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
