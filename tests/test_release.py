"""The version stands alike wherever it is stated, and `make publish` refuses what is not ready."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

ROOT = Path(__file__).resolve().parent.parent


@pytest.fixture
def release(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script, with copies of the files that it reads."""
    spec = importlib.util.spec_from_file_location("release", ROOT / ".ci/release.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    for name in ("pyproject.toml", "CHANGELOG.md", "CITATION.cff"):
        (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    monkeypatch.setattr(module, "ROOT", tmp_path)
    monkeypatch.setattr(module, "DIST", tmp_path / "dist")
    return module


def test_the_version_is_that_of_the_changelog_and_the_citation(release: ModuleType) -> None:
    assert release.disagreements(release.stated_version()) == []


def test_what_differs_is_named(release: ModuleType) -> None:
    assert len(release.disagreements("9.9.9")) == 2
    citation = release.ROOT / "CITATION.cff"
    citation.write_text(citation.read_text().replace("date-released: 20", "date-released: 19"))
    (reason,) = release.disagreements(release.stated_version())
    assert "date" in reason


def test_unreleased_changes_keep_a_version_from_being_published(release: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    changes, version = release.ROOT / "CHANGELOG.md", release.stated_version()
    changes.write_text(f"# Changelog\n\n## [Unreleased]\n\n## [{version}] - 2026-11-27\n\n- One.\n")
    (release.ROOT / "CITATION.cff").write_text(f"version: {version}\ndate-released: 2026-11-27\n")
    assert release.obstacles(version) == []
    changes.write_text(changes.read_text().replace("## [Unreleased]\n", "## [Unreleased]\n\n- Another.\n"))
    assert release.obstacles(version) == ["CHANGELOG.md has unreleased changes"]
    monkeypatch.setattr(release, "call", lambda *command: "")
    with pytest.raises(SystemExit, match=rf"unreleased.*no tag v{version}.*no build"):
        release.publish()
