from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import pytest
from msgspec import Meta

from pipeline.errors import Interrupted, UnknownSetting, UsageError
from pipeline.stage import Job, settings_dict, settings_from
from tests.pipeline.toy import Events


@dataclass(frozen=True)
class Settings:
    iterations: Annotated[int, Meta(ge=1, le=1000)] = 100
    rate: float = 0.5
    strict: bool = False
    up: Literal["auto", "x", "y", "z"] = "auto"
    colour: tuple[float, float, float] | None = None
    sizes: tuple[Annotated[int, Meta(ge=0)], ...] = (1, 2)
    table: Annotated[int, Meta(ge=8, le=24)] | Literal["auto"] = "auto"
    budget: Annotated[float, Meta(gt=0.0)] | Literal["off"] = "off"
    limit: int | float | None = None
    mode: Literal["a", "b"] = "a"


def test_values_as_json_gives_them_become_the_settings_own_types() -> None:
    made = settings_from(Settings, {"rate": 2, "colour": [1, 0.5, 0], "sizes": [3], "mode": "b", "limit": 3, "table": 8})
    assert made == Settings(rate=2.0, colour=(1.0, 0.5, 0.0), sizes=(3,), mode="b", limit=3, table=8)
    assert (type(made.rate), type(made.limit)) == (float, int)
    assert settings_dict(made)["colour"] == [1.0, 0.5, 0.0]
    assert settings_from(Settings, settings_dict(made)) == made
    assert settings_from(Settings, {"table": "auto"}).table == "auto"


@pytest.mark.parametrize(
    ("name", "value", "remedy"),
    [
        ("iterations", 2.0, "whole number"),
        ("iterations", True, "at least 1"),
        ("iterations", 0, "at least 1"),
        ("iterations", 1001, "at most 1000"),
        ("iterations", 10**400, "at most 1000"),
        ("rate", float("nan"), "finite"),
        ("strict", 1, "true or false"),
        ("strict", None, "true or false"),
        ("up", "Z", "auto, x, y, z"),
        ("up", "aut", "Did you mean auto?"),
        ("colour", [1, 2], "3"),
        ("colour", "red", "none"),
        ("sizes", [1, -1], "at least 0"),
        ("sizes", 3, "list"),
        ("table", 7, "at least 8, at most 24, or auto"),
        ("table", "off", "or auto"),
        ("budget", 0, "more than 0, or off"),
    ],
)
def test_a_wrong_value_is_refused_and_named(name: str, value: object, remedy: str) -> None:
    with pytest.raises(UsageError) as caught:
        settings_from(Settings, {name: value}, where="train")
    text = str(caught.value)
    assert text.startswith(f"train.{name}: ")
    assert remedy in text
    assert "\n" not in text


def test_an_unknown_setting_names_the_nearest() -> None:
    with pytest.raises(UnknownSetting, match=r"train\.iterations\?"):
        settings_from(Settings, {"iteration": 5}, where="train")
    with pytest.raises(UnknownSetting, match="iterations, rate"):
        settings_from(Settings, {"qqq": 5})
    with pytest.raises(UsageError, match="train"):
        settings_from(Settings, [1], where="train")  # type: ignore[arg-type]


def test_progress_is_thinned_but_the_first_and_the_last_arrive(tmp_path: Path) -> None:
    events = Events()
    job = Job(settings=None, out=tmp_path / "o", work=tmp_path / "w", stage="train", report=events)
    for step in range(1, 5001):
        job.progress(step, 5000, psnr=20.0)
    assert 2 <= len(events) < 100
    assert events[0]["done"] == 1
    assert events[-1]["done"] == 5000
    assert {"event", "stage", "time", "total", "text", "psnr"} <= events[-1].keys()


def test_a_safe_point_raises_once_a_signal_has_arrived(tmp_path: Path) -> None:
    events = Events()
    job = Job(settings=None, out=tmp_path / "o", work=tmp_path / "w", report=events, stop=lambda: 15)
    with pytest.raises(Interrupted) as caught:
        job.safe_point()
    assert caught.value.exit_code == 143
    with pytest.raises(Interrupted):
        job.reached(3, 4, "walking")
    assert [(event["done"], event["text"]) for event in events] == [(3, "walking")]
