"""Settings from presets, files and options: typed, checked, the last word wins."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import pytest
from msgspec import Meta

from efficientnerf.settings import Auto, NonNegative, setting
from efficientnerf.training.settings import TrainSettings
from pipeline.errors import PipelineError, UnknownSetting, UsageError
from pipeline.run import Run
from pipeline.runner import refuse_what_cannot_work
from workflows.asset import STAGES
from workflows.cli.resolve import Settings, metres_of, parse_value, read_config, read_preset, seconds_of, shown, table_of


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
        ("toy.rate=1e-3", 0.001),
        ("toy.kind=fancy", "fancy"),
        ("toy.label=8", "8"),
        ('toy.label="8"', "8"),
        ("toy.label=a=b", "a=b"),
        ("toy.label=", ""),
        ("toy.label=x\nsteps = 3", "x\nsteps = 3"),
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
    assert (found, type(found)) == (expected, type(expected))
    assert settings.resolved()["toy"] == Toy(**{name: expected})


@pytest.mark.parametrize(
    ("option", "error", "remedy"),
    [
        ("toy.stepps=1", UnknownSetting, "toy.steps"),
        ("tow.steps=1", UnknownSetting, "toy"),
        ("steps=1", UsageError, "stage.name=value"),
        ("toy.steps", UsageError, "stage.name=value"),
        ("toy.steps=many", UsageError, "whole number"),
    ],
)
def test_what_does_not_fit_is_refused(option: str, error: type[PipelineError], remedy: str) -> None:
    with pytest.raises(error) as caught:
        Settings(TYPES).put_option(option)
    assert remedy in str(caught.value)
    assert f"--set {option}" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_last_word_wins_and_comes_back_from_a_record() -> None:
    settings = Settings(TYPES)
    settings.put_table({"toy": {"steps": 2, "rate": 2}, "other": {"steps": 5}}, "preset")
    settings.put_table({"toy": {"steps": 3}}, "config")
    settings.put_option("toy.box=[0, 0, 1]")
    settings.put_seed(7)
    assert settings.resolved() == {"toy": Toy(steps=3, rate=2.0, seed=7, box=(0.0, 0.0, 1.0)), "other": Other(steps=5)}
    recorded = table_of(settings.resolved())
    again = Settings(TYPES)
    assert again.put_recorded({**recorded, "toy": {**recorded["toy"], "gone": 1}, "lost": {"x": 1}}) == ["toy.gone", "lost.x"]
    assert again.resolved() == settings.resolved()
    for value in (True, 3, 0.25, [1, 2], "words"):
        assert value in parse_value(shown(value))


def test_config_files(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text('preset = "tiny"\nseed = 3\n[toy]\nsteps = 4\nbox = "auto"\n', encoding="utf-8")
    config = read_config(path)
    assert config.options == {"preset": "tiny", "seed": 3}
    settings = Settings(TYPES)
    settings.put_table(config.table, "config")
    assert settings.resolved()["toy"] == Toy(steps=4)


@pytest.mark.parametrize("content", [b"steps = ", b"\xff\xfe", b"steps = 3", b"seed = 'x'", None])
def test_broken_config_files(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "mine.toml"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(PipelineError, match=re.escape(str(path))) as caught:
        read_config(path)
    assert caught.value.exit_code == 2
    with pytest.raises(UsageError, match="preview"):
        read_preset("previw")


@pytest.mark.parametrize(("text", "seconds"), [("90", 90), ("10m", 600), ("1h30m", 5400), ("1.5m", 90), (" 2m30s ", 150), ("0", 0)])
def test_times_are_read(text: str, seconds: float) -> None:
    assert seconds_of(text) == seconds
    for other in ("", "soon", "10 minutes", "m", "-3s", "5s1m"):
        with pytest.raises(UsageError, match="as in 90s, 10m or 1h30m"):
            seconds_of(other)


@pytest.mark.parametrize("text", ["turntable.background=pink", "turntable.background=#12345", "mesh.density_threshold=0", "mesh.density_threshold=-3.5"])
def test_values_that_no_stage_can_work_with_are_refused_when_they_are_given(text: str) -> None:
    settings = Settings({stage.name: stage.settings for stage in STAGES})
    with pytest.raises(UsageError, match=re.escape(text.partition("=")[0])):
        settings.put_option(text)
    for value in ("#00ff7F", "transparent"):
        settings.put_option(f"turntable.background={value}")


def test_the_preset_whose_field_cannot_be_baked_is_refused_where_it_would_be(tmp_path: Path) -> None:
    """Before hours of training."""
    run = Run.create(tmp_path / "run", tmp_path, {"train": {"field": "nerf"}})
    with pytest.raises(UsageError, match="baked"):
        refuse_what_cannot_work(STAGES, run)
    refuse_what_cannot_work(STAGES[:2], run)


@pytest.mark.parametrize(("text", "metres"), [("50mm", 0.05), ("5cm", 0.05), ("0.05m", 0.05), ("2 in", 0.0508)])
def test_lengths_have_a_unit(text: str, metres: float) -> None:
    assert metres_of(text) == pytest.approx(metres, rel=1e-12)
    for other in ("50", "mm", "-5cm", "5 ft", ""):
        with pytest.raises(UsageError, match="expected a length with its unit"):
            metres_of(other)


def test_defaults_of_0_1_that_mean_nothing_now_are_left_out() -> None:
    settings = Settings({"train": TrainSettings})
    assert settings.put_recorded({"train": {"near_plane": 0.0, "far_plane": "auto"}}) == ["train.near_plane"]
    assert settings.resolved()["train"] == TrainSettings()
