"""Options that several commands share."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from pipeline.executors.memory import Limit, limit_for, parse_size
from workflows.asset import WORKFLOW
from workflows.workflow import Workflow

C = TypeVar("C", bound=Callable[..., Any])

json_option = click.option("--json", "as_json", is_flag=True, help="JSON on standard output instead of text.")
quiet_option = click.option("--quiet", "-q", is_flag=True, help="Show only warnings and errors.")
force_option = click.option("--force", is_flag=True, help="Replace existing files.")
set_option = click.option("--set", "sets", multiple=True, metavar="STAGE.NAME=VALUE", help="Change a setting; may be repeated. 'enerf presets' lists them.")
device_option = click.option("--device", type=click.Choice(["auto", "cpu", "cuda"]), help="Device to compute on; auto: CUDA if available.")
memory_option = click.option(
    "--memory", metavar="SIZE", help="Memory limit, such as 512m, 8g or 1.5GiB; auto: that of the machine or its control group. Does not change results."
)

crop_option = click.option(
    "--crop", nargs=6, type=float, metavar="X Y Z X Y Z", help="Crop to this box, two opposite corners in the capture's frame, instead of a region."
)


class PathOfAnything(click.Path):
    """A path as it was given; its target is checked later."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if "\0" in str(value):
            self.fail("a path holds no NUL character.", param, ctx)
        return super().convert(value, param, ctx)


folder_type = PathOfAnything(path_type=Path)


def memory_limit(text: str | None) -> Limit | None:
    """The value of --memory, or the machine's limit where it is "auto" or not given. Raises UsageError."""
    return limit_for(None if text in (None, "auto") else parse_size(text), None)


def workflow() -> Workflow:
    """The workflow that `main` was given, or that of this package."""
    context = click.get_current_context(silent=True)
    given: Workflow | None = None if context is None else context.find_root().obj
    return given or WORKFLOW


def common_options(command: C) -> C:
    """--debug, which main() finds by itself, so that it holds for errors of the command line too."""
    return click.option("--debug", is_flag=True, expose_value=False, help="Show the traceback of an error, and the output of libraries.")(command)


def output_options(command: C) -> C:
    """--json, --quiet and the common ones."""
    return json_option(quiet_option(common_options(command)))
