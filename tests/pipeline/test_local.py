"""What the executor measures of a stage: processor time of the process and of its children."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

from pipeline.executors import local
from pipeline.stage import Job, Stage
from tests.pipeline.toy import NoSettings

GROWN = "x = bytes(range(256)) * {size}\nimport time\nstarted = time.process_time()\nwhile time.process_time() - started < 0.15: pass"


def usage(tmp_path: Path, work: Callable[[Job], None]) -> local.Usage:
    return local.execute(Stage("toy", 1, NoSettings, (), work), Job(settings=NoSettings(), out=tmp_path / "out", work=tmp_path / "work"))


def test_time_and_memory_are_those_of_the_process_and_its_children(tmp_path: Path) -> None:
    size = 2**30
    own = usage(tmp_path, lambda job: exec(GROWN.format(size=1)))
    child = usage(tmp_path, lambda job: subprocess.run([sys.executable, "-c", GROWN.format(size=size // 256)], check=True) and None)  # type: ignore[func-returns-value]
    idle = usage(tmp_path, lambda job: time.sleep(0.2))
    assert all(0.14 <= each.cpu_seconds < 3 and each.cores >= 1 for each in (own, child))
    assert child.peak_memory > size
    assert idle.cpu_seconds < 0.15 < idle.seconds
