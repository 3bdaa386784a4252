"""`enerf view`: the page is made where it is missing, opened, or served until Ctrl-C."""

import json
import os
import signal
import sys
import tempfile
import urllib.error
import urllib.request
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from pipeline.run import Run
from stages.artifacts import BakeOutputs
from tests.workflows.assets import write_block
from tests.workflows.command import Enerf
from workflows.report.signature import write_page
from workflows.viewing import serving


@pytest.fixture
def opened(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[str]:
    """What a browser was asked to show. Pages are made by a stand-in, and temporary folders lie in this test's."""
    shown: list[str] = []
    monkeypatch.setattr(webbrowser, "open", lambda url: shown.append(url) or True)
    monkeypatch.setenv("DISPLAY", ":0")
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))

    def make(what: Path, asset: Path, target: Path) -> None:
        write_page(target, f"{what.name} of {asset.stat().st_size} bytes".encode())

    monkeypatch.setattr(serving, "make_page", make)
    return shown


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A run with nothing but an asset."""
    path = Run.create(tmp_path / "run", Path("/photographs"), {}).path
    write_block(BakeOutputs.of_run(path).asset)
    return path


def test_the_page_of_a_run_is_made_once_and_again_of_another_asset(enerf: Enerf, run: Path, opened: list[str]) -> None:
    page, asset = run / "viewer.html", BakeOutputs.of_run(run).asset
    for made in (True, False):
        assert enerf("view", run, "--json").object == {"event": "summary", "ok": True, "page": str(page), "made": made, "opened": True, "exit_code": 0}
    assert opened == [page.as_uri()] * 2
    assert page.read_text(encoding="utf-8").startswith(f"run of {asset.stat().st_size} bytes")
    assert enerf("view", run, "--force", "--no-browser", "--json").object["made"]
    os.utime(asset.parent)  # as publishing does
    assert enerf("view", run, "--no-browser", "--json").object["made"]
    assert len(opened) == 2
    assert enerf("view", run, "--no-browser").out == f"{page}\n"
    assert enerf("view", run, "--no-browser", "--quiet").out == ""


def test_a_page_that_another_wrote_is_never_opened(enerf: Enerf, run: Path, opened: list[str]) -> None:
    """Of a stranger's run: newer than its asset, and of the size of the page that this program wrote."""
    page = run / "viewer.html"
    assert enerf("view", run, "--no-browser", "--quiet").code == 0
    size = page.stat().st_size
    page.write_bytes(b"<script>alert(1)</script>".ljust(size))
    os.utime(page, (2**31, 2**31))
    assert enerf("view", run, "--json").object["made"]
    assert opened == [page.as_uri()]
    assert b"<script>" not in page.read_bytes()


def test_without_a_screen_no_browser_takes_the_terminal(enerf: Enerf, run: Path, opened: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "platform", "linux")
    assert enerf("view", run).out.startswith(str(run / "viewer.html"))
    assert opened == []


@pytest.mark.parametrize(
    ("arguments", "code", "named"),
    [
        (["run", "--serve", "66000"], 2, "--serve"),
        (["run", "--address", "::1"], 2, "--serve PORT"),
        (["run", "--serve", "0", "--address", "here"], 2, "127.0.0.1"),
        (["run", "--serve", "0", "--address", "203.0.113.9"], 2, "203.0.113.9"),
        (["nothing"], 2, "nothing"),
        (["empty"], 2, "empty"),
        (["bare"], 2, "bare"),
        (["damaged.nerftree"], 4, "damaged.nerftree"),
    ],
)
def test_what_is_refused(enerf: Enerf, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: list[str], code: int, named: str) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "empty").mkdir()
    (tmp_path / "damaged.nerftree").write_bytes(BakeOutputs.of_run(run).asset.read_bytes()[:-9])
    Run.create(tmp_path / "bare", Path("/photographs"), {})
    result = enerf("view", *arguments, "--no-browser", "--json")
    assert (result.code, named in result.err, result.objects[-1]["exit_code"]) == (code, True, code)
    assert not [path for path in (tmp_path / "temporary").rglob("*") if path.is_file()]


def got(url: str) -> bytes:
    with urllib.request.urlopen(url, timeout=20) as answer:
        return bytes(answer.read())


@pytest.mark.parametrize("more", [[], ["--no-browser"]])
def test_a_run_is_served_until_a_signal(enerf: Enerf, run: Path, opened: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, more: list[str]) -> None:
    """All in one process: what would wait for a signal asks for the pages instead."""
    answers: dict[str, bytes] = {}
    urls: list[str] = []

    @contextmanager
    def stopping() -> Iterator[Callable[[], int | None]]:
        def asked() -> int | None:
            answers.update({path: got(urls[0] + path) for path in ("", "status.json", "viewer.html")})
            with pytest.raises(urllib.error.HTTPError, match="404"):
                got(urls[0] + "run.json")
            return signal.SIGINT

        yield asked

    monkeypatch.setattr(serving, "stopping", stopping)
    monkeypatch.setattr("workflows.viewing.serving.write_json", lambda value, **_: urls.append(value["url"]) if "url" in value else None)
    assert enerf("view", run, "--serve", 0, "--json", *more).code == 0
    assert b"/live.js" in answers[""]
    assert json.loads(answers["status.json"])["name"] == "run"
    assert answers["viewer.html"].startswith(f"run of {BakeOutputs.of_run(run).asset.stat().st_size} bytes".encode())
    assert urls[0].startswith("http://127.0.0.1:")
    assert opened == ([] if more else urls)
    assert not list((tmp_path / "temporary").iterdir()), "what was made for it goes with it"
    assert not (run / "viewer.html").exists()
    with pytest.raises(OSError, match=r"refused|Connection"):
        got(urls[0])
