"""Sizes as text, and the smallest of the limits on a process."""

from pathlib import Path

import pytest

from pipeline.errors import UsageError
from pipeline.executors.memory import KEPT_BACK, Limit, available_now, limit_for, parse_size, size_text, usable_memory
from tests.pipeline.machine import machine

GIB = 2**30


@pytest.mark.parametrize(
    ("text", "size"), [("512m", 512 * 2**20), ("8G", 8 * GIB), ("1.5GiB", 3 * GIB // 2), ("2 TB", 2**41), ("100000000", 10**8), ("7b", 7), (" 64kib ", 2**16)]
)
def test_a_size_is_read(text: str, size: int) -> None:
    assert parse_size(text) == size
    assert (size_text(1.5 * GIB), size_text(300 * 2**20), size_text(1)) == ("1.5 GiB", "300 MiB", "1 MiB")


@pytest.mark.parametrize("text", ["", "0", "-1g", "8x", "g", "1e9", "nan", "inf", "8 g b", "9" * 400, "1" + "0" * 19 + "t", "٣g", "8g\x1b[31m", "0.1"])
def test_what_is_no_size_is_refused_in_one_printable_line(text: str) -> None:
    with pytest.raises(UsageError, match="--memory") as caught:
        parse_size(text)
    assert str(caught.value).isprintable()


def roomy(root: Path, limits: dict[str, str], cgroup: str = "0::/\n") -> Path:
    """A machine with 16 GiB, of which 10 are free, and a process that has 1."""
    free = f"MemTotal: {16 * GIB // 1024} kB\nMemAvailable: {10 * GIB // 1024} kB\n"
    return machine(root, cgroup, limits, meminfo=free, self_status=f"Name: x\nVmRSS: {GIB // 1024} kB\n")


def usable(root: Path) -> tuple[int, str]:
    found = usable_memory(root)
    assert found is not None
    return round(found.bytes / (1 - KEPT_BACK) / GIB), found.whose


NESTED = {"memory.max": "max\n", "a/memory.max": f"{4 * GIB}\n", "a/b/memory.max": f"{6 * GIB}\n", "a/b/c/memory.max": "max\n", "z/memory.max": "1"}
POD = "5:cpu,memory:/pod\n0::/\n"
UNLIMITED = str(2**63 - 4096)  # version 1's number for no limit


@pytest.mark.parametrize(
    ("cgroup", "limits", "expected"),
    [
        ("0::/a/b/c\n", NESTED, (4, "the control group /a")),
        (POD, {"memory/pod/memory.limit_in_bytes": UNLIMITED}, (16, "the machine")),
        (POD, {"memory/pod/memory.limit_in_bytes": str(3 * GIB)}, (3, "the control group /pod")),
        ("4:cpu:/\n0::/u\n", {"unified/u/memory.max": str(5 * GIB)}, (5, "the control group /u")),
        ("0::/docker/0123\n", {"memory.max": str(2 * GIB)}, (2, None)),  # a container that sees the path of its host
        ("0::/../../x\n", {"memory.max": str(2 * GIB)}, (2, None)),
        ("\n:::\n0::\nx\n", {"memory.max": "??"}, (16, None)),
        ("0::/\n", {}, (16, "the machine")),
    ],
)
def test_the_smallest_limit_on_the_way_up_counts(tmp_path: Path, cgroup: str, limits: dict[str, str], expected: tuple[int, str | None]) -> None:
    size, whose = usable(roomy(tmp_path, limits, cgroup))
    assert size == expected[0]
    assert whose == expected[1] or expected[1] is None


def test_what_is_available_now_heeds_other_programs_and_the_control_group(tmp_path: Path) -> None:
    assert available_now(roomy(tmp_path / "free", {})) == 11 * GIB
    used = {"memory.max": str(4 * GIB), "memory.current": str(3 * GIB), "memory.stat": f"anon 1\ninactive_file {GIB // 2}\nactive_file {GIB // 2}\n"}
    assert available_now(roomy(tmp_path / "group", used)) == 3 * GIB  # its own, what nobody has, and what can be read again from files


def test_run_json_can_lower_the_limit_and_not_lift_it(tmp_path: Path) -> None:
    here = roomy(tmp_path, {})
    found = usable_memory(here)
    assert found is not None
    assert limit_for(None, None, here) == found
    assert limit_for(None, 2 * GIB, here) == Limit(2 * GIB, "--memory as run.json has it")
    assert limit_for(None, 2**60, here) == found
    assert limit_for(64 * GIB, 2 * GIB, here) == Limit(64 * GIB, "--memory")
