"""Kill runs many times and compare what they make with undisturbed runs; see kills.py.

python -m benchmarks.torture [--kills 30] [--jobs 1] [--sources blender,photographs,llff] [--json FILE]
"""

import argparse
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, TextIO

from benchmarks.torture import report
from benchmarks.torture.kills import Prepared, Rounds
from benchmarks.torture.preparation import begin, end, records


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=30, help="how many SIGKILLs; other signals come on top")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    given, prepared = begin(parser, "torture")
    for each in prepared:
        stages = ", ".join(f"{stage} {seconds:.2f} s" for stage, seconds in each.seconds.items())
        print(f"{each.source.kind}: {len(each.operations)} file operations; {stages}", flush=True)
    lines = rounds(given.folder, prepared, given.kills, given.jobs, given.seed)
    result = summary(lines, prepared) | report.circumstances(given.begun, given.jobs, given.seed)
    bad = result["runs_that_differ"] + result["wrong_ends"]
    print(f"{result['kills']} kills and {result['other_signals']} other signals in {result['rounds']} rounds, {result['elapsed_seconds']:.0f} s; "
          f"{len(result['runs_that_differ'])} runs differ, {len(result['wrong_ends'])} wrong ends; {given.json}")  # fmt: skip
    return end(given, result, bool(bad))


def rounds(folder: Path, prepared: list[Prepared], kills: int, jobs: int, seed: int) -> list[dict[str, Any]]:
    """The records of all workers' rounds."""

    def work(job: int, book: TextIO) -> None:
        # Workers begin with different sources.
        order = prepared[job % len(prepared) :] + prepared[: job % len(prepared)]
        Rounds(folder / f"worker_{job}", order, seed * 1000 + job, book).until(-(-kills // jobs))

    return records(folder, jobs, work)


def summary(lines: Sequence[dict[str, Any]], prepared: list[Prepared]) -> dict[str, Any]:
    """Counts of what was done, and all that was wrong."""
    hits = [line for line in lines if line["event"] == "hit"]
    ended = [line for line in lines if line["event"] == "round"]
    kills = [hit for hit in hits if hit["signal"] == "KILL" or (hit["signal"] == "STOP" and hit["code"] == -9)]

    def counted(of: Iterable[dict[str, Any]], *names: str) -> dict[str, int]:
        return dict(sorted(Counter(" ".join(str(hit[name]) for name in names) for hit in of).items()))

    called = [{**hit, "operation": hit["place"].partition(" ")[0], "in": hit["place"].partition(" ")[2].partition(":")[0]} for hit in hits if hit["place"]]
    return {
        "kills": len(kills),
        "other_signals": len(hits) - len(kills),
        "rounds": len(ended),
        "runs_that_differ": [line for line in ended if line["wrong"]],
        "wrong_ends": [hit for hit in hits if hit["wrong"]],
        "kills_per_stage": counted(kills, "stage"),
        "kills_per_source": counted(kills, "source"),
        "kills_per_moment": counted(kills, "moment"),
        "kills_of": {"the process alone": sum(hit["whom"] == "leader" for hit in kills), "its children too": sum(hit["whom"] == "group" for hit in kills)},
        "signals": counted(hits, "signal"),
        "signals_and_exit_codes": counted(hits, "signal", "code"),
        "hits_at_operations": counted(called, "in", "operation"),
        "hits_of_resumed_stages": sum(hit["resumed"] for hit in hits),
        "rounds_that_replaced_artifacts": sum(line["replaces"] for line in ended),
        "rounds_with_the_real_command": sum(line["fresh"] for line in ended),
        "rounds_per_source": counted(ended, "source"),
        "undisturbed_seconds": {each.source.kind: {stage: round(took, 3) for stage, took in each.seconds.items()} for each in prepared},
        "undisturbed_operations": {each.source.kind: len(each.operations) for each in prepared},
    }


if __name__ == "__main__":
    sys.exit(main())
