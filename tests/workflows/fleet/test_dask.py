"""Fleets on Dask's own local cluster: in this process, and with worker processes of which one is killed."""

import json
import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from tests.workflows.command import Enerf
from tests.workflows.fleet.fleets import fleet_json, toy_manifest

pytest.importorskip("distributed", reason="Dask distributed (the extra fleet) is not installed")


def cluster(folder: Path, *, processes: bool) -> list[Any]:
    path = folder / "cluster.toml"
    path.write_text(f'n_workers = 2\nprocesses = {str(processes).lower()}\ndashboard_address = ":0"\n', encoding="utf-8")
    return ["--cluster", "local", "--cluster-options", path, "--json"]


def digests(run: Path) -> dict[str, str]:
    return {path.parent.name: json.loads(path.read_bytes())["digest"] for path in run.glob("*/manifest.json")}


def test_scenes_on_dask_are_as_one_by_one(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    fleet = tmp_path / "fleet"
    result = enerf("fleet", toy_manifest(tmp_path, 3, s1="bad"), "--out", fleet, *cluster(tmp_path, processes=False))
    assert result.code == 3, result.err
    found = {scene["name"]: scene for scene in fleet_json(fleet)["scenes"]}
    assert {name: scene["state"] for name, scene in found.items()} == {"s0": "done", "s1": "quarantined", "s2": "done"}
    assert "found nothing, expected something" in found["s1"]["reason"]
    assert fleet_json(fleet)["executor"] == "dask"
    assert len({stage["worker"] for scene in found.values() for stage in scene["stages"].values()} - {None}) == 2
    assert {each["event"] for each in result.objects} >= {"stage_started", "stage_done", "scene_done", "scene_quarantined"}
    alone = tmp_path / "alone"
    assert enerf("run", tmp_path / "shoots" / "s0", "--out", alone, "--preset", "tiny", "--quiet").code == 0
    assert digests(fleet / "s0") == digests(alone)


def _facts(process: int) -> list[str]:
    """State, parent and so on."""
    return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()


def _runs(process: int) -> bool:
    try:
        return _facts(process)[0] not in "ZX"
    except OSError:
        return False


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="who runs a stage is read from /proc")
def test_a_killed_workers_stage_goes_on_elsewhere(enerf: Enerf, toys: Path, tmp_path: Path) -> None:
    fleet, killed = tmp_path / "fleet", []

    def attempts() -> list[int]:
        return [int(path.name.split()[-1]) for path in tmp_path.glob("train in *")]

    def kill() -> None:
        deadline = time.monotonic() + 120.0
        try:
            while time.monotonic() < deadline and len(found := attempts()) < 2:
                if found and not killed:
                    killed.append(found[0])
                    os.kill(int(_facts(found[0])[1]), signal.SIGKILL)
                time.sleep(0.05)
        finally:
            (tmp_path / "go on").touch()

    killer = threading.Thread(target=kill)
    killer.start()
    result = enerf("fleet", toy_manifest(tmp_path, 3, s0="slow"), "--out", fleet, *cluster(tmp_path, processes=True))
    killer.join()
    assert result.code == 0, fleet_json(fleet)
    retries = [each["text"] for each in result.objects if each["event"] == "retry" and each["scene"] == "s0"]
    assert len(killed) == 1
    assert "has gone. It is tried once more." in retries[0]
    assert fleet_json(fleet)["scenes"][0]["stages"]["train"]["worker"] not in retries[0]
    assert not any(_runs(child) for child in killed), "a stage outlives its worker"
