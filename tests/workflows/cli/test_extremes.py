"""The lowest and the highest value of every setting: a stage can work with it, or it is refused before the first stage."""

import typing
from collections.abc import Iterator
from typing import Annotated, Any, Literal

import pytest

from pipeline.errors import UsageError
from pipeline.stage import limits_of
from stages.settings import describe_settings
from workflows.asset import STAGES
from workflows.cli.resolve import Settings, read_preset

EVERY = [(stage.name, info) for stage in STAGES for info in describe_settings(stage.settings)]
BOXES = ((0.0,) * 6, (0.0, 0.0, 0.0, 1e-300, 1.0, 1.0), (-1e300, -1e300, -1e300, 1e300, 1e300, 1e300))
# Beside the rest of the preset tiny: a plane without the other, a field that cannot be baked, weights that are not there.
REFUSED = {"train.near_plane", "train.far_plane", "train.field", "evaluate.lpips"}


def parts_of(annotation: Any) -> Iterator[Any]:
    """The numbers and words of an annotation."""
    if typing.get_origin(annotation) in (Annotated, Literal) or annotation in (int, float):
        yield from () if typing.get_args(annotation)[:1] == (str,) else (annotation,)
    else:
        for part in typing.get_args(annotation):
            yield from parts_of(part)


def refused(stage: str, name: str, value: Any) -> bool:
    """Whether it is before the first stage."""
    settings = Settings({each.name: each.settings for each in STAGES})
    settings.put_table(read_preset("tiny").table, "")
    try:
        settings.put(stage, name, [value], "")
        resolved = settings.resolved()
        for each in STAGES:
            if each.check is not None:
                each.check(resolved)
    except UsageError:
        return True
    return False


@pytest.mark.parametrize(("stage", "info"), EVERY, ids=[f"{stage}.{info.name}" for stage, info in EVERY])
def test_every_number_has_a_lowest_and_a_highest_value(stage: str, info: Any) -> None:
    for part in parts_of(info.type):
        values = typing.get_args(part) if typing.get_origin(part) is Literal else limits_of(part)
        assert None not in values
        if info.name != "crop_box" and info.name != "error_map" and f"{stage}.{info.name}" not in REFUSED:
            kind = typing.get_args(part)[0] if typing.get_origin(part) is Annotated else lambda value: value
            assert not any(refused(stage, info.name, kind(value)) for value in values)


@pytest.mark.parametrize("box", BOXES)
def test_an_impossible_crop_box_is_refused_before_the_first_stage(box: tuple[float, ...]) -> None:
    assert refused("poses", "crop_box", box)
    assert not refused("poses", "crop_box", (1.0, 1.0, 1.0, -1.0, -1.0, -1.0))


@pytest.mark.parametrize(
    ("stage", "name", "value"),
    [
        ("train", "time_budget", 1.7e308),
        ("train", "time_budget", 1e-300),
        ("train", "max_rays_per_batch", 2**62),
        ("points", "num_points", 2**62),
        ("train", "pivotal_threshold", 1.0),
        ("bake", "weight_threshold", 1.0),
        ("bake", "max_mib", 0.001),
    ],
)
def test_what_made_a_later_stage_fail_is_refused_before_the_first(stage: str, name: str, value: float) -> None:
    assert refused(stage, name, value)
