"""The command line over toy stages: what it prints, records, exits with."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.workflows.command import Enerf, Result
from workflows.report import summary
from workflows.report.documents import ResultVerdict


def recorded(run: Path) -> dict[str, dict[str, object]]:
    settings: dict[str, dict[str, object]] = json.loads((run / "run.json").read_text(encoding="utf-8"))["settings"]
    return settings


def test_a_run_and_its_summary(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    result = enerf("run", toys, "--out", tmp_path / "run")
    assert result.code == 0
    assert "points.ply" in result.out
    assert "train     done in" in result.err
    assert (tmp_path / "run/train/field.txt").read_text(encoding="utf-8") == "words 3 0.5 0"
    again = enerf("run", "--out", tmp_path / "run")
    assert again.code == 0
    assert "everything is up to date" in again.out
    assert again.err.count("up to date") == 3


def test_json_is_one_object_per_line_and_ends_in_a_summary(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    result = enerf("run", toys, "--out", tmp_path / "run", "--json")
    assert result.err == ""
    events = result.objects
    assert [event["event"] for event in events if event["event"].startswith("stage_")] == ["stage_started", "stage_done"] * 3
    assert any(event["event"] == "progress" and event["stage"] == "train" and event["total"] == 3 for event in events)
    summary = events[-1]
    assert (summary["event"], summary["ok"], summary["exit_code"]) == ("summary", True, 0)
    assert summary["artifacts"] == {"points": str(tmp_path / "run/points/points.ply"), "report": str(tmp_path / "run/report.html")}
    assert set(summary["seconds"]) == {"poses", "train", "points"}
    assert summary["metrics"] is None


def test_quiet_says_nothing_but_warnings(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    assert enerf("run", toys, "--out", tmp_path / "run", "--quiet") == Result(0, "", "")
    (toys / "b.txt").write_text("odd", encoding="utf-8")
    result = enerf("run", "--out", tmp_path / "run", "--quiet")
    assert (result.code, result.out, result.err) == (0, "", "poses     warning: something is odd\n")


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
    result = enerf("run", "--out", run, "--set", "train.rate=3")
    assert "settings changed: rate 2.0 -> 3.0" in result.err
    assert recorded(run)["train"] == {"iterations": 1, "rate": 3.0, "seed": 4, "fail": ""}
    assert enerf("run", "--out", run, "--preset", "preview").code == 0
    assert recorded(run)["train"] == {"iterations": 3, "rate": 0.5, "seed": 0, "fail": ""}


def test_a_source_may_move_but_not_change(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    run, other = tmp_path / "run", tmp_path / "other"
    enerf("run", toys, "--out", run)
    other.mkdir()
    (other / "a.txt").write_text("words", encoding="utf-8")
    refused = enerf("run", other, "--out", run)
    assert refused.code == 2
    assert str(toys) in refused.err
    assert str(other) in refused.err
    assert enerf("run", toys, "--out", run).code == 0
    (toys / "a.txt").unlink()
    toys.rmdir()
    assert enerf("run", "--out", run, "--json").objects[-1]["stages"][0]["action"] == "skipped"
    moved = enerf("run", other, "--out", run, "--json").objects[-1]
    assert [stage["action"] for stage in moved["stages"]] == ["skipped"] * 3
    assert moved["ok"]


def test_a_working_folder_that_is_gone_is_named(enerf: Enerf, toys: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    enerf("run", toys, "--out", tmp_path / "run")
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    refused = enerf("status", "run")
    assert refused.code == 2
    assert "the working folder is gone" in refused.err
    assert enerf("status", tmp_path / "run").code == 0


def test_a_dry_run_does_nothing(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    result = enerf("run", toys, "--out", tmp_path / "run", "--dry-run")
    assert result.code == 0
    assert "would run (never run)" in result.err
    assert not (tmp_path / "run").exists()
    enerf("run", toys, "--out", tmp_path / "run")
    before = recorded(tmp_path / "run")
    result = enerf("run", "--out", tmp_path / "run", "--dry-run", "--set", "train.rate=3")
    assert "settings changed: rate 0.5 -> 3.0" in result.err
    assert recorded(tmp_path / "run") == before


def test_until_and_from(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert [stage["name"] for stage in enerf("run", toys, "--out", run, "--until", "train", "--json").objects[-1]["stages"]] == ["poses", "train"]
    assert not (run / "points").exists()
    done = enerf("run", "--out", run, "--from", "train", "--json").objects[-1]["stages"]
    assert [(stage["name"], stage["action"]) for stage in done] == [("poses", "skipped"), ("train", "ran"), ("points", "ran")]


def test_a_single_stage(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    enerf("run", toys, "--out", run)
    assert enerf("stage", "points", run, "--json").objects[-1]["stages"][0]["action"] == "skipped"
    assert enerf("stage", "points", run, "--force", "--json").objects[-1]["stages"][0]["action"] == "ran"
    enerf("run", "--out", run, "--set", "train.rate=3", "--until", "poses")
    result = enerf("stage", "points", run, "--set", "points.seed=2")
    assert result.code == 0
    assert "train is stale" in result.err
    assert recorded(run)["points"] == {"seed": 2}
    refused = enerf("stage", "points", run, "--set", "train.rate=3")
    assert (refused.code, refused.out) == (2, "")


def test_status_and_verify(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    enerf("run", toys, "--out", run, "--until", "train")
    stages = enerf("status", run, "--json").object["stages"]
    assert [(stage["name"], stage["state"]) for stage in stages] == [("poses", "fresh"), ("train", "fresh"), ("points", "missing")]
    assert stages[0]["reason"] is None
    assert stages[0]["bytes"] == 5
    assert stages[2]["reason"] == "never run"
    assert enerf("verify", run).code == 0
    (run / "train/field.txt").write_text("other", encoding="utf-8")
    result = enerf("status", run)
    assert result.code == 0
    assert "output altered on disk: field.txt" in result.out
    broken = enerf("verify", run, "--json")
    assert broken.code == 4
    assert broken.objects[-1]["damaged"] == ["train/field.txt"]
    assert not broken.objects[-1]["ok"]
    assert enerf("run", "--out", run).code == 0
    assert enerf("verify", run, "--quiet") == Result(0, "", "")


@pytest.mark.parametrize(
    ("how", "code", "words"),
    [("bad", 2, "found nothing, expected something"), ("error", 3, "train: ValueError: first line"), ("disk", 3, "no space"), ("memory", 3, "out of memory")],
)
def test_failures_of_stages(enerf: Enerf, toys: Path, tmp_path: Path, how: str, code: int, words: str) -> None:
    run = tmp_path / "run"
    result = enerf("run", toys, "--out", run, "--set", f"train.fail={how}")
    assert result.code == code
    assert words in result.err
    assert "Traceback" not in result.err
    failed = enerf("run", "--out", run, "--json")
    last = failed.objects[-1]
    assert (last["event"], last["ok"], last["exit_code"]) == ("summary", False, code)
    assert words in last["error"]
    assert len(last["error"].splitlines()) <= 2
    assert enerf("run", "--out", run, "--set", "train.fail=").code == 0


def test_debug_shows_the_traceback(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    result = enerf("run", toys, "--out", tmp_path / "run", "--set", "train.fail=error", "--debug")
    assert result.code == 3
    assert "Traceback" in result.err
    assert 'raise ValueError("first line' in result.err


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--set", "train.iteration=5"], "Nearest: train.iterations."),
        (["--set", "train.iterations=many"], "expected a whole number"),
        (["--preset", "tny"], "Nearest: tiny."),
        (["--until", "pints"], "Nearest: points."),
        (["--from", "pints"], "Nearest: points."),
        (["--config", "/nowhere.toml"], "cannot be read"),
        (["--as", "photograph"], "Did you mean photographs?"),
        (["--device", "cuda"], "no CUDA device was found"),
        (["--device", "tpu"], "'tpu' is not one of"),
        (["--memory", "lots"], "--memory lots: expected a size, as in 512m, 8g or 1.5GiB."),
        (["--frob"], "No such option"),
        (["--seed", "x"], "not a valid integer"),
    ],
)
def test_usage_errors_leave_nothing_behind(enerf: Enerf, toys: Path, tmp_path: Path, arguments: list[str], words: str) -> None:
    result = enerf("run", toys, "--out", tmp_path / "run", *arguments)
    assert result.code == 2
    assert words in result.err
    assert len(result.err.splitlines()) <= 2
    assert not (tmp_path / "run").exists()
    in_json = enerf("run", toys, "--out", tmp_path / "run", *arguments, "--json").objects
    assert in_json[-1]["exit_code"] == 2
    assert not in_json[-1]["ok"]


def test_memory_is_recorded_like_the_device_and_makes_nothing_stale(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert enerf("run", toys, "--out", run, "--memory", "1.5g").code == 0
    assert json.loads((run / "run.json").read_text())["memory"] == 3 * 2**29
    before = recorded(run)
    result = enerf("run", "--out", run)
    assert (result.code, recorded(run)) == (0, before)
    assert json.loads((run / "run.json").read_text())["memory"] == 3 * 2**29
    more = enerf("run", "--out", run, "--memory", "1000t")
    assert (more.code, recorded(run)) == (0, before)
    assert "--memory 1000t" in more.err  # than the machine has
    assert enerf("run", "--out", run, "--memory", "auto").code == 0
    assert json.loads((run / "run.json").read_text())["memory"] is None


def test_a_run_that_is_being_written_is_left_alone(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    from pipeline.run import Run

    run = tmp_path / "run"
    enerf("run", toys, "--out", run)
    before = recorded(run)
    program = f"from pathlib import Path; from pipeline.run import Run\nwith Run.open(Path({str(run)!r})).locked(): print('held', flush=True); input()"
    with subprocess.Popen([sys.executable, "-c", program], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        result = enerf("run", "--out", run)
        assert result.code == 5
        assert f"process {holder.pid}" in result.err
        assert enerf("run", "--out", run, "--set", "train.rate=9").code == 5
        assert f"process {holder.pid}" in enerf("status", run).out
        holder.communicate("\n")
    assert recorded(run) == before
    assert Run.open(run).holder() is None
    assert enerf("run", "--out", run).code == 0


def test_presets_are_listed(enerf: Enerf, toys: Path) -> None:
    text = enerf("presets").out
    assert "tiny" in text
    assert "iterations = 4" in text
    assert "iterations = 1 " in enerf("presets", "train", "--preset", "tiny").out
    listed = enerf("presets", "--json").object
    assert [preset["name"] for preset in listed["presets"]] == ["preview", "tiny"]
    assert listed["stages"]["train"][0]["meaning"] == "Steps."
    assert enerf("presets", "trian").code == 2


def test_help_names_all_commands(enerf: Enerf) -> None:
    text = enerf("--help").out
    for name in ("run", "stage", "status", "verify", "export", "render", "inspect", "diff", "convert", "view", "presets"):
        assert f"\n  {name} " in text
        assert "--debug" in enerf(name, "--help").out
    assert enerf().code in (0, 2)
    assert enerf("--version").out.startswith("enerf, version ")


HEAVY = ("torch", "pycolmap", "cv2", "numba", "matplotlib", "skimage", "scipy", "av", "OpenEXR", "trimesh")


@pytest.mark.parametrize("arguments", [["--help"], ["run", "--help"], ["presets"], ["status", "RUN"], ["run", "--out", "RUN"], ["verify", "RUN"]])
def test_what_has_nothing_to_do_imports_nothing_heavy(tmp_path: Path, arguments: list[str]) -> None:
    """In a process of its own, with the real stages and a run of which nothing has been made (`--until` keeps it from beginning)."""
    program = (
        "import sys; from pathlib import Path; from pipeline.run import Run; from workflows.cli.main import main\n"
        f"Run.create(Path({str(tmp_path / 'run')!r}), Path({str(tmp_path)!r}))\n"
        f"code = main({[str(tmp_path / 'run') if each == 'RUN' else each for each in arguments]!r} + (['--dry-run'] if {'--out' in arguments} else []))\n"
        f"print([name for name in {HEAVY!r} if name in sys.modules], file=sys.stderr); sys.exit(code)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stderr.splitlines()[-1] == "[]"


def test_interrupted_runs_say_how_to_go_on(toys: Path, tmp_path: Path) -> None:
    """A process of its own, sent SIGTERM and SIGINT while the toy trains for long."""
    for number, code in ((signal.SIGTERM, 143), (signal.SIGINT, 130)):
        run = tmp_path / f"run {code}"
        program = (
            "import sys, time; from pathlib import Path; from workflows.asset import Workflow; from tests.workflows.toys import TOYS\n"
            "import pipeline.stage; known = pipeline.stage.Job.safe_point\n"
            "pipeline.stage.Job.safe_point = lambda job: (time.sleep(0.05), known(job))\n"
            f"from workflows.cli.main import main; sys.exit(main(sys.argv[1:], Workflow(TOYS, Path({str(toys.parent / 'presets')!r}))))"
        )
        command = [sys.executable, "-c", program, "run", str(toys), "--out", str(run), "--preset", "preview", "--set", "train.iterations=2000", "--json"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as child:
            assert child.stdout is not None
            for line in child.stdout:
                if json.loads(line)["event"] == "progress":
                    child.send_signal(number)
                    break
            out, err = child.communicate()
        assert child.returncode == code
        assert f"enerf run --out '{run}'" in err
        assert json.loads(out.splitlines()[-1])["exit_code"] == code
        time.sleep(0.01)


def test_another_ctrl_c_while_an_interrupted_process_ends_prints_no_traceback(tmp_path: Path) -> None:
    program = (
        "import atexit, os, signal, sys, time; from workflows.cli import main, state\n"
        "def interrupted(*_, **__): raise KeyboardInterrupt\n"
        "state.status.callback = interrupted\n"
        "atexit.register(lambda: (os.kill(os.getpid(), signal.SIGINT), time.sleep(5)))\n"
        f"sys.argv[1:] = ['status', {str(tmp_path)!r}]; sys.exit(main.main())"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == -signal.SIGINT  # the process ended at once
    assert "Traceback" not in done.stderr
    assert "interrupted" in done.stderr.lower()


@pytest.mark.parametrize(("grade", "fail_on", "code"), [
    ("failed", None, 0), ("failed", "failed", 6), ("failed", "poor", 6), ("poor", "failed", 0), ("poor", "poor", 6), ("usable", "poor", 0), (None, "poor", 0),
])  # fmt: skip
def test_a_bad_result_is_an_exit_code_where_it_is_asked_for(
    enerf: Enerf, toys: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, grade: str | None, fail_on: str | None, code: int
) -> None:
    monkeypatch.setattr(summary, "graded", lambda run, outcomes: None if grade is None else ResultVerdict(grade, f"Result: {grade}."))
    found = enerf("run", toys, "--out", tmp_path / "run", "--json", *([] if fail_on is None else ["--fail-on", fail_on]))
    assert (found.code, found.objects[-1]["exit_code"], found.objects[-1]["ok"]) == (code, code, code == 0)
    assert (tmp_path / "run/points/points.ply").is_file()


def test_a_grade_to_fail_on_is_one_that_is_bad(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    assert enerf("run", toys, "--out", tmp_path / "run", "--fail-on", "good").code == 2
