"""Write docs/settings.md and docs/commands.md from the code; with --check, report whether they are up to date."""

from __future__ import annotations

import inspect
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import click

from stages.settings import SettingInfo, describe_settings
from workflows.asset import STAGES
from workflows.cli.main import enerf
from workflows.cli.resolve import meaning, preset_names, read_preset, shown

Record = tuple[str, str]  # an option as it is written, and its meaning
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
            lines += ["", f"### {stage}", "| setting | default | may be | meaning |", "|---|---|---|---|"]
            lines += [row(stage, info) for info in infos if info.advanced]
    return "\n".join(lines) + "\n"


def row(stage: str, info: SettingInfo) -> str:
    return "| " + " | ".join(cell(column) for column in (f"`{stage}.{info.name}`", f"`{shown(info.default)}`", limits(info), meaning(info))) + " |"


def presets_section() -> list[str]:
    """The presets, and the values that they change."""
    lines = [
        "",
        "## Presets",
        'A preset is a TOML file in `workflows/presets`. With `inherits = "NAME"` it begins with the values of another preset, and changes some.',
        "",
    ]
    presets = [read_preset(name) for name in preset_names()]
    for preset in presets:
        values = [f"`{stage}.{name}={shown(value)}`" for stage, own in preset.own.items() for name, value in own.items()]
        lines.append(f"- **{preset.name}**: {preset.description}" + (f" As `{preset.inherits}`, but with {', '.join(values)}." if preset.inherits else ""))
    return lines


def contexts_of(command: click.Command, name: str, above: click.Context) -> Iterator[click.Context]:
    """A command, and those under it."""
    context = click.Context(command, info_name=name, parent=above, max_content_width=2**16)
    yield context
    if isinstance(command, click.Group):
        for inner in command.list_commands(context):
            yield from contexts_of(command.commands[inner], inner, context)


def records_of(context: click.Context) -> list[Record]:
    """The options of a command that are not COMMON, and their meanings."""
    options = [each for each in context.command.params if isinstance(each, click.Option) and not COMMON.keys() & {*each.opts}]
    return [record for each in options if (record := each.get_help_record(context)) is not None]


def command_section(context: click.Context, shared: Sequence[Record]) -> list[str]:
    """What a command does and its options, a row each; of those that many commands have, which."""
    usage = " ".join(context.command.get_usage(context).removeprefix("Usage: ").split())
    text, records = paragraphs(context.command), records_of(context)
    also = "`, `".join(option.split()[0] for option, meaning in records if (option, meaning) in shared)
    lines = ["", f"{'#' * (1 + context.command_path.count(' '))} {context.command_path}", f"`{usage}`: {text[0]}", *text[1:]]
    return lines + table("option", [record for record in records if record not in shared] + ([(also, "As above.")] if also else []))


def table(head: str, records: Sequence[Record]) -> list[str]:
    rows = [f"| `{cell(option)}` | {cell(text)} |" for option, text in records]
    return ["", f"| {head} | meaning |", "|---|---|", *rows] if rows else []


def paragraphs(command: click.Command) -> list[str]:
    """The text of a command's help: a line for each paragraph; what is laid out stays as it is."""
    lines = []
    for part in inspect.cleandoc(command.help or "").split("\n\n"):
        text = ["```", *part.splitlines()[1:], "```"] if part.startswith("\b") else [" ".join(part.split())]
        lines += ["", *text] if lines else text
    return lines


def commands_page() -> str:
    above = click.Context(enerf, info_name="enerf", max_content_width=2**16)
    contexts = [context for name in enerf.list_commands(above) for context in contexts_of(found(enerf.get_command(above, name)), name, above)]
    counts = Counter(record for context in contexts for record in records_of(context))
    shared = [record for record, count in counts.items() if count > 1]
    lines = [NOTE, "# Commands", "", *paragraphs(enerf), "", enerf.epilog or "", *table("common option", [*COMMON.items(), *shared])]
    return "\n".join([*lines, *(line for context in contexts for line in command_section(context, shared))]) + "\n"


def found(command: click.Command | None) -> click.Command:
    assert command is not None
    return command


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
