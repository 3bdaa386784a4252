"""Sizes as text, and the smallest of the limits on a process."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.errors import UsageError
from pipeline.executors.memory import KEPT_BACK, PRIVATE, Limit, available_now, limit_for, parse_size, size_text, usable_memory

GIB = 2**30


@pytest.mark.parametrize(
    ("text", "size"),
    [("512m", 512 * 2**20), ("8g", 8 * GIB), ("8G", 8 * GIB), ("1.5GiB", 3 * GIB // 2), ("2 TB", 2**41), ("100000000", 10**8), ("7b", 7), (" 64kib ", 2**16)],
)
def test_a_size_is_read(text: str, size: int) -> None:
    assert parse_size(text) == size


@pytest.mark.parametrize("text", ["", "0", "-1g", "8x", "g", "1e9", "nan", "inf", "8 g b", "9" * 400, "1" + "0" * 19 + "t", "٣g", "8g\x1b[31m", "0.1"])
def test_what_is_no_size_is_refused_in_one_printable_line(text: str) -> None:
    with pytest.raises(UsageError, match="--memory") as caught:
        parse_size(text)
    assert str(caught.value).isprintable()


def test_sizes_in_words() -> None:
    assert (size_text(1.5 * GIB), size_text(300 * 2**20), size_text(1)) == ("1.5 GiB", "300 MiB", "1 MiB")


def machine(root: Path, *, cgroup: str = "0::/\n", **limits: str) -> Path:
    """A root folder with 16 GiB, of which 10 are free; `limits` are files below sys/fs/cgroup, with __ for / and - for the dot."""
    (root / "proc/self").mkdir(parents=True)
    (root / "proc/meminfo").write_text(f"MemTotal: {16 * GIB // 1024} kB\nMemAvailable: {10 * GIB // 1024} kB\n")
    (root / "proc/self/status").write_text(f"Name: x\nVmRSS: {GIB // 1024} kB\n")
    (root / "proc/self/cgroup").write_text(cgroup)
    for name, value in limits.items():
        path = root / "sys/fs/cgroup" / name.replace("__", "/").replace("-", ".")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(value)
    return root


def usable(root: Path) -> tuple[int, str]:
    found = usable_memory(root)
    assert found is not None
    return round(found.bytes / (1 - KEPT_BACK) / GIB), found.whose


def test_without_control_groups_it_is_the_machines(tmp_path: Path) -> None:
    assert usable(machine(tmp_path)) == (16, "the machine")


def test_the_smallest_limit_on_the_way_up_counts(tmp_path: Path) -> None:
    limits = {"memory-max": "max\n", "a__memory-max": f"{4 * GIB}\n", "a__b__memory-max": f"{6 * GIB}\n", "a__b__c__memory-max": "max\n", "z__memory-max": "1"}
    assert usable(machine(tmp_path, cgroup="0::/a/b/c\n", **limits)) == (4, "the control group /a")


def test_version_1_and_its_number_for_no_limit(tmp_path: Path) -> None:
    groups = "5:cpu,memory:/pod\n0::/\n"
    unlimited = machine(tmp_path / "one", cgroup=groups, **{"memory__pod__memory-limit_in_bytes": str(2**63 - 4096)})
    assert usable(unlimited) == (16, "the machine")
    limited = machine(tmp_path / "two", cgroup=groups, **{"memory__pod__memory-limit_in_bytes": str(3 * GIB)})
    assert usable(limited) == (3, "the control group /pod")


def test_version_2_beside_version_1(tmp_path: Path) -> None:
    assert usable(machine(tmp_path, cgroup="4:cpu:/\n0::/u\n", **{"unified__u__memory-max": str(5 * GIB)})) == (5, "the control group /u")


def test_a_container_that_sees_the_path_of_its_host(tmp_path: Path) -> None:
    assert usable(machine(tmp_path, cgroup="0::/docker/0123\n", **{"memory-max": str(2 * GIB)}))[0] == 2
    assert usable(machine(tmp_path / "up", cgroup="0::/../../x\n", **{"memory-max": str(2 * GIB)}))[0] == 2


def test_nonsense_in_the_files_of_the_system_counts_as_no_limit(tmp_path: Path) -> None:
    assert usable(machine(tmp_path, cgroup="\n:::\n0::\nx\n", **{"memory-max": "??"}))[0] == 16


def test_what_is_available_now_heeds_other_programs_and_the_control_group(tmp_path: Path) -> None:
    assert available_now(machine(tmp_path / "free")) == 11 * GIB
    used = {"memory-max": str(4 * GIB), "memory-current": str(3 * GIB), "memory-stat": f"anon 1\ninactive_file {GIB // 2}\nactive_file {GIB // 2}\n"}
    assert available_now(machine(tmp_path / "group", **used)) == 3 * GIB  # its own, what nobody has, and what can be read again from files


def test_run_json_can_lower_the_limit_and_not_lift_it(tmp_path: Path) -> None:
    here = machine(tmp_path)
    found = usable_memory(here)
    assert found is not None
    assert limit_for(None, None, here) == found
    assert limit_for(None, 2 * GIB, here) == Limit(2 * GIB, "--memory as run.json has it")
    assert limit_for(None, 2**60, here) == found
    assert limit_for(64 * GIB, 2 * GIB, here) == Limit(64 * GIB, "--memory")


def test_a_limit_on_addresses_counts_less_what_libraries_reserve() -> None:
    code = "import resource; resource.setrlimit(resource.RLIMIT_DATA, (2**30, -1)); import pipeline.executors.memory as m; print(m.usable_memory(cores=2))"
    if sys.platform != "linux":
        pytest.skip("RLIMIT_DATA counts what is mapped on Linux alone")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "RLIMIT_DATA" in done.stdout
    assert str(2**30 - PRIVATE - 2 * 8 * 2**20) in done.stdout
