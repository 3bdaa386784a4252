"""What `enerf doctor` shows, and what `enerf cache --clear` removes."""

import subprocess
import tomllib
from pathlib import Path

import pytest

from efficientnerf.backends import kernel_cache
from tests.workflows.command import Enerf
from workflows.inspection import doctor
from workflows.inspection.self_test import self_test

ROOT = Path(__file__).resolve().parents[2]


def test_extras_are_those_of_the_project() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    assert doctor.EXTRAS.keys() == extras.keys() - {"dev", "docs", "fuzz"}


def test_a_bug_report_has_versions_and_the_machine(enerf: Enerf) -> None:
    found = enerf("doctor", "--seconds", "0", "--json").object
    assert found["packages"]["torch"] is not None
    assert min(found["cores"], found["disk_free"]) > 0
    assert found["self_test"]["state"] == "left out"
    assert "torch" in enerf("doctor", "--seconds", "0").out


@pytest.mark.parametrize(("ended", "state", "code"), [(0, "passed", 0), (3, "failed", 3), (None, "not finished", 0)])
def test_the_self_test_decides_the_exit_code(enerf: Enerf, monkeypatch: pytest.MonkeyPatch, ended: int | None, state: str, code: int) -> None:
    def run(command: list[str], timeout: float, **options: object) -> subprocess.CompletedProcess[str]:
        if ended is None:
            raise subprocess.TimeoutExpired(command, timeout)
        return subprocess.CompletedProcess(command, ended, "", "enerf: what was wrong\n")

    monkeypatch.setattr(subprocess, "run", run)
    result = enerf("doctor")
    assert result.code == code
    assert f"self-test: {state}" in result.out
    assert ("what was wrong" in result.err) == (code == 3)


@pytest.mark.slow
def test_the_self_test_passes(tmp_path: Path) -> None:
    self_test(tmp_path)
    assert (tmp_path / "run/bake/asset.nerftree").exists()


def test_a_bug_report_has_no_name_of_the_user(enerf: Enerf, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("ENERF_CACHE_DIR", str(tmp_path / "cache"))
    (tmp_path / "cache/features").mkdir(parents=True)
    out = enerf("doctor", "--seconds", "0").out
    assert "ENERF_CACHE_DIR=~/cache" in out
    assert str(tmp_path) not in out


def test_clearing_removes_what_is_made_again_alone(enerf: Enerf, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("ENERF_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(kernel_cache, "roots", lambda: [tmp_path / "cache/kernels"])
    for name in ("kernels/0123456789abcdef/m/x.nbc", "features/0123456789abcdef/a.features", "features/mine/thesis", "pages/key/key", "other"):
        (tmp_path / "cache" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "cache" / name).write_bytes(b"12345")
    (tmp_path / "cache/features/fedcba9876543210").symlink_to(tmp_path / "cache/features/mine")
    assert [each["bytes"] for each in enerf("cache", "--json").object["caches"]] == [5, 5]
    assert enerf("cache", "--clear", "--json").object["freed"] == 10
    left = {str(path.relative_to(tmp_path / "cache")) for path in (tmp_path / "cache").rglob("*") if path.is_file()}
    assert left >= {"features/mine/thesis", "pages/key/key", "other"}
    assert not any("0123456789abcdef" in name for name in left)
