"""Write docs/settings.md and docs/commands.md from the code; with --check, report whether they are up to date."""

from __future__ import annotations

import inspect
import sys
from pathlib import Path

import click

from stages.settings import SettingInfo, describe_settings
from workflows.asset import STAGES
from workflows.cli.main import enerf
from workflows.cli.resolve import meaning, preset_names, read_preset, shown

FOLDER = Path(__file__).parent
COMMON = {  # options of all commands, and two of nearly all
    "--help": "Show this message and exit.",
    "--debug": "Show the traceback of an error, and the output of libraries.",
    "--json": "JSON on standard output instead of text, where a command prints anything.",
    "-q": "Show only warnings and errors, where a command shows progress (`--quiet`).",
}
NOTE = "<!-- Made from the code by `make docs`; changes belong there. -->"


def limits(info: SettingInfo) -> str:
    """What a setting may be, for the third column."""
    if info.choices is not None and info.listed:
        return ", ".join(f"`{shown(choice)}`" for choice in info.choices)
    return info.type_name


def cell(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def settings_page() -> str:
    lines = [
        NOTE,
        "# Settings",
        "",
        "Any of these can be given to `enerf run` as `--set stage.name=value`, or in a TOML file to `--config`. The order is: defaults, preset,",
        "file, `--set`, dedicated options. `auto` leaves a value to be chosen, `off` switches something off.",
        "",
        "| setting | default | may be | meaning |",
        "|---|---|---|---|",
    ]
    described = {stage.name: describe_settings(stage.settings) for stage in STAGES}
    lines += [row(stage, info) for stage, infos in described.items() for info in infos if not info.advanced]
    lines += presets_section()
    lines += ["", "## Advanced"]
    for stage, infos in described.items():
        if any(info.advanced for info in infos):
            lines += ["", f"### {stage}", "", "| setting | default | may be | meaning |", "|---|---|---|---|"]
            lines += [row(stage, info) for info in infos if info.advanced]
    return "\n".join(lines) + "\n"


def row(stage: str, info: SettingInfo) -> str:
    return "| " + " | ".join(cell(column) for column in (f"`{stage}.{info.name}`", f"`{shown(info.default)}`", limits(info), meaning(info))) + " |"


def presets_section() -> list[str]:
    """The presets, and the values that they change."""
    lines = [
        "",
        "## Presets",
        "",
        'A preset is a TOML file in `workflows/presets`. With `inherits = "NAME"` it begins with the values of another preset, and changes some.',
        "",
    ]
    presets = [read_preset(name) for name in preset_names()]
    for preset in presets:
        values = [f"`{stage}.{name}={shown(value)}`" for stage, own in preset.own.items() for name, value in own.items()]
        lines.append(f"- **{preset.name}**: {preset.description}" + (f" As `{preset.inherits}`, but with {', '.join(values)}." if preset.inherits else ""))
    return lines


def command_section(command: click.Command, name: str, above: click.Context) -> list[str]:
    """What a command does and its options, a row each, and those under it."""
    context = click.Context(command, info_name=name, parent=above, max_content_width=2**16)
    usage = " ".join(command.get_usage(context).removeprefix("Usage: ").split())
    lines = ["", f"{'#' * (1 + context.command_path.count(' '))} {context.command_path}", "", f"`{usage}`", "", *paragraphs(command)]
    options = [each for each in command.params if isinstance(each, click.Option) and not COMMON.keys() & {*each.opts}]
    records = [record for each in options if (record := each.get_help_record(context)) is not None]
    if records:
        lines += ["", "| option | meaning |", "|---|---|", *(f"| `{cell(option)}` | {cell(text)} |" for option, text in records)]
    if isinstance(command, click.Group):
        for inner in command.list_commands(context):
            lines += command_section(command.commands[inner], inner, context)
    return lines


def paragraphs(command: click.Command) -> list[str]:
    """The text of a command's help: a line for each paragraph; what is laid out stays as it is."""
    lines = []
    for part in inspect.cleandoc(command.help or "").split("\n\n"):
        text = ["```", *part.splitlines()[1:], "```"] if part.startswith("\b") else [" ".join(part.split())]
        lines += ["", *text] if lines else text
    return lines


def commands_page() -> str:
    context = click.Context(enerf, info_name="enerf", max_content_width=2**16)
    lines = [NOTE, "# Commands", "", *paragraphs(enerf), "", enerf.epilog or "", "", "| common option | meaning |", "|---|---|"]
    lines += [f"| `{option}` | {meaning} |" for option, meaning in COMMON.items()]
    for name in enerf.list_commands(context):
        command = enerf.get_command(context, name)
        assert command is not None
        lines += command_section(command, name, context)
    return "\n".join(lines) + "\n"


PAGES = {"settings.md": settings_page, "commands.md": commands_page}


def main() -> int:
    stale = [name for name, make in PAGES.items() if not (FOLDER / name).exists() or (FOLDER / name).read_text(encoding="utf-8") != make()]
    if "--check" in sys.argv[1:]:
        print("\n".join(f"docs/{name} is out of date; run `make docs`." for name in stale) or "The pages are up to date.")
        return 1 if stale else 0
    for name in stale:
        (FOLDER / name).write_text(PAGES[name](), encoding="utf-8")
        print(f"docs/{name} written")
    return 0


if __name__ == "__main__":
    sys.exit(main())
