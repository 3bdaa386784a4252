"""The presets that are shipped, against the real stages."""

from __future__ import annotations

import pytest

from workflows import asset
from workflows.resolve import Settings, preset_names, read_preset, table_of

TYPES = {stage.name: stage.settings for stage in asset.STAGES}


def test_the_workflow_is_in_order() -> None:
    names = [stage.name for stage in asset.STAGES]
    assert names == ["poses", "train", "bake", "evaluate", "turntable", "mesh", "points"]
    for place, stage in enumerate(asset.STAGES):
        assert set(stage.needs) <= set(names[:place])


def test_there_are_four() -> None:
    assert preset_names() == ["high", "preview", "standard", "tiny"]


@pytest.mark.parametrize("name", ["tiny", "preview", "standard", "high"])
def test_presets_resolve_and_hold_only_what_differs(name: str) -> None:
    preset = read_preset(name)
    assert preset.description.endswith(".")
    settings = Settings(TYPES)
    settings.put_table(preset.table, name)
    defaults = table_of(Settings(TYPES).resolved())
    resolved = table_of(settings.resolved())
    for stage, entries in preset.table.items():
        for setting in entries:
            assert resolved[stage][setting] != defaults[stage][setting], f"{name}: {stage}.{setting} is the default"


def test_every_setting_says_what_it_means() -> None:
    for stage in asset.STAGES:
        for name, about in Settings(TYPES).about[stage.name].items():
            assert about.doc, f"{stage.name}.{name}"
