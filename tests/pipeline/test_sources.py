"""Several sources of one run."""

import json
import shutil
from pathlib import Path

import pytest

from pipeline.decide import decide
from pipeline.errors import CorruptArtifact
from pipeline.run import NAME, Run
from pipeline.runner import run_stages
from pipeline.stage import Job
from tests.pipeline.toy import LIST, STAGES, make_run, make_source


@pytest.fixture
def run(tmp_path: Path) -> Run:
    """With sources a/photos, b/photos and c."""
    one = make_run(tmp_path / "a")
    one.update(also=(make_source(tmp_path / "b" / "photos"), make_source(tmp_path / "c")))
    return one


def test_sources_are_recorded(run: Run, tmp_path: Path) -> None:
    again = Run.open(run.path)
    assert list(again.sources) == ["photos", "photos (2)", "c"]
    assert again.sources == run.sources
    run.update(also=())
    assert "also" not in json.loads((run.path / NAME).read_text())  # as runs of one source always were
    assert Run.open(run.path).sources == {"": tmp_path / "a" / "photos"}


@pytest.mark.parametrize("also", ["x", [1], ["relative"], ["/nul\0"], ["/x"] * 101])
def test_a_damaged_record_is_refused(run: Run, also: object) -> None:
    document = json.loads((run.path / NAME).read_text())
    (run.path / NAME).write_text(json.dumps(document | {"also": also}))
    with pytest.raises(CorruptArtifact, match="also"):
        Run.open(run.path)


def test_files_of_each_source_are_part_of_the_request(run: Run, tmp_path: Path) -> None:
    assert run.source is not None
    assert Job(settings=None, out=tmp_path / "out", work=tmp_path / "work", source=run.source, also=run.also).sources == run.sources
    run_stages(run, STAGES, until="list")
    made = decide(LIST, run)
    assert made.fresh
    assert made.request is not None
    assert sorted(made.request.source or {}) == sorted(f"{name}/{index}.jpg" for name in ("photos", "photos (2)", "c") for index in range(3))
    (run.also[1] / "1.jpg").write_bytes(b"other")
    assert "c/1.jpg" in (decide(LIST, run).reason or "")
    (run.also[1] / "1.jpg").write_bytes(b"xx")
    shutil.rmtree(run.also[0])
    found = decide(LIST, run)
    assert found.fresh, "a source that is gone leaves the artifact as it is"
    assert str(run.also[0]) in (found.note or "")
    run.update(also=run.also[1:])
    assert not decide(LIST, run).fresh
