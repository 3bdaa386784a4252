"""Admission by memory: what is admitted together fits, everything has its turn, and what fits nowhere runs alone. On simulated workers."""

import itertools
import random
from pathlib import Path
from typing import Any

import pytest

from pipeline.fleet.admission import Admission
from pipeline.fleet.workers import Demand, Task, Worker
from tests.pipeline.fleet.simulated import STAGES, Answer, Simulated, done, hurry, run, scene_of, scenes, state_of, what

GIB = 2**30


@pytest.fixture(autouse=True)
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    hurry(monkeypatch)


def taking(needs: dict[tuple[str, str], int], others: int = GIB) -> Answer:
    """Answers of scenes whose stages say before what they take, and refuse to begin with less than half of it."""

    def answer(task: Task) -> dict[str, Any]:
        scene = scene_of(task)
        need = needs.get((scene, what(task.request)), others)
        if task.request["kind"] == "stage" and task.memory is not None and 2 * task.memory < need:
            return {"ok": False, "kind": "refused", "text": f"needs {need // 2}.", "needed": need // 2}
        return done(task, memory={stage: needs.get((scene, stage), others) for stage in STAGES})

    return answer


def trainings(workers: Simulated) -> list[str]:
    return [name for name, stage, _ in workers.log if stage == "train"]


def test_no_worker_exceeds_its_memory_and_every_scene_ends(tmp_path: Path) -> None:
    for seed in range(20):
        chance = random.Random(seed)
        limits = [chance.choice([4, 8, 16, 32]) * GIB for _ in range(chance.randint(1, 4))]
        gpus = [tuple(range(chance.randint(0, 2))) for _ in limits]
        workers = Simulated([Worker(f"w{n}", 8, limit, gpus[n], slots=chance.randint(1, 5)) for n, limit in enumerate(limits)])
        needs = {(f"s{n}", stage): int(chance.choice([0.1, 0.5, 1, 3, 6, 12]) * GIB) for n in range(15) for stage in STAGES}
        workers.answer = taking(needs)
        found = run(tmp_path / str(seed), workers, scenes(15), device=chance.choice(["cpu", "cuda"]))
        hopeless = {scene: need // 2 for (scene, _), need in needs.items() if need > 2 * max(limits)}  # with half of it they would begin
        assert {scene.name: scene.state for scene in found.scenes if scene.state != "done"} == dict.fromkeys(hopeless, "quarantined")
        assert all(str(needed) in (state_of(found, scene).reason or "") for scene, needed in hopeless.items())
        assert all(workers.most[f"w{n}"][0] <= limit for n, limit in enumerate(limits) if f"w{n}" in workers.most)


@pytest.mark.parametrize("slots", [2, 8])
def test_a_large_stage_does_not_wait_for_all_small_ones(tmp_path: Path, slots: int) -> None:
    workers = Simulated([Worker("a", 8, 16 * GIB, slots=slots)], taking({("s20", "train"): 15 * GIB}, others=3 * GIB))
    assert run(tmp_path, workers, scenes(50)).state == "done"
    ready, begun = (workers.log.index(("s20", stage, "a")) for stage in ("poses", "train"))
    assert trainings(workers).count("s20") == 1
    assert begun - ready <= 4 * slots, "it began as soon as what ran then had ended"


def test_what_fits_nowhere_runs_alone_with_what_there_is_and_that_is_told(tmp_path: Path) -> None:
    workers = Simulated([Worker("small", 8, 4 * GIB, slots=2), Worker("large", 8, 16 * GIB, slots=4)], taking({("s3", "train"): 20 * GIB}, others=GIB))
    beside: list[int] = []

    def between() -> None:
        if any((scene_of(task), what(task.request)) == ("s3", "train") for task in workers.running.values()):
            beside.append(sum(task.worker == "large" for task in workers.running.values()))

    workers.between = between
    told: list[dict[str, Any]] = []
    found = run(tmp_path, workers, scenes(12), report=told.append)
    assert found.state == "done"
    assert set(beside) == {1}
    task = next(task for task in workers.tasks if (scene_of(task), what(task.request)) == ("s3", "train"))
    assert (task.worker, task.memory, task.request["memory"]) == ("large", 16 * GIB, 16 * GIB)
    (text,) = state_of(found, "s3").warnings
    assert all(words in text for words in ("train", "20.0 GiB", "16.0 GiB"))
    assert [event["text"] for event in told if event["event"] == "warning"] == [text]
    assert trainings(workers).index("s3") < 11


def test_a_refusal_is_believed_before_the_estimate(tmp_path: Path) -> None:
    """It may come twice: as the stage begins, and once it has counted."""
    steps = itertools.chain([6 * GIB, 9 * GIB], itertools.repeat(0))

    def answer(task: Task) -> dict[str, Any]:
        if what(task.request) == "bake" and (needed := next(steps)):
            return {"ok": False, "kind": "refused", "text": "too little.", "needed": needed}
        return done(task, memory={"bake": 2 * GIB})

    workers = Simulated([Worker("a", 8, 16 * GIB, slots=4)], answer)
    assert run(tmp_path, workers, scenes(1)).state == "done"
    assert [task.memory for task in workers.tasks if what(task.request) == "bake"] == [int(1.05 * each * GIB) for each in (2, 6, 9)]


def test_what_ran_out_and_cannot_begin_with_less_is_tried_alone(tmp_path: Path) -> None:
    first = iter([True])

    def answer(task: Task) -> dict[str, Any]:
        if (scene_of(task), what(task.request)) != ("s0", "bake"):
            return done(task, memory=dict.fromkeys(STAGES, 4 * GIB))
        if next(first, False):
            return {"ok": False, "kind": "memory", "text": "out of memory."}
        if (task.memory or 0) < 4 * GIB:
            return {"ok": False, "kind": "refused", "text": "needs 4.0 GiB.", "needed": 4 * GIB}
        return done(task)

    workers = Simulated([Worker("a", 8, 16 * GIB, slots=3)], answer)
    found = run(tmp_path, workers, scenes(6))
    assert found.state == "done"
    half = int(1.05 * 4 * GIB) // 2
    assert [task.memory for task in workers.tasks if (scene_of(task), what(task.request)) == ("s0", "bake")] == [2 * half, half, 16 * GIB]


def test_a_worker_that_is_kept_takes_what_leaves_room() -> None:
    worker = Worker("a", 8, 16, slots=4)
    admission, numbers = Admission(), itertools.count()

    def begin(who: int, memory: int) -> Task | None:
        place = admission.place(who, Demand(memory=memory))
        if place is None:
            return None
        task = Task(next(numbers), "a", {}, 1, place[1])
        admission.take(task)
        return task

    admission.look([worker], [0, 1, 2, 3, 4])
    running = begin(0, 10)
    assert running is not None
    assert begin(1, 12) is None
    assert admission.waited_for() == {1}
    assert begin(2, 5) is None, "there is room for it, but not beside the one that waits"
    small = begin(3, 4)
    assert small is not None
    assert begin(4, 1) is None, "12 and 4 are all there is"
    admission.give(running)
    admission.look([worker], [1, 2, 4])
    assert begin(1, 12) is not None
    assert admission.waited_for() == set()
    admission.give(small)
    admission.look([worker], [2, 4])
    assert begin(4, 1) is not None
