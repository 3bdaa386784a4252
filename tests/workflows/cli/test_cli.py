"""The command line over toy stages: what it prints, records, exits with."""

import json
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.run import Run
from tests.workflows.command import Enerf, Result
from workflows.report.documents import ResultVerdict


def recorded(run: Path) -> dict[str, dict[str, object]]:
    settings: dict[str, dict[str, object]] = json.loads((run / "run.json").read_text(encoding="utf-8"))["settings"]
    return settings


def test_a_run_and_its_summary(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    result = enerf("run", toys, "--out", run, "--json")
    assert (result.code, result.err) == (0, "")
    assert (run / "train/field.txt").read_text(encoding="utf-8") == "words 3 0.5 0"
    events = result.objects
    assert [event["event"] for event in events if event["event"].startswith("stage_")] == ["stage_started", "stage_done"] * 3
    assert any(event["event"] == "progress" and event["stage"] == "train" and event["total"] == 3 for event in events)
    last = events[-1]
    assert (last["event"], last["ok"], last["exit_code"], last["metrics"]) == ("summary", True, 0, None)
    assert last["artifacts"] == {"points": str(run / "points/points.ply"), "report": str(run / "report.html")}
    assert set(last["seconds"]) == {"poses", "train", "points"}
    again = enerf("run", "--out", run)
    assert (again.code, again.err.count("up to date")) == (0, 3)
    assert enerf("run", "--out", run, "--quiet") == Result(0, "", "")
    (toys / "b.txt").write_text("odd", encoding="utf-8")
    dry = enerf("run", "--out", run, "--dry-run", "--set", "train.rate=3")
    assert "rate 0.5 -> 3.0" in dry.err
    assert recorded(run)["train"]["rate"] == 0.5
    assert "something is odd" in enerf("run", "--out", run, "--quiet").err
    assert enerf("run", toys, "--out", tmp_path / "other", "--dry-run").code == 0
    assert not (tmp_path / "other").exists()


def test_the_last_word_wins(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    config = tmp_path / "mine.toml"
    config.write_text('preset = "tiny"\nseed = 5\n[train]\nrate = 7\niterations = 8\n', encoding="utf-8")
    run = tmp_path / "run"
    assert enerf("run", toys, "--out", run, "--config", config, "--set", "train.iterations=9", "--until", "poses").code == 0
    assert recorded(run)["train"] == {"iterations": 9, "rate": 7.0, "seed": 5, "fail": ""}
    assert recorded(run)["points"] == {"seed": 5}
    assert enerf("run", toys, "--out", tmp_path / "other", "--config", config, "--preset", "preview", "--seed", "6", "--until", "poses").code == 0
    assert recorded(tmp_path / "other")["train"] == {"iterations": 8, "rate": 7.0, "seed": 6, "fail": ""}


def test_going_on_keeps_what_was_recorded(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    enerf("run", toys, "--out", run, "--preset", "tiny", "--set", "train.seed=4")
    before = recorded(run)
    assert enerf("run", "--out", run).code == 0
    assert recorded(run) == before
    enerf("run", "--out", run, "--set", "train.rate=3")
    assert recorded(run)["train"] == {"iterations": 1, "rate": 3.0, "seed": 4, "fail": ""}
    assert enerf("run", "--out", run, "--preset", "preview").code == 0
    assert recorded(run)["train"] == {"iterations": 3, "rate": 0.5, "seed": 0, "fail": ""}


def test_a_source_may_move_but_not_change(enerf: Enerf, toys: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run, other = tmp_path / "run", tmp_path / "other"
    enerf("run", toys, "--out", run)
    shutil.copytree(toys, other)
    refused = enerf("run", other, "--out", run)
    assert refused.code == 2
    assert str(toys) in refused.err
    assert str(other) in refused.err
    shutil.rmtree(toys)
    for source in ((), (other,)):
        summary = enerf("run", *source, "--out", run, "--json").objects[-1]
        assert [stage["action"] for stage in summary["stages"]] == ["skipped"] * 3
    monkeypatch.chdir(other)
    shutil.rmtree(other)
    assert enerf("status", "run").code == 2, "the working folder is gone"
    assert enerf("status", run).code == 0


def test_some_of_the_stages(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"

    def done(*arguments: object) -> dict[str, str]:
        return {stage["name"]: stage["action"] for stage in enerf(*arguments, "--json").objects[-1]["stages"]}

    assert done("run", toys, "--out", run, "--until", "train") == {"poses": "ran", "train": "ran"}
    assert done("run", "--out", run, "--from", "train") == {"poses": "skipped", "train": "ran", "points": "ran"}
    assert done("stage", "points", run) == {"points": "skipped"}
    assert done("stage", "points", run, "--force") == {"points": "ran"}
    enerf("run", "--out", run, "--set", "train.rate=3", "--until", "poses")
    assert "train is stale" in enerf("stage", "points", run, "--set", "points.seed=2").err
    assert recorded(run)["points"] == {"seed": 2}
    refused = enerf("stage", "points", run, "--set", "train.rate=3")
    assert (refused.code, refused.out) == (2, "")


def test_status_and_verify(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    enerf("run", toys, "--out", run, "--until", "train")
    stages = enerf("status", run, "--json").object["stages"]
    assert [(stage["name"], stage["state"]) for stage in stages] == [("poses", "fresh"), ("train", "fresh"), ("points", "missing")]
    assert (stages[0]["reason"], stages[0]["bytes"], stages[2]["reason"]) == (None, 5, "never run")
    assert enerf("verify", run).code == 0
    (run / "train/field.txt").write_text("other", encoding="utf-8")
    result = enerf("status", run)
    assert (result.code, "field.txt" in result.out) == (0, True)
    broken = enerf("verify", run, "--json")
    assert (broken.code, broken.objects[-1]["damaged"], broken.objects[-1]["ok"]) == (4, ["train/field.txt"], False)
    assert enerf("run", "--out", run).code == 0
    assert enerf("verify", run, "--quiet") == Result(0, "", "")


@pytest.mark.parametrize(("how", "code"), [("bad", 2), ("error", 3), ("disk", 3), ("memory", 3)])
def test_failures_of_stages(enerf: Enerf, toys: Path, tmp_path: Path, how: str, code: int) -> None:
    run = tmp_path / "run"
    result = enerf("run", toys, "--out", run, "--set", f"train.fail={how}")
    assert result.code == code
    assert "Traceback" not in result.err
    failed = enerf("run", "--out", run, "--json")
    last = failed.objects[-1]
    assert (last["event"], last["ok"], last["exit_code"]) == ("summary", False, code)
    assert last["error"] in result.err
    assert len(last["error"].splitlines()) <= 2
    assert "Traceback" in enerf("run", "--out", run, "--debug").err
    assert enerf("run", "--out", run, "--set", "train.fail=").code == 0


@pytest.mark.parametrize(
    ("arguments", "remedy"),
    [
        (["--set", "train.iteration=5"], "train.iterations"),
        (["--preset", "tny"], "tiny"),
        (["--until", "pints"], "points"),
        (["--from", "pints"], "points"),
        (["--config", "/nowhere.toml"], "/nowhere.toml"),
        (["--as", "photograph"], "photographs"),
        (["--device", "cuda"], "CUDA"),
        (["--device", "tpu"], "cpu"),
        (["--memory", "lots"], "8g"),
        (["--frob"], "--frob"),
        (["--seed", "x"], "--seed"),
        (["--fail-on", "good"], "poor"),
    ],
)
def test_usage_errors_leave_nothing_behind(enerf: Enerf, toys: Path, tmp_path: Path, arguments: list[str], remedy: str) -> None:
    result = enerf("run", toys, "--out", tmp_path / "run", *arguments, "--json")
    assert result.code == 2
    assert remedy in result.err
    assert len(result.err.splitlines()) <= 2
    assert (result.objects[-1]["exit_code"], result.objects[-1]["ok"]) == (2, False)
    assert not (tmp_path / "run").exists()


def test_memory_is_recorded_like_the_device_and_makes_nothing_stale(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    run, settings = tmp_path / "run", None
    for options, memory in ((["--memory", "1.5g"], 3 * 2**29), ([], 3 * 2**29), (["--memory", "1000t"], None), (["--memory", "auto"], None)):
        source = () if run.exists() else (toys,)
        result = enerf("run", *source, "--out", run, *options)
        assert result.code == 0
        assert settings in (None, recorded(run))
        settings = recorded(run)
        if memory:
            assert json.loads((run / "run.json").read_text())["memory"] == memory
        else:
            assert ("--memory 1000t" in result.err) == ("1000t" in options), "more than the machine has"
    assert json.loads((run / "run.json").read_text())["memory"] is None


def test_a_run_that_is_being_written_is_left_alone(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    enerf("run", toys, "--out", run)
    before = recorded(run)
    with Run.open(run).locked():
        for more in ((), ("--set", "train.rate=9")):
            result = enerf("run", "--out", run, *more)
            assert (result.code, f"process {os.getpid()}" in result.err) == (5, True)
        assert f"process {os.getpid()}" in enerf("status", run).out
    assert recorded(run) == before
    assert enerf("run", "--out", run).code == 0


def test_presets_are_listed(enerf: Enerf, toys: Path) -> None:
    assert "iterations = 1 " in enerf("presets", "train", "--preset", "tiny").out
    listed = enerf("presets", "--json").object
    assert [preset["name"] for preset in listed["presets"]] == ["preview", "tiny"]
    assert listed["stages"]["train"][0]["meaning"] == "Steps."
    assert enerf("presets", "trian").code == 2


def test_help_names_all_commands(enerf: Enerf) -> None:
    text = enerf("--help").out
    assert enerf() == Result(0, text, "")
    for name in ("run", "stage", "status", "verify", "export", "render", "inspect", "diff", "convert", "view", "presets"):
        assert f"\n  {name} " in text
        assert "--debug" in enerf(name, "--help").out
    assert enerf("--version").out.startswith("enerf")


HEAVY = ("torch", "pycolmap", "cv2", "numba", "matplotlib", "skimage", "scipy", "av", "OpenEXR", "trimesh")


def test_what_has_nothing_to_do_imports_nothing_heavy(tmp_path: Path) -> None:
    """In a process of its own, with the real stages and a run of which nothing has been made (--dry-run keeps it from beginning)."""
    run = str(Run.create(tmp_path / "run", tmp_path).path)
    calls = [["--help"], ["run", "--help"], ["presets"], ["status", run], ["run", "--out", run, "--dry-run"], ["verify", run], ["cache"]]
    calls.append(["doctor", "--seconds", "0"])
    program = (
        "import sys; from workflows.cli.main import main\n"
        f"for arguments in {calls!r}:\n"
        f"    print(arguments, main(arguments), [name for name in {HEAVY!r} if name in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stderr.splitlines()[-1] == f"{calls[-1]} 0 []"
    assert done.stderr.count(" 0 []") == len(calls)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_interrupted_runs_say_how_to_go_on(toys: Path, tmp_path: Path, number: int, code: int) -> None:
    """A process of its own, sent a signal while the toy trains for long."""
    run = tmp_path / f"run {code}"
    program = (
        "import sys, time; import pipeline.stage; from tests.workflows.fleet_child import run\n"
        "known = pipeline.stage.Job.safe_point\n"
        "pipeline.stage.Job.safe_point = lambda job: (time.sleep(0.05), known(job))\n"
        "sys.exit(run(sys.argv[1:]))"
    )
    command = [sys.executable, "-c", program, "run", str(toys), "--out", str(run), "--preset", "preview", "--set", "train.iterations=2000", "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as child:
        assert child.stdout is not None
        next(line for line in child.stdout if json.loads(line)["event"] == "progress")
        child.send_signal(number)
        out, err = child.communicate()
    assert child.returncode == code
    assert f"enerf run --out '{run}'" in err
    assert json.loads(out.splitlines()[-1])["exit_code"] == code


def test_a_second_ctrl_c_at_the_end_prints_no_traceback(tmp_path: Path) -> None:
    program = (
        "import atexit, os, signal, sys, time; from workflows.cli import main; from workflows.inspection import status\n"
        "def interrupted(*_, **__): raise KeyboardInterrupt\n"
        "status.status.callback = interrupted\n"
        "atexit.register(lambda: (os.kill(os.getpid(), signal.SIGINT), time.sleep(5)))\n"
        f"sys.argv[1:] = ['status', {str(tmp_path)!r}]; sys.exit(main.main())"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == -signal.SIGINT  # the process ended at once
    assert "Traceback" not in done.stderr
    assert "interrupted" in done.stderr.lower()


@pytest.mark.parametrize(("grade", "fail_on", "code"), [
    ("failed", None, 0), ("failed", "poor", 6), ("poor", "failed", 0), ("poor", "poor", 6), ("usable", "poor", 0), (None, "poor", 0),
])  # fmt: skip
def test_a_bad_result_is_an_exit_code_where_it_is_asked_for(
    enerf: Enerf, toys: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, grade: str | None, fail_on: str | None, code: int
) -> None:
    monkeypatch.setattr("workflows.cli.run.graded", lambda run, outcomes: None if grade is None else ResultVerdict(grade, f"Result: {grade}."))
    found = enerf("run", toys, "--out", tmp_path / "run", "--json", *([] if fail_on is None else ["--fail-on", fail_on]))
    assert (found.code, found.objects[-1]["exit_code"], found.objects[-1]["ok"]) == (code, code, code == 0)
    assert (tmp_path / "run/points/points.ply").is_file()


def test_a_run_of_an_earlier_version_is_shown_and_goes_on(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    """Its run.json has settings that this version lacks."""
    assert enerf("run", toys, "--out", tmp_path / "run").code == 0
    document = json.loads((tmp_path / "run/run.json").read_text())
    document["settings"]["train"]["gone"] = 1
    (tmp_path / "run/run.json").write_text(json.dumps(document))
    shown = enerf("status", tmp_path / "run", "--json")
    assert shown.code == 0
    assert {stage["state"] for stage in shown.object["stages"]} == {"fresh"}
    again = enerf("run", "--out", tmp_path / "run")
    assert again.code == 0
    assert "train.gone" in again.err
