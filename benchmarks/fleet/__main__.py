"""See the package."""

import argparse
import json
import os
import sys
from pathlib import Path

from benchmarks.fleet.kills import client, kill
from benchmarks.machine import processor


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.fleet")
    parser.add_argument("what", choices=["kills", "client"])
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--scenes", type=int, default=12)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--longest", type=float, default=1800.0, help="seconds of a fleet that is killed again and again")
    parser.add_argument("--scheduler")
    parser.add_argument("--json", type=Path)
    given = parser.parse_args()
    if given.what == "client":
        return client(given.folder, given.scenes, given.scheduler)
    load = os.getloadavg()[0]
    found = {"kills": kill(given.folder, given.kills, given.scenes, given.seed, given.longest)}
    found |= {"processor": processor(), "cores": len(os.sched_getaffinity(0)), "load": [load, os.getloadavg()[0]]}
    print(json.dumps(found, indent=1))
    if given.json is not None:
        former = json.loads(given.json.read_text(encoding="utf-8")) if given.json.exists() else {}
        given.json.write_text(json.dumps({**former, "kills": found}, indent=1) + "\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
