"""`enerf presets`."""

from __future__ import annotations

from typing import Any

import click

from workflows.cli.options import common_options, json_option


@click.command(short_help="List presets, and every setting with its default and meaning.")
@click.argument("stages", nargs=-1, metavar="[STAGE]...")
@click.option("--preset", metavar="NAME", help="Show the values of this preset in place of the defaults.")
@json_option
@common_options
def presets(stages: tuple[str, ...], preset: str | None, as_json: bool) -> None:
    """List the presets, and the settings of all stages, or of STAGE..., with their defaults and meaning."""
    from pipeline.errors import UsageError
    from stages.settings import describe_settings
    from workflows import asset
    from workflows.cli.progress import write_json
    from workflows.cli.resolve import Settings, meaning, nearest, preset_names, read_preset, shown, table_of

    types = {stage.name: stage.settings for stage in asset.STAGES}
    for name in stages:
        if name not in types:
            raise UsageError(f"{name}: no such stage.{nearest(name, types)} Stages: {', '.join(types)}.")
    settings = Settings(types)
    if preset is not None:
        settings.put_table(read_preset(preset).table, f"preset {preset}")
    values = table_of(settings.resolved())
    known = [read_preset(name) for name in preset_names()]
    if as_json:
        described: dict[str, Any] = {
            stage: [
                {"name": info.name, "value": values[stage][info.name], "type": info.type_name, "choices": info.choices, "minimum": info.minimum}
                | {"maximum": info.maximum, "unit": info.unit, "meaning": info.doc}
                for info in describe_settings(types[stage])
            ]
            for stage in stages or types
        }
        write_json({"presets": [{"name": each.name, "description": each.description, "settings": each.table} for each in known], "stages": described}, indent=1)
        return
    for each in known:
        click.echo(f"{each.name:<10} {each.description}")
    for stage in stages or types:
        click.echo(f"\n[{stage}]")
        for info in describe_settings(types[stage]):
            value = shown(values[stage][info.name])
            choices = f" One of: {', '.join(shown(choice) for choice in info.choices)}." if info.choices and info.listed else ""
            click.echo(f"{info.name + ' = ' + value:<36} {meaning(info)}{choices}")
