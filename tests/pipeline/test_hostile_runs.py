"""The JSON files of a run that anybody may have written: whatever they hold, an error of ours, one line, and never a traceback."""

import contextlib
import hashlib
import itertools
import json
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from pipeline import files
from pipeline.decide import decide, survey
from pipeline.errors import PipelineError, UsageError
from pipeline.hashes import Hashes
from pipeline.locks.lock import holder_of
from pipeline.run import Run
from pipeline.runner import run_stages, verify
from pipeline.stage import settings_from
from tests.pipeline.toy import COUNT, STAGES, CountSettings, make_run


def nested(depth: int) -> Any:
    value: Any = "core"
    for _ in range(depth):
        value = [value]
    return value


VALUES: list[Any] = [
    None, True, -1, 0, 2**63, 10**400, -(10**400), 0.5, 1e300, "", "x", "../../x", "/etc/passwd", "a\0b", "\ud800", "\udcff", "a\nb\x1b[31m", "x" * 100_000,
    [], {}, [[]], {"": 1}, {"\ud800": "\ud800"}, [10**400], nested(90), {"x": nested(95)}, {f"k{i}": i for i in range(3000)},
]  # fmt: skip


TEXTS = [b'{"a": 1e999}', b"[" * 50_000, b"9" * 5000, b"\xff", b'"\\ud800"', b"\0", b"{}{}"]


def mutants(value: Any) -> Iterator[Any]:
    """The document with each of its parts replaced by each of the values, or left out."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield {other: each for other, each in value.items() if other != key}
            for mutant in mutants(item):
                yield {**value, key: mutant}
        yield {**value, "\ud800": 10**400}
    yield from VALUES


def refused(actions: list[Callable[[], object]]) -> set[int]:
    """The exit codes of what the actions raise; everything that is no PipelineError passes."""
    raised = []
    for action in actions:
        try:
            action()
        except PipelineError as error:
            raised.append(error)
    assert all("\n" not in str(error) and len(str(error)) < 3000 for error in raised)
    return {error.exit_code for error in raised}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Run:
    run = make_run(tmp_path_factory.mktemp("made"))
    run_stages(run, STAGES)
    run.cache.parent.mkdir(exist_ok=True)
    return run


@pytest.fixture
def run(made: Run, tmp_path: Path) -> Run:
    shutil.copytree(made.path, tmp_path / "run")
    return Run.open(tmp_path / "run")


def looked_at(run: Path, stages: int = len(STAGES)) -> list[Callable[[], object]]:
    return [
        lambda: survey(STAGES[:stages], Run.open(run)),
        lambda: run_stages(Run.open(run), STAGES[:stages], dry_run=True),
        lambda: verify(Run.open(run), STAGES[:stages]),
    ]


def test_any_run_json(run: Run) -> None:
    good = json.loads((run.path / "run.json").read_text())
    good["settings"] = {"count": {"steps": 6, "name": "a"}}
    for number, value in enumerate(mutants(good)):
        (run.path / "run.json").write_text(json.dumps(value))
        assert refused(looked_at(run.path)[: 2 if number % 10 else 3]) <= {2, 4}


@pytest.mark.parametrize("text", TEXTS, ids=range(len(TEXTS)))
@pytest.mark.parametrize("name", ["run.json", "count/manifest.json", ".lock.json", ".cache/hashes.json"])
def test_any_text(run: Run, name: str, text: bytes) -> None:
    (run.path / name).write_bytes(text)
    assert holder_of(run.path) is None
    assert Hashes(run.cache).digest("k", run.path / "list" / "list.txt")
    everything = looked_at(run.path)
    codes = refused([*everything, lambda: run_stages(Run.open(run.path), STAGES)])
    assert codes <= {2, 4}
    assert bool(codes) == (name in ("run.json", "count/manifest.json"))


def test_any_manifest(run: Run) -> None:
    path = run.folder("count") / "manifest.json"
    good = json.loads(path.read_text())
    good = {**good, "versions": {"python": "3"}, "outputs": {"count.txt": good["outputs"]["count.txt"]}}
    for value in itertools.islice(mutants(good), 0, None, 3):
        if isinstance(value, dict):
            value.pop("checksum", None)
            value["checksum"] = hashlib.sha256(files.canonical_json(value)).hexdigest()
        path.write_text(json.dumps(value))
        assert refused([lambda: decide(COUNT, run), lambda: decide(STAGES[2], run), lambda: verify(run, STAGES[1:2])]) <= {4}


def test_a_manifest_whose_digests_fit(run: Run) -> None:
    """Settings and names of source files of any kind are compared and shown, not obeyed."""
    path = run.folder("list") / "manifest.json"
    good = json.loads(path.read_text())
    for value in VALUES:
        request = {**good["request"], "settings": {"upper": value, "\ud800\x1b[31m": value}, "source": {f"\ud800\n{str(value)[:50]}": "absent"}}
        document = {**good, "request": request, "request_digest": hashlib.sha256(files.canonical_json(request)).hexdigest()}
        document.pop("checksum")
        document["checksum"] = hashlib.sha256(files.canonical_json(document)).hexdigest()
        path.write_text(json.dumps(document))
        decision = survey(STAGES[:1], run)[0]
        assert decision.state == "stale"
        assert "\n" not in str(decision.reason)
        assert len(str(decision.reason)) < 1000


def test_any_holder(run: Run) -> None:
    good = {"pid": 2**22, "host": "elsewhere", "since": 1.0, "command": "enerf"}
    shutil.rmtree(run.path / ".lease")  # nothing but the note says whether it has ended
    for value in mutants(good):
        (run.path / ".lock.json").write_text(json.dumps(value))
        holder = holder_of(run.path)
        if holder is not None:
            assert holder.text().isprintable()
            assert len(holder.text()) < 1000
    with run.locked():
        pass


@pytest.mark.parametrize("name", ["steps", "rate", "name"])
def test_settings_of_any_value(run: Run, name: str) -> None:
    """They are checked by the stage that has them, wherever they come from: a usage error, or a value that it can work with."""
    for value in [*VALUES, float("inf"), float("nan"), {1: 2}, nested(2000)]:
        with contextlib.suppress(UsageError):
            assert abs(settings_from(CountSettings, {name: value}, where="count").steps) < 2**63
        assert refused([lambda value=value: settings_from(CountSettings, {name: value}, where="count")]) <= {2}  # type: ignore[misc]
    with pytest.raises(UsageError):
        settings_from(CountSettings, {"\x1b[31m\ud800" * 1000: 1})
    run.update(settings={**run.settings, "count": {"steps": "many"}})
    for action in (decide, lambda _, run: run_stages(run, STAGES)):
        with pytest.raises(UsageError, match=r"count\.steps"):
            action(COUNT, Run.open(run.path))  # type: ignore[operator]


def test_a_file_larger_than_any_is_not_read(run: Run) -> None:
    for name in ("run.json", "count/manifest.json", ".lock.json", ".cache/hashes.json"):
        former = (run.path / name).read_bytes() if (run.path / name).exists() else None
        with open(run.path / name, "wb") as file:
            file.truncate(2**40)
        assert refused(looked_at(run.path)) <= {2, 4}
        assert holder_of(run.path) is None
        if former is not None:
            (run.path / name).write_bytes(former)
        else:
            os.unlink(run.path / name)
