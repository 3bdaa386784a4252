"""The pages made from the code are up to date, and what the README names exists."""

import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import click
import pytest

ROOT = Path(__file__).resolve().parents[2]
SITE = re.findall(r"\S+", re.findall(r"^SITE_FILES := (.*)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)[0])


def test_the_pages_are_up_to_date() -> None:
    done = subprocess.run([sys.executable, str(ROOT / "docs/make_pages.py"), "--check"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_links_lead_somewhere() -> None:
    pages = [page for pattern in ("*.md", "docs/**/*.md", "examples/**/*.md", "efficientnerf/**/*.md") for page in ROOT.glob(pattern)]
    links = [(page, link) for page in pages for link in re.findall(r"\]\(([^)]+)\)", page.read_text(encoding="utf-8")) if "://" not in link]
    assert len(links) > 150
    assert [(page.name, link) for page, link in links if not (page.parent / link.partition("#")[0]).exists()] == []


def test_links_of_the_site_stay_within_it_and_lead_to_headings() -> None:
    """As `make site` finds out, which needs packages."""
    pages = [page for held in SITE for page in (ROOT.glob(held) if held.endswith(".md") else (ROOT / held).rglob("*.md"))]
    links = [(page, link) for page in pages for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")) if "://" not in link]
    assert len(links) > 150
    for page, link in links:
        path, _, heading = link.partition("#")
        target = (page.parent / path).resolve() if path else page
        place = target.relative_to(ROOT)
        assert any(Path(held) in (place, *place.parents) for held in SITE), f"{page.relative_to(ROOT)}: {link} is outside of SITE_FILES"
        assert not heading or target.suffix != ".md" or heading in _headings(target), f"{page.relative_to(ROOT)}: no heading of {link}"


def _headings(page: Path) -> set[str]:
    """Anchors of a page's headings."""
    text = re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    words = [re.sub(r"\]\([^)]*\)|[^\w\s-]", "", heading).strip().lower() for heading in re.findall(r"^#+ (.*)$", text, re.MULTILINE)]
    return {re.sub(r"\s+", "-", each) for each in words}


def test_pages_of_the_site_exist() -> None:
    named = re.findall(r"^ +- (?:[\w ]+: )?(\S+\.md)$", (ROOT / "mkdocs.yml").read_text(encoding="utf-8"), re.MULTILINE)
    assert len(named) > 15
    assert [name for name in named if not (ROOT / name).is_file()] == []


@pytest.mark.slow
@pytest.mark.skipif(find_spec("material") is None, reason="mkdocs-material is not installed; `make site` installs it into build/site-tools")
def test_the_site_is_built(tmp_path: Path) -> None:
    """Links that lead nowhere are errors."""
    for held in SITE:
        copy = shutil.copytree if (ROOT / held).is_dir() else shutil.copyfile
        (tmp_path / "source" / held).parent.mkdir(parents=True, exist_ok=True)
        copy(ROOT / held, tmp_path / "source" / held)
    configuration = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").replace("build/site-source", "source").replace("build/site", "site")
    (tmp_path / "mkdocs.yml").write_text(configuration, encoding="utf-8")
    done = subprocess.run([sys.executable, "-m", "mkdocs", "build"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "site/docs/quickstart.html").stat().st_size > 0


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
