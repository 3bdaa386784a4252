"""Templates in examples/fleet and manifests in docs/fleet.md: as far as can be checked without the machines that they are for."""

import re
import shlex
import shutil
import subprocess
from pathlib import Path

import pytest

from workflows.asset import WORKFLOW
from workflows.cli.run import run as run_command
from workflows.fleet.command import fleet
from workflows.fleet.manifest import read_manifest

ROOT = Path(__file__).resolve().parents[3]
EXAMPLES = ROOT / "examples" / "fleet"
SCRIPTS = sorted(path.name for path in EXAMPLES.glob("*.sh"))


def test_manifests_of_the_documentation(tmp_path: Path) -> None:
    for name in ("shoots/chair", "shoots/table", "clips"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "clips" / "table.mp4").write_bytes(b"")
    text = (ROOT / "docs" / "fleet.md").read_text(encoding="utf-8")
    for kind in ("toml", "csv"):
        (found,) = re.findall(rf"```{kind}\n(.*?)```", text, re.DOTALL)
        (tmp_path / f"fleet.{kind}").write_text(found, encoding="utf-8")
        assert [scene.name for scene in read_manifest([str(tmp_path / f"fleet.{kind}")], WORKFLOW, tmp_path)] == ["chair", "table"]


@pytest.mark.parametrize("name", SCRIPTS)
def test_scripts_are_shell_and_their_options_exist(name: str) -> None:
    assert shutil.which("sh")
    done = subprocess.run(["sh", "-n", str(EXAMPLES / name)], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    (call,) = re.findall(r"^(?:exec )?enerf fleet (.*)$", (EXAMPLES / name).read_text(encoding="utf-8"), re.MULTILINE)
    words = shlex.split(call)
    run = fleet.commands["run"]
    options = {option for parameter in run.params for option in parameter.opts}
    assert {word for word in words if word.startswith("--")} <= options
    for word in words:
        if word.endswith((".toml", ".csv")):
            assert (EXAMPLES / word).is_file()


def test_snakemake_finds_the_jobs(tmp_path: Path) -> None:
    snakemake = shutil.which("snakemake")
    if snakemake is None:
        pytest.skip("Snakemake is not installed")
    shutil.copytree(EXAMPLES, tmp_path / "fleet")
    (tmp_path / "still_life").symlink_to(ROOT / "examples" / "still_life")
    done = subprocess.run([snakemake, "--dry-run", "--printshellcmds"], cwd=tmp_path / "fleet", capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    calls = re.findall(r"enerf run (.*)", done.stdout + done.stderr)
    assert sorted(calls) == [
        "../still_life --out runs/still-life --preset preview --seed 0 --budget 4m --quiet",
        "../still_life --out runs/still-life-small --preset preview --seed 0 --budget 2m --set bake.max_mib=8 --quiet",
    ]
    options = {option for parameter in run_command.params for option in parameter.opts}
    assert set(re.findall(r"--[a-z-]+", " ".join(calls))) <= options
