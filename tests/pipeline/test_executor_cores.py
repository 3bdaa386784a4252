"""Cores by affinity and by the quotas of control groups, and threads of libraries that know nothing of the latter."""

from pathlib import Path

import pytest

from pipeline.executors import cores as module
from pipeline.executors.cores import VARIABLES, cores, keep_to_quota
from tests.pipeline.machine import machine


@pytest.fixture(autouse=True)
def sixty_four(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "affinity", lambda: 64)


@pytest.mark.parametrize(
    ("cgroup", "files", "expected"),
    [
        ("0::/\n", {}, 64),
        ("0::/\n", {"cpu.max": "max 100000\n"}, 64),
        ("0::/\n", {"cpu.max": "200000 100000\n"}, 2),
        ("0::/\n", {"cpu.max": "150000 100000\n"}, 2),
        ("0::/\n", {"cpu.max": "1000 100000\n"}, 1),
        ("0::/\n", {"cpu.max": "20000000 100000\n"}, 64),
        ("0::/a/b\n", {"a/b/cpu.max": "800000 100000\n", "a/cpu.max": "400000 100000\n", "z/cpu.max": "100000 100000\n"}, 4),
        ("0::/\n", {"cpu.max": "words\n"}, 64),
        ("0::/\n", {"cpu.max": "100000 0\n"}, 64),
        ("3:cpu,cpuacct:/pod\n", {"cpu,cpuacct/pod/cpu.cfs_quota_us": "300000\n", "cpu,cpuacct/pod/cpu.cfs_period_us": "100000\n"}, 3),
        ("3:cpu:/pod\n", {"cpu/cpu.cfs_quota_us": "300000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 3),
        ("3:cpu:/pod\n", {"cpu/pod/cpu.cfs_quota_us": "-1\n", "cpu/pod/cpu.cfs_period_us": "100000\n"}, 64),
        ("0::/../../other\n", {"cpu.max": "200000 100000\n"}, 2),
    ],
)
def test_the_smallest_quota_of_the_groups_around_a_process_holds(tmp_path: Path, cgroup: str, files: dict[str, str], expected: int) -> None:
    assert cores(machine(tmp_path, cgroup, files)) == expected


def test_libraries_start_as_many_threads_as_a_quota_has_cores(tmp_path: Path) -> None:
    quota = machine(tmp_path / "quota", "0::/\n", {"cpu.max": "200000 100000\n"})
    environment: dict[str, str] = {}
    keep_to_quota(environment, quota)
    assert environment == dict.fromkeys(VARIABLES, "2")
    for given, expected in (("8", "8"), ("8,2", "8")):
        environment = {"OMP_NUM_THREADS": given, "NUMBA_NUM_THREADS": "5"}
        keep_to_quota(environment, quota)
        assert environment == {**dict.fromkeys(VARIABLES, expected), "OMP_NUM_THREADS": given, "NUMBA_NUM_THREADS": "5"}
    environment = {}
    keep_to_quota(environment, machine(tmp_path / "none", "0::/\n", {}))
    assert environment == {}
