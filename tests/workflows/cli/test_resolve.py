"""Settings from presets, files and options: typed, checked, the last word wins."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import pytest
from msgspec import Meta

from efficientnerf.settings import Auto, NonNegative, setting
from pipeline.errors import PipelineError, UnknownSetting, UsageError
from pipeline.run import Run
from pipeline.runner import refuse_what_cannot_work
from stages.settings import describe_settings
from workflows.asset import STAGES
from workflows.cli.resolve import Settings, parse_value, read_config, read_preset, seconds_of, shown, table_of


@dataclass(frozen=True)
class Toy:
    steps: Annotated[int, Meta(ge=1, le=100)] = setting(10, "How many.")
    rate: NonNegative = setting(0.5, "How fast.", unit="per second")
    kind: Literal["plain", "fancy"] = setting("plain", "Which.")
    label: str = setting("", "What to call it.")
    box: tuple[float, float, float] | Auto = setting("auto", "Where.", advanced=True)
    flag: bool = setting(False, "Whether.")
    seed: int = setting(0, "Of the random numbers.")


@dataclass(frozen=True)
class Other:
    steps: int = setting(3, "How many.")


TYPES = {"toy": Toy, "other": Other}


@pytest.mark.parametrize(
    ("option", "expected"),
    [
        ("toy.steps=20", 20),
        ("toy.rate=1", 1.0),
        ("toy.rate=1e-3", 0.001),
        ("toy.kind=fancy", "fancy"),
        ("toy.label=some words", "some words"),
        ("toy.label=8", "8"),
        ('toy.label="8"', "8"),
        ("toy.label=a=b", "a=b"),
        ("toy.label=", ""),
        ("toy.box=[1, 2, 3.5]", (1.0, 2.0, 3.5)),
        ("toy.box=1,2,3", (1.0, 2.0, 3.0)),
        ("toy.box=auto", "auto"),
        ("toy.flag=true", True),
    ],
)
def test_options_are_read_in_the_type_of_the_setting(option: str, expected: object) -> None:
    settings = Settings(TYPES)
    settings.put_option(option)
    name = option.partition("=")[0].partition(".")[2]
    found = getattr(settings.resolved()["toy"], name)
    assert found == expected
    assert type(found) is type(expected)


@pytest.mark.parametrize(
    ("option", "error", "words"),
    [
        ("toy.stepps=1", UnknownSetting, "toy.steps"),
        ("steps=1", UsageError, "stage.name=value"),
        ("toy.steps", UsageError, "stage.name=value"),
        ("tow.steps=1", UnknownSetting, "Nearest: toy."),
        ("toy.steps=many", UsageError, "whole number"),
        ("toy.steps=1.5", UsageError, "whole number"),
        ("toy.steps=true", UsageError, "whole number"),
        ("toy.steps=0", UsageError, "at least 1"),
        ("toy.steps=101", UsageError, "at most 100"),
        ("toy.rate=nan", UsageError, "a number, at least 0"),
        ("toy.rate=inf", UsageError, "finite"),
        ("toy.kind=fancier", UsageError, "plain, fancy"),
        ("toy.box=[1, 2]", UsageError, "3"),
        ("toy.flag=1", UsageError, "true or false"),
        ("toy.label=x\nsteps = 3", None, ""),
    ],
)
def test_what_does_not_fit_is_refused(option: str, error: type[PipelineError] | None, words: str) -> None:
    settings = Settings(TYPES)
    if error is None:
        settings.put_option(option)
        assert settings.resolved()["toy"] == Toy(label=option.partition("=")[2])
        return
    with pytest.raises(error) as caught:
        settings.put_option(option)
    assert words in str(caught.value)
    assert f"--set {option}" in str(caught.value)
    assert caught.value.exit_code == 2
    assert "\n" not in str(caught.value)


def test_the_last_word_wins() -> None:
    settings = Settings(TYPES)
    settings.put_table({"toy": {"steps": 2, "rate": 2}, "other": {"steps": 5}}, "preset")
    settings.put_table({"toy": {"steps": 3}}, "config")
    settings.put_option("toy.seed=1")
    settings.put_seed(7)
    assert settings.resolved() == {"toy": Toy(steps=3, rate=2.0, seed=7), "other": Other(steps=5)}
    assert table_of(settings.resolved())["toy"]["box"] == "auto"


def test_what_a_run_recorded_comes_back() -> None:
    before = Settings(TYPES)
    before.put_option("toy.box=[0, 0, 1]")
    after = Settings(TYPES)
    assert after.put_recorded(table_of(before.resolved())) == []
    assert after.resolved() == before.resolved()


def test_recorded_settings_of_another_version_are_named() -> None:
    settings = Settings(TYPES)
    assert settings.put_recorded({"toy": {"steps": 4, "gone": 1}, "lost": {"x": 1}}) == ["toy.gone", "lost.x"]
    assert settings.resolved()["toy"].steps == 4


def test_config_files(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('preset = "tiny"\nseed = 3\n[toy]\nsteps = 4\nbox = "auto"\n', encoding="utf-8")
    config = read_config(path)
    assert config.options == {"preset": "tiny", "seed": 3}
    settings = Settings(TYPES)
    settings.put_table(config.table, "config")
    assert settings.resolved()["toy"] == Toy(steps=4)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"steps = ", "not valid TOML"),
        (b"\xff\xfe", "not a text file"),
        (b"steps = 3", "outside a table"),
        (b"seed = 'x'", "whole number"),
        (None, "cannot be read"),
    ],
)
def test_broken_config_files(tmp_path: Path, content: bytes | None, words: str) -> None:
    path = tmp_path / "mine.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(PipelineError, match=words) as caught:
        read_config(path)
    assert str(path) in str(caught.value)
    assert caught.value.exit_code == 2


def test_an_unknown_preset_names_the_nearest() -> None:
    with pytest.raises(UsageError, match=r"Nearest: preview\."):
        read_preset("previw")


def test_values_are_shown_as_they_are_given() -> None:
    for value in (True, 3, 0.25, [1, 2], "words"):
        assert value in parse_value(shown(value))


def test_what_settings_say_about_themselves() -> None:
    about = {info.name: info for info in describe_settings(Toy)}
    assert about["rate"].unit == "per second"
    assert about["steps"].minimum == 1
    assert about["kind"].choices == ("plain", "fancy")
    assert about["kind"].listed
    assert not about["box"].listed
    assert (about["box"].advanced, about["steps"].advanced) == (True, False)
    assert about["box"].type_name == "a list of 3, each a number, or auto"
    assert about["steps"].type_name == "a whole number, at least 1, at most 100"


@pytest.mark.parametrize(("text", "seconds"), [("90", 90), ("90s", 90), ("10m", 600), ("1h30m", 5400), ("1.5m", 90), (" 2m30s ", 150), ("0", 0)])
def test_times_are_read(text: str, seconds: float) -> None:
    assert seconds_of(text) == seconds


@pytest.mark.parametrize("text", ["", "soon", "10 minutes", "m", "-3s", "5s1m"])
def test_what_is_no_time_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match=r"--budget .*expected a time, as in 90s, 10m or 1h30m"):
        seconds_of(text)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("turntable.background=pink", "expected auto, white, black, transparent or a colour as #rrggbb"),
        ("turntable.background=#12345", "expected auto, white, black, transparent or a colour as #rrggbb"),
        ("mesh.density_threshold=0", "expected a number, more than 0, or auto"),
        ("points.density_threshold=-3.5", "expected a number, more than 0, or auto"),
    ],
)
def test_values_that_no_stage_can_work_with_are_refused_when_they_are_given(text: str, found: str) -> None:
    settings = Settings({stage.name: stage.settings for stage in STAGES})
    with pytest.raises(UsageError, match=re.escape(found)):
        settings.put_option(text)
    for stage, value in (("turntable", "#00ff7F"), ("turntable", "transparent")):
        settings.put_option(f"{stage}.background={value}")


def test_the_preset_whose_field_cannot_be_baked_is_refused_where_it_would_be(tmp_path: Path) -> None:
    """And a mesh whose normal map has no texture to lie on, before hours of training."""
    run = Run.create(tmp_path / "run", tmp_path, {"train": {"field": "nerf"}, "mesh": {"normal_map": True, "texture": "off"}})
    with pytest.raises(UsageError, match=r"can't be baked"):
        refuse_what_cannot_work(STAGES, run)
    refuse_what_cannot_work(STAGES[:2], run)
    run = Run.create(tmp_path / "other", tmp_path, {"mesh": {"normal_map": True, "texture": "off"}})
    with pytest.raises(UsageError, match=r"mesh\.texture is off"):
        refuse_what_cannot_work(STAGES, run)
    refuse_what_cannot_work(STAGES[:3], run)
