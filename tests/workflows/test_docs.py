"""The pages made from the code are up to date, and what the README names exists."""

import re
import subprocess
import sys
from pathlib import Path

import click

ROOT = Path(__file__).resolve().parents[2]


def test_the_pages_are_up_to_date() -> None:
    done = subprocess.run([sys.executable, str(ROOT / "docs/make_pages.py"), "--check"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_links_lead_somewhere() -> None:
    pages = [page for pattern in ("*.md", "docs/**/*.md", "examples/**/*.md", "efficientnerf/**/*.md") for page in ROOT.glob(pattern)]
    links = [(page, link) for page in pages for link in re.findall(r"\]\(([^)]+)\)", page.read_text(encoding="utf-8")) if "://" not in link]
    assert len(links) > 150
    assert [(page.name, link) for page, link in links if not (page.parent / link.partition("#")[0]).exists()] == []


def test_pages_of_experiments_that_the_code_links_exist() -> None:
    sources = [path for folder in ("pipeline", "efficientnerf", "stages", "workflows", "benchmarks") for path in (ROOT / folder).rglob("*.py")]
    names = {name for path in sources for name in re.findall(r"docs/(experiments/[a-z-]+\.md)", path.read_text(encoding="utf-8"))}
    assert len(names) > 25
    assert [name for name in sorted(names) if not (ROOT / "docs" / name).exists()] == []


def test_findings_name_tests_that_exist() -> None:
    rows = [line for line in (ROOT / "docs/trust.md").read_text(encoding="utf-8").splitlines() if ".py`" in line]
    assert len(rows) > 25
    for row in rows:
        source = ""
        for name in re.findall(r"`([^`]+)`", row.split("|")[3]):
            if name.endswith(".py"):
                source = (ROOT / "tests" / name).read_text(encoding="utf-8")
            else:
                assert f"def {name}(" in source, row


def test_commands_of_the_readme_exist() -> None:
    from workflows.cli.main import enerf

    text = (ROOT / "README.md").read_text(encoding="utf-8") + (ROOT / "examples/README.md").read_text(encoding="utf-8")
    calls = re.findall(r"^    enerf (\w+)(.*)$", text, flags=re.MULTILINE)
    assert len(calls) > 10
    for name, arguments in calls:
        command = enerf.get_command(click.Context(enerf), name)
        command = command.commands["run"] if isinstance(command, click.Group) else command  # that of `enerf fleet SCENES`
        options = {option for parameter in command.params for option in parameter.opts}
        assert set(re.findall(r"(?<= )--[a-z-]+", arguments.partition("#")[0])) <= options


def test_steps_of_the_forge_are_targets_of_the_makefile() -> None:
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    steps = [step for path in (ROOT / ".github/workflows").iterdir() for step in re.findall(r"- run: (.*)", path.read_text(encoding="utf-8"))]
    assert len(steps) >= 7
    assert {name for step in steps for name in [re.match(r"make ([\w-]+)", step)[1]]} <= targets  # type: ignore[index]
