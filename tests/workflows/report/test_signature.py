"""A page of a run is opened, kept and linked only where this program wrote it; `verify` knows one that was altered."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline import manifest
from tests.workflows.command import Enerf
from workflows.report import signature
from workflows.report.signature import PAGES, is_as_written, is_own, write_page

HOSTILE = b"<!doctype html><script>alert(1)</script>"


@pytest.fixture(autouse=True)
def key(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A key of this test's own."""
    folder = tmp_path_factory.mktemp("cache")
    monkeypatch.setenv("ENERF_CACHE_DIR", str(folder))
    signature._key.cache_clear()
    yield folder / "pages" / "key" / "key"
    signature._key.cache_clear()


@pytest.fixture
def page(tmp_path: Path) -> Path:
    write_page(tmp_path / "report.html", b"<!doctype html>\n<p>a page</p>\n")
    return tmp_path / "report.html"


def written_by_another(path: Path, page: bytes = HOSTILE) -> None:
    """As a stranger's program would sign it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(signature, "_key", lambda: b"another's")
        write_page(path, page)
    os.utime(path, (2**31, 2**31))  # newer than all that it shows


def test_a_page_that_was_written_here_is_known(page: Path, tmp_path: Path) -> None:
    assert is_own(page)
    assert is_as_written(page)
    link, pipe = tmp_path / "link", tmp_path / "pipe"
    link.symlink_to(page)
    os.mkfifo(pipe)
    assert not any(is_as_written(path) for path in (link, pipe, tmp_path, tmp_path / "none"))
    written_by_another(page)
    assert is_as_written(page)
    assert not is_own(page)
    write_page(page, b"")
    assert is_own(page)


def test_every_other_byte_makes_it_another(page: Path) -> None:
    data = page.read_bytes()
    for place in range(len(data)):
        page.write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
        assert not is_own(page), place
        page.write_bytes(data[:place])
        assert not is_as_written(page), place
    for more in (data + b"\n", b"\n" + data, data + HOSTILE, HOSTILE, b""):
        page.write_bytes(more)
        assert not is_as_written(page)


def test_the_key_is_the_users_alone_and_the_same_in_every_process(page: Path, key: Path) -> None:
    assert key.stat().st_size == signature.KEY
    assert key.parent.stat().st_mode & 0o77 == 0
    program = f"from pathlib import Path; from workflows.report.signature import is_own; print(is_own(Path({str(page)!r})))"
    for known in ("True", "False"):
        done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
        assert done.stdout == f"{known}\n"
        key.write_bytes(b"short")  # it is made anew


def test_without_a_place_for_a_key_pages_are_known_to_this_process_alone(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("ENERF_CACHE_DIR", str(tmp_path / "file"))
    signature._key.cache_clear()
    assert not is_own(page)
    write_page(page, b"again")
    assert is_own(page)
    signature._key.cache_clear()
    assert not is_own(page)


def test_an_altered_page_is_reported_and_made_again(enerf: Enerf, toys: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = tmp_path / "run"
    monkeypatch.setattr(manifest, "tool_versions", lambda: (("efficientnerf", "0.2.0"),))
    assert enerf("run", toys, "--out", run).code == 0
    assert enerf("verify", run).code == 0
    for name in PAGES:
        (run / name).write_bytes(HOSTILE)
        os.utime(run / name, (2**31, 2**31))
        result = enerf("verify", run, "--json")
        assert (result.code, result.objects[-1]["damaged"]) == (4, [name])
        assert enerf("run", "--out", run).code == 0
        assert enerf("verify", run).code == 0
        assert not (run / name).exists() or is_own(run / name)


def test_a_page_of_the_version_that_signed_none_is_no_damage(enerf: Enerf, toys: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = tmp_path / "run"
    monkeypatch.setattr(manifest, "tool_versions", lambda: (("efficientnerf", "0.1.0"),))
    assert enerf("run", toys, "--out", run).code == 0
    signed = (run / "report.html").read_bytes()
    (run / "report.html").write_bytes(b"<!doctype html>")
    assert enerf("verify", run).code == 0
    (run / "report.html").write_bytes(b"?" + signed)
    assert enerf("verify", run).code == 4


@pytest.mark.parametrize("command", [("run", "--out"), ("report",), ("stage", "train")])
def test_a_page_that_another_wrote_is_made_again(enerf: Enerf, toys: Path, tmp_path: Path, command: tuple[str, ...]) -> None:
    run = tmp_path / "run"
    assert enerf("run", toys, "--out", run).code == 0
    for name in PAGES:
        written_by_another(run / name)
        assert enerf("verify", run).code == 0, "it carries no signature that others could check"
        assert enerf(*command, run).code == 0
        assert not (run / name).exists() or is_own(run / name)
        assert enerf("verify", run).code == 0
