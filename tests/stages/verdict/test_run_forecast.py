"""What a whole run will take, before it."""

from dataclasses import replace
from typing import Any

import pytest

from stages.verdict import run_forecast
from workflows.asset import STAGES

DEFAULTS: dict[str, Any] = {stage.name: stage.settings() for stage in STAGES}
SHOT: dict[str, Any] = {"views": 36, "megapixels": 6.0, "whole": True, "threads": 2, "slower": 1.5}


def seconds(**changes: Any) -> dict[str, float]:
    """Of the stages; changes: settings by `stage__name`, and of the capture and the machine by their names."""
    settings = dict(DEFAULTS)
    for key, value in changes.items():
        stage, _, name = key.partition("__")
        if name:
            settings[stage] = replace(settings[stage], **{name: value})
    return run_forecast.seconds_of(settings, **SHOT | {key: value for key, value in changes.items() if "__" not in key})


def test_each_stage_after_the_cameras_is_forecast() -> None:
    assert set(seconds()) == {stage.name for stage in STAGES} - {"poses"}
    assert all(took > 0 for took in seconds().values())


@pytest.mark.parametrize(
    ("stages", "more"),
    [
        (["train"], {"train__iterations": 2 * DEFAULTS["train"].iterations}),
        (["bake"], {"whole": False}),
        (["mesh"], {"views": 300}),
        (["bake", "evaluate"], {"megapixels": 600.0}),
        (["turntable"], {"turntable__frames": 4 * DEFAULTS["turntable"].frames}),
    ],
)
def test_more_of_it_takes_longer_and_nothing_else_does(stages: list[str], more: dict[str, Any]) -> None:
    before, after = seconds(), seconds(**more)
    assert [name for name in before if after[name] != before[name]] == stages
    assert all(after[stage] > 1.2 * before[stage] for stage in stages)


def test_slower_machines_take_longer_and_more_cores_less() -> None:
    before = sum(seconds().values())
    assert sum(seconds(slower=3.0).values()) == pytest.approx(2 * before, rel=1e-2)
    assert 0.28 * sum(seconds(threads=1).values()) < sum(seconds(threads=64).values()) < 0.5 * before


def test_a_packed_asset_holds_more_voxels_in_as_many_bytes_and_takes_longer() -> None:
    assert seconds(bake__layout="packed", bake__max_mib=8.0, whole=False)["bake"] > 3 * seconds(bake__max_mib=8.0, whole=False)["bake"]
    packed = {"bake": replace(DEFAULTS["bake"], layout="packed", max_mib=8.0)}
    compact = {"bake": replace(DEFAULTS["bake"], max_mib=8.0)}
    assert run_forecast.bytes_of(DEFAULTS | packed, megapixels=6.0, whole=False) > run_forecast.bytes_of(DEFAULTS | compact, megapixels=6.0, whole=False)


def test_large_captures_of_whole_scenes_have_larger_assets() -> None:
    few, many = (run_forecast.bytes_of(DEFAULTS, megapixels=megapixels, whole=True) for megapixels in (6.0, 600.0))
    assert few == run_forecast.bytes_of(DEFAULTS, megapixels=600.0, whole=False) < many
