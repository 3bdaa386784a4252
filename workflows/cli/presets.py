"""`enerf presets`."""

from typing import Any

import click

from stages.settings import SettingInfo, describe_settings
from workflows.cli.options import common_options, json_option, workflow
from workflows.cli.output import listing, write_json
from workflows.cli.resolve import Settings, check_stage, meaning, preset_names, read_preset, shown, table_of


@click.command()
@click.argument("stages", nargs=-1, metavar="[STAGE]...")
@click.option("--preset", metavar="NAME", help="Show the values of this preset instead of the defaults.")
@json_option
@common_options
def presets(stages: tuple[str, ...], preset: str | None, as_json: bool) -> None:
    """List the presets and the main settings with their defaults and meaning, or all settings of the given stages."""
    folder = workflow().presets
    types = workflow().settings
    for name in stages:
        check_stage(name, types)
    settings = Settings(types)
    if preset is not None:
        settings.put_table(read_preset(preset, folder).table, f"preset {preset}")
    values = table_of(settings.resolved())
    known = [read_preset(name, folder) for name in preset_names(folder)]
    described = {stage: describe_settings(types[stage]) for stage in stages or types}
    if as_json:
        listed = [{"name": each.name, "description": each.description, "inherits": each.inherits, "settings": each.table} for each in known]
        write_json({"presets": listed, "stages": {stage: _facts(infos, values[stage]) for stage, infos in described.items()}}, indent=1)
        return
    for each in known:
        listing(f"{each.name:<10} {each.description}")
    for stage, infos in described.items():
        common, advanced = ([info for info in infos if info.advanced == rank] for rank in (False, True))
        if common or stages:
            listing("", f"[{stage}]")
        _list(common, values[stage])
        if stages and advanced:
            listing("", f"[{stage}] advanced")
            _list(advanced, values[stage])
    if not stages:
        count = sum(info.advanced for infos in described.values() for info in infos)
        listing("", f"{count} advanced settings are listed by stage: enerf presets {' '.join(types)}")


def _facts(infos: list[SettingInfo], values: dict[str, Any]) -> list[dict[str, Any]]:
    """Settings as JSON holds them."""
    return [
        {"name": info.name, "value": values[info.name], "type": info.type_name, "choices": info.choices, "minimum": info.minimum, "maximum": info.maximum}
        | {"unit": info.unit, "advanced": info.advanced, "meaning": info.doc}
        for info in infos
    ]


def _list(infos: list[SettingInfo], values: dict[str, Any]) -> None:
    """A line for each setting."""
    for info in infos:
        choices = f" One of: {', '.join(shown(choice) for choice in info.choices)}." if info.choices and info.listed else ""
        listing(f"{info.name + ' = ' + shown(values[info.name]):<36} {meaning(info)}{choices}")
