"""What is served of a run while it is made, and what of a hostile one."""

import json
import os
import shutil
from pathlib import Path

import pytest

from pipeline.run import Run
from stages.artifacts import BakeOutputs, SplatsOutputs
from stages.formats.exporters import SPLAT_EXPORTERS
from stages.formats.exporters.writing import CAPTURE_IS_Z_UP
from stages.viewer.html import policy_hash
from stages.viewer.page import script_text
from tests.stages.formats.gaussians import scattered
from tests.workflows.assets import write_block
from tests.workflows.report.records import record, record_splats
from tests.workflows.viewing.growing import PNG, TRAIN, put, scratch
from workflows.report.signature import write_page
from workflows.report.viewer import is_newest
from workflows.viewing import progress, serving
from workflows.viewing.server import Answer
from workflows.viewing.serving import RunSite, asset_site, make_page


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return Run.create(tmp_path / "run", Path("/photographs"), {})


def site_of(run: Run, tmp_path: Path) -> RunSite:
    return RunSite(run.path, (TRAIN,), tmp_path)


def body(answer: Answer | None) -> bytes | None:
    """What is sent; None where there is nothing."""
    if answer is None or answer.file is None:
        return None if answer is None else answer.data
    with open(answer.file, "rb") as file:
        return file.read()


def test_what_is_being_made_is_shown_as_it_comes(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "PAUSE", 0.0)
    monkeypatch.setattr(progress, "SHARE", 1e9)
    site = site_of(run, tmp_path)
    begun = json.loads(site.status())
    assert [stage["state"] for stage in begun["stages"]] == ["missing"]
    assert (begun["name"], begun["source"], begun["asset"], begun["error"]) == ("run", "/photographs", None, None)
    assert begun["training"]["train"]["step"] is None
    assert site("/previews/train/preview_000003.png") is None
    put(scratch(run), 7, [3, 5])
    now = json.loads(site.status())
    assert [stage["state"] for stage in now["stages"]] == ["partial"]
    shown = now["training"]["train"]
    assert (shown["live"], shown["step"], shown["seconds"]) == (True, 6, 0.6)
    assert shown["psnr"] == [[k, 10 + k / 100] for k in range(7)]
    assert shown["preview_psnr"] == [[3, 9.5], [5, 9.5]]
    assert shown["previews"] == ["preview_000003.png", "preview_000005.png"]
    answer = site("/previews/train/preview_000005.png")
    assert answer is not None
    assert answer.kind == "image/png"
    assert body(answer) == PNG + b"\x05"


HOSTILE = ["/previews/train/../../run.json", "/previews/train/%2e%2e/run.json", "/previews/train/..%2f..%2frun.json", "/previews//preview_000001.png",
           "/previews/../preview_000001.png", "/previews/train/preview_000001.png/", "/previews/train/preview_000001.png?x", "/previews/train/preview_1.png",
           "/previews/train/", "/previews/train/preview_000001.PNG", "/previews/train/preview_000001.png%00", "/previews/train/preview_000001.png\n",
           "/previews/bake/preview_000001.png", "/previews/poses/preview_000001.png", "/run.json", "/.lock", "/train/log.jsonl", "/.work/", "//status.json",
           "/live.html", "/../live.js", "/serving.py", "/status.json/", "/STATUS.JSON", "", "status.json", "/previews/train/preview_٠٠٠٠٠١.png"]  # fmt: skip


def test_no_other_path_leads_anywhere(run: Run, tmp_path: Path) -> None:
    put(scratch(run), 3, [1])
    site = site_of(run, tmp_path)
    site.status()
    assert body(site("/previews/train/preview_000001.png")) == PNG + b"\x01"
    for path in HOSTILE:
        assert site(path) is None, path


def test_a_preview_that_became_a_link_is_not_followed(run: Run, tmp_path: Path) -> None:
    """Between two looks at the run, which refuse one that holds links."""
    secret = tmp_path / "secret"
    secret.mkdir()
    for name in ("preview_000001.png", "preview_000002.png"):
        (secret / name).write_text("secret", encoding="utf-8")
    put(scratch(run), 3, [1, 2])
    site = site_of(run, tmp_path)
    site.status()
    preview = scratch(run) / "preview_000001.png"
    for make in (lambda: None, lambda: preview.symlink_to(secret / preview.name), lambda: os.mkfifo(preview)):
        preview.unlink()
        make()
        assert site("/previews/train/preview_000001.png") is None
        preview.touch()
    shutil.rmtree(scratch(run))
    scratch(run).rmdir()
    (run.path / ".work" / "train").rename(tmp_path / "moved")
    (run.path / ".work" / "train").symlink_to(tmp_path / "moved")
    assert site("/previews/train/preview_000002.png") is None


