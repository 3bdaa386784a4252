"""See the package."""

from __future__ import annotations

import argparse
import json
import os
import sys
from pathlib import Path

from benchmarks.machine import processor


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fleet")
    parser.add_argument("what", choices=["simulated", "kills", "real", "page", "client"])
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--scenes", type=int)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--longest", type=float, default=1800.0, help="seconds of a fleet that is killed again and again")
    parser.add_argument("--ways", nargs="+", choices=["one_by_one", "one_worker", "two_workers"], help="of real: measured now; the others were before")
    parser.add_argument("--scheduler")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    if given.what == "client":
        from benchmarks.fleet.kills import client

        return client(given.folder, given.scenes, given.scheduler)
    load = os.getloadavg()[0]
    if given.what == "simulated":
        from benchmarks.fleet.simulated import simulate

        found = {"simulated": simulate(given.scenes or 1000, 10)}
    elif given.what == "kills":
        from benchmarks.fleet.kills import kill

        found = {"kills": kill(given.folder, given.kills, given.scenes or 12, given.seed, given.longest)}
    elif given.what == "page":
        from benchmarks.fleet.page import look

        found = {"page": look(given.folder)}
    else:
        from benchmarks.fleet.real import WAYS, compare

        found = {"real": compare(given.folder, given.scenes or 24, given.ways or WAYS)}
    found |= {"processor": processor(), "cores": len(os.sched_getaffinity(0)), "load": [load, os.getloadavg()[0]]}
    print(json.dumps(found, indent=1))
    if given.json is not None:
        former = json.loads(given.json.read_text(encoding="utf-8")) if given.json.exists() else {}
        given.json.write_text(json.dumps({**former, given.what: found}, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
