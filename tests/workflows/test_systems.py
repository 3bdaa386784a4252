"""What differs on macOS and Windows, with fakes: nothing here was run there."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.errors import BadInput
from pipeline.executors import cores, memory
from pipeline.files import link_or_copy
from stages.sfm.colmap import import_pycolmap
from workflows.inspection import doctor


def test_windows_is_refused_with_the_way_out() -> None:
    program = "import os; os.name = 'nt'; import workflows.cli.main"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.splitlines() == ["enerf: Windows itself is not supported. Install it inside WSL 2 (wsl --install)."]


def test_without_affinity_every_processor_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    assert cores.affinity() == os.cpu_count()


def test_without_proc_limits_are_those_of_the_process(tmp_path: Path) -> None:
    found = memory.usable_memory(tmp_path)
    assert found is None or found.whose.startswith("RLIMIT")
    assert memory.available_now(tmp_path) is None


@pytest.mark.parametrize("error", [OSError("a file system without links"), NotImplementedError("follow_symlinks unavailable on this platform")])
def test_where_there_are_no_links_files_are_copied(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, error: Exception) -> None:
    def link(*names: object, **options: object) -> None:
        raise error

    monkeypatch.setattr(os, "link", link)
    (tmp_path / "a").write_bytes(b"12")
    link_or_copy(tmp_path / "a", tmp_path / "b")
    assert (tmp_path / "b").read_bytes() == b"12"


def test_where_pycolmap_has_no_wheel_photographs_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on Linux on arm64."""
    monkeypatch.delitem(sys.modules, "pycolmap", raising=False)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(BadInput, match="cameras of another program"):
        import_pycolmap()


def test_the_doctor_needs_no_proc(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Path, "is_file", lambda path: False)
    machine = doctor._machine()
    assert machine["processor"]
    assert machine["instructions"] == []
