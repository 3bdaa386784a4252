"""Output that cannot be written: the result of the command decides its exit code, and nothing ends in a traceback or in Python's own code 120."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from pipeline.run import Run
from pipeline.runner import verify
from tests.workflows.toys import TOYS

BAD = ("full", "closed", "gone")
ONE = [{"stdout": how} for how in BAD] + [{"stderr": how} for how in BAD] + [{"stdin": "closed"}]
STREAMS = [*ONE, *[{"stdout": how, "stderr": how} for how in BAD], dict.fromkeys(("stdin", "stdout", "stderr"), "closed")]
FEW = [*ONE[:3], STREAMS[-1]]  # for commands that differ in little


def called(toys: Path, cases: list[dict[str, Any]], **environment: str) -> list[dict[str, Any]]:
    done = subprocess.run(
        [sys.executable, "-m", "tests.workflows.cli.streams", str(toys.parent / "presets")],
        input=json.dumps(cases),
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, **environment},
    )
    found: list[dict[str, Any]] = json.loads(done.stdout)
    for result in found:
        assert "Traceback" not in result["err"] + result["out"]
        assert "Exception ignored" not in result["err"]
    return found


def expected(streams: dict[str, str], *, as_json: bool, listing: bool) -> int:
    """The code of a command that went well."""
    out = streams.get("stdout", "ok")
    if as_json:
        return 0 if out == "ok" else 3
    return 3 if listing and out in ("full", "closed") else 0


@pytest.mark.parametrize("as_json", [False, True])
def test_a_run_ends_with_its_own_code_whatever_takes_its_output(toys: Path, tmp_path: Path, as_json: bool) -> None:
    more, some = (["--json"], FEW) if as_json else ([], STREAMS)
    cases = [{**streams, "arguments": ["run", str(toys), "--out", str(tmp_path / f"run {k}"), *more]} for k, streams in enumerate(some)]
    for k, (streams, result) in enumerate(zip(some, called(toys, cases), strict=True)):
        assert result["code"] == expected(streams, as_json=as_json, listing=False), (streams, result)
        assert (tmp_path / f"run {k}/points/points.ply").read_text(encoding="utf-8") == "words 3 0.5 0"
        assert (tmp_path / f"run {k}/report.html").is_file()
        if result["code"] == 3 and "stderr" not in streams:
            assert result["err"].startswith("enerf: standard output: ")


@pytest.mark.parametrize("as_json", [False, True])
def test_an_unfinished_run_never_ends_with_0(toys: Path, tmp_path: Path, as_json: bool) -> None:
    more, some = (["--json"], FEW) if as_json else ([], STREAMS)
    fails = {("bad", "error")[k % 2] + f" {k}": streams for k, streams in enumerate(some)}
    cases: list[dict[str, Any]] = [
        {**streams, "arguments": ["run", str(toys), "--out", str(tmp_path / name), "--set", f"train.fail={name.partition(' ')[0]}", *more]}
        for name, streams in fails.items()
    ]
    cases += [{**streams, "arguments": [*arguments, *more]} for streams in FEW for arguments in (["run", "--frob"], ["status", str(tmp_path)])]
    codes = [result["code"] for result in called(toys, cases)]
    assert codes == [2 if name.startswith("bad") else 3 for name in fails] + [2] * 2 * len(FEW)


def test_listings_that_cannot_be_written_end_with_3(toys: Path, tmp_path: Path) -> None:
    run = str(tmp_path / "run")
    cases: list[dict[str, Any]] = [{"arguments": ["run", str(toys), "--out", run]}]
    codes = [0]
    listed = [["status", run], ["presets"], ["--help"]]
    for arguments in (*listed, ["verify", run], ["report", run], ["run", "--out", run]):
        for as_json in (False, True) if arguments in listed[:2] else (False,):
            cases += [{**streams, "arguments": arguments + ["--json"] * as_json} for streams in FEW]
            codes += [expected(streams, as_json=as_json, listing=arguments in listed) for streams in FEW]
    for case, code, result in zip(cases, codes, called(toys, cases), strict=True):
        assert result["code"] == code, (case, result)


def test_what_is_opened_does_not_take_the_place_of_a_closed_stream(toys: Path, tmp_path: Path) -> None:
    """In a shell, from the start of the interpreter: `>&-` leaves descriptor 1 free for the next file."""
    program = (
        "import os, sys, pipeline.files; known = pipeline.files.rename\n"
        "pipeline.files.rename = lambda a, b: (os.write(1, b'stray'), os.write(2, b'stray'), known(a, b))\n"
        "from tests.workflows.fleet_child import run; sys.exit(run(sys.argv[1:]))"
    )
    for streams, code in ((">&- 2>&- <&-", 0), (">&- 2>&- --json", 3)):
        run = tmp_path / streams
        command = f'exec "$0" -c "$1" run "$2" --out "$3" {streams}'
        done = subprocess.run(["sh", "-c", command, sys.executable, program, str(toys), str(run)], capture_output=True, check=False)
        assert done.returncode == code
        assert len(verify(Run.open(run), TOYS)) == 3
        others = [path for path in run.rglob("*") if path.is_file() and path.name != "libraries.log"]  # what is said on descriptor 2 is kept there
        assert b"stray" not in b"".join(path.read_bytes() for path in others)


LOCALES = ({"PYTHONIOENCODING": "ascii"}, {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"})


@pytest.mark.parametrize("locale", LOCALES)
def test_names_show_in_every_locale(toys: Path, tmp_path: Path, locale: dict[str, str]) -> None:
    run = tmp_path / "Bäume \udcff\x1b[31m\n木"
    cases: list[dict[str, Any]] = [{"arguments": ["run", str(toys), "--out", str(run)]}]
    cases += [{"arguments": [name, str(run), *more]} for more in ([], ["--json"]) for name in ("status", "verify", "report")]
    cases += [{"arguments": ["status", str(run / "nothing")]}]
    results = called(toys, cases, **locale)
    assert [result["code"] for result in results] == [0] * 7 + [2]
    for result in results:
        shown = result["out"] + result["err"]
        assert "\x1b" not in shown
        assert all(line for line in shown.splitlines())
    assert json.loads(results[4]["out"])["run"].encode("utf-8", "surrogateescape") == os.fsencode(run)
    assert "\\udcff\\x1b[31m\\n" in results[1]["out"]