def test_the_viewer_comes_with_the_asset_and_changes_with_it(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[str] = []

    def make(what: Path, asset: Path, target: Path) -> None:
        made.append(what.name)
        target.write_text(f"page {len(made)}", encoding="utf-8")

    monkeypatch.setattr(serving, "make_page", make)
    monkeypatch.setattr(progress, "PAUSE", 0.0)
    monkeypatch.setattr(progress, "SHARE", 1e9)
    site = site_of(run, tmp_path)
    assert site("/viewer.html") is None
    file = BakeOutputs.of_run(run.path).asset
    write_block(file)
    first = json.loads(site.status())["asset"]
    assert [body(site("/viewer.html")) for _ in range(2)] == [b"page 1"] * 2
    write_block(file)
    os.utime(file, ns=(1, file.stat().st_mtime_ns + 10**9))
    assert json.loads(site.status())["asset"] != first
    assert body(site("/viewer.html")) == b"page 2"
    assert made == ["run", "run"]
    assert not (run.path / "viewer.html").exists()
    (run.path / "viewer.html").write_text("of the run", encoding="utf-8")
    assert body(site("/viewer.html")) == b"page 2", "what the run holds may be anybody's"
    page = run.path / "viewer.html"
    assert not is_newest(run, page)
    write_page(page, b"our own")
    assert is_newest(run, page)
    os.utime(page, ns=(1, file.parent.stat().st_ctime_ns - 1))
    assert not is_newest(run, page), "one that is older than the asset is of another"
    page.unlink()
    page.symlink_to(run.path / "run.json")
    assert not is_newest(run, page)


def test_the_viewer_is_of_the_gaussians_once_they_are_there_and_of_a_newer_asset(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "PAUSE", 0.0)
    monkeypatch.setattr(progress, "SHARE", 1e9)
    site = site_of(run, tmp_path)
    bake = BakeOutputs.of_run(run.path)
    record(run.path, bake.stage)
    write_block(bake.asset)

    def shown() -> tuple[str, bool]:
        """What tells it from another, and whether it is of Gaussians."""
        return json.loads(site.status())["asset"], b'"splats":{' in (body(site("/viewer.html")) or b"")

    first, of_gaussians = shown()
    assert not of_gaussians
    splats = SplatsOutputs.of_run(run.path)
    splats.folder.mkdir()
    SPLAT_EXPORTERS[".spz"](scattered(), splats.spz, CAPTURE_IS_Z_UP)
    record_splats(run.path)
    second, of_gaussians = shown()
    assert second != first
    assert of_gaussians
    splats.spz.unlink()
    SPLAT_EXPORTERS[".spz"](scattered(300), splats.spz, CAPTURE_IS_Z_UP)
    third, of_gaussians = shown()
    assert third not in (first, second)
    assert of_gaussians
    make_page(run.path, bake.asset, run.path / "viewer.html")
    assert is_newest(run, run.path / "viewer.html")
    record(run.path, bake.stage, sha256="1" * 64)
    assert shown() == (first, False)
    assert not is_newest(run, run.path / "viewer.html")


def test_the_viewer_is_served_with_its_own_scripts_alone_and_without_an_origin(tmp_path: Path) -> None:
    """Whatever was written to its place: another script is not run, and nothing of this server is read."""
    (tmp_path / "viewer.html").write_text("page", encoding="utf-8")
    site = asset_site(tmp_path / "viewer.html")
    assert body(site("/")) == body(site("/viewer.html")) == b"page"
    assert [site(path) for path in ("/status.json", "/live.js", "/..", "/viewer.html/")] == [None] * 4
    answer = site("/")
    assert answer is not None
    body(answer)
    directives = {words[0]: words[1:] for words in (part.split() for part in answer.policy.split(";"))}
    assert directives["default-src"] == ["'none'"]
    assert directives["script-src"] == [f"'sha256-{policy_hash(script_text())}'"]
    assert set(directives["sandbox"]) == {"allow-scripts", "allow-downloads"}
    assert directives["frame-ancestors"] == ["'self'"]
    assert not any("unsafe" in word for words in directives.values() for word in words)
