"""The scheduler on simulated workers: every scene comes to its end, and nothing takes more than there is."""

import itertools
import random
import signal
from pathlib import Path
from typing import Any

import pytest

from pipeline.errors import Interrupted, RunLocked, StageFailed
from pipeline.fleet import failure, forecast, requests, scheduler
from pipeline.fleet.state import Scene, read_fleet
from pipeline.fleet.workers import Task, Worker
from tests.pipeline.fleet.simulated import STAGES, Answer, Simulated, done, hurry, run, scene_of, scenes, state_of, what

GIB = 2**30


@pytest.fixture(autouse=True)
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    hurry(monkeypatch)


def at(scene: str, stage: str, times: int = 10**6, **result: Any) -> Answer:
    """An answer that is `result` for a stage of a scene, the first times, and else that all went well."""
    left = itertools.count()

    def answer(task: Task) -> dict[str, Any]:
        return {"ok": False, **result} if (scene_of(task), what(task.request)) == (scene, stage) and next(left) < times else done(task)

    return answer


def test_scenes_are_prepared_run_in_order_and_finished(tmp_path: Path) -> None:
    workers = Simulated([Worker("a", 4, slots=2), Worker("b", 4, slots=1)])
    found = run(tmp_path / "one", workers, scenes(7))
    assert read_fleet(tmp_path / "one") == found
    assert (found.state, found.exit_code, found.totals.done) == ("done", 0, 7)
    for scene in scenes(7):
        assert [stage for name, stage, _ in workers.log if name == scene.name] == ["prepare", *STAGES, "finish"]
    assert {worker: count for worker, (_, count) in workers.most.items()} == {"a": 2, "b": 1}
    assert state_of(found, "s3").seconds == 6.0
    assert workers.closed
    workers = Simulated([Worker("a", 1), Worker("b", 1)])  # those that have begun come first, and go on where they were
    run(tmp_path / "two", workers, scenes(6))
    assert all(len({worker for name, _, worker in workers.log if name == scene.name}) == 1 for scene in scenes(6))
    order = [name for name, stage, _ in workers.log if stage == "finish"]
    assert order.index("s0") < order.index("s4")


@pytest.mark.parametrize("result", [{"kind": "memory", "text": "out of memory."}, {"kind": "died", "signal": signal.SIGKILL, "text": "ended by SIGKILL."}])
def test_what_ran_out_of_memory_is_tried_once_in_half(tmp_path: Path, result: dict[str, Any]) -> None:
    workers = Simulated([Worker("a", 2, 4 * GIB)], at("s0", "bake", lines=["it said this"], **result))
    (scene,) = run(tmp_path, workers, scenes(1)).scenes
    given = [(task.memory, task.request["memory"]) for task in workers.tasks if what(task.request) == "bake"]
    assert given == [(4 * GIB, 4 * GIB), (2 * GIB, 2 * GIB)]
    assert (scene.state, scene.last_lines) == ("quarantined", ["it said this"])
    assert "2.0 GiB" in (scene.reason or "")
    assert (scene.stages["train"].state, scene.stages["bake"].state) == ("done", "failed")


def test_a_stage_whose_worker_died_is_tried_once_elsewhere(tmp_path: Path) -> None:
    workers = Simulated([Worker("a", 1), Worker("b", 1), Worker("c", 1)], lambda task: None if what(task.request) == "train" else done(task))

    def lose() -> None:
        for task in list(workers.running.values()):
            if what(task.request) == "train" and len(workers.workers) > 1:
                workers.lose(task.worker)
                return

    workers.between = lose
    told: list[dict[str, Any]] = []
    found = run(tmp_path, workers, scenes(1), report=told.append)
    tried = [worker for _, stage, worker in workers.log if stage == "train"]
    assert len(tried) == len(set(tried)) == 2
    assert found.scenes[0].state == "failed"  # the same command tries it again: a worker's death says little of the scene
    assert all(worker in (found.scenes[0].reason or "") for worker in tried)
    assert [event["event"] for event in told] == ["retry", "scene_failed"]


def test_a_locked_run_is_waited_for_and_fails_by_circumstances(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = "being written by process 7 on b."
    assert run(tmp_path, Simulated([Worker("a", 1)], at("s0", "train", 30, kind="locked", text=text)), scenes(2)).state == "done"
    monkeypatch.setattr(failure, "LOCKED_SECONDS", 0.0)
    found = run(tmp_path, Simulated([Worker("a", 1)], at("s0", "train", kind="locked", text=text)), scenes(2))
    assert (state_of(found, "s0").state, state_of(found, "s0").reason) == ("failed", text)
    assert run(tmp_path, Simulated([Worker("a", 1)]), scenes(2), former=read_fleet(tmp_path)).state == "done"


def test_shared_artifacts_are_made_once_and_waited_for(tmp_path: Path) -> None:
    chosen = [Scene("a", ("/x",)), Scene("b", ("/x",), shares={"poses": "a", "train": "a"}), Scene("c", ("/x",), shares={"poses": "a"})]
    workers = Simulated([Worker("w", 4, slots=4)])
    assert run(tmp_path, workers, chosen).state == "done"
    order = [(scene, stage) for scene, stage, _ in workers.log]
    donors = {(scene_of(task), what(task.request)): task.request.get("donor") for task in workers.tasks}
    assert donors["b", "poses"] == donors["c", "poses"] == donors["b", "train"] == str(tmp_path / "a")
    assert donors["a", "poses"] is donors["b", "bake"] is donors["c", "train"] is None
    assert order.index(("b", "train")) > order.index(("a", "train")) + 1 or order.index(("b", "train")) > order.index(("a", "bake")) - 1
    found = run(tmp_path, Simulated([Worker("w", 4, slots=4)], at("a", "poses", kind="input", text="no.")), chosen)
    assert {scene.name: scene.state for scene in found.scenes} == {"a": "quarantined", "b": "done", "c": "done"}, "they do it alone"


def test_a_signal_stops_all_and_leaves_nothing_running(tmp_path: Path) -> None:
    calls = itertools.count()
    workers = Simulated([Worker("a", 2, slots=2)])
    with pytest.raises(Interrupted) as caught:
        run(tmp_path, workers, scenes(5), stop=lambda: signal.SIGINT if next(calls) > 6 else None)
    assert caught.value.exit_code == 130
    found = read_fleet(tmp_path)
    assert found.state == "interrupted"
    assert not workers.running
    assert workers.closed
    assert {scene.state for scene in found.scenes} <= {"waiting", "done"}
    assert not [stage for scene in found.scenes for stage in scene.stages.values() if stage.state == "running"]
    assert run(tmp_path, Simulated([Worker("a", 2, slots=2)]), scenes(5), former=found).state == "done"


def test_a_lost_lease_ends_it_without_a_word_to_the_file(tmp_path: Path) -> None:
    calls = itertools.count()
    workers = Simulated([Worker("a", 1)])
    with pytest.raises(RunLocked, match="taken"):
        run(tmp_path, workers, scenes(5), lost=lambda: "taken" if next(calls) > 4 else None)
    assert workers.closed
    assert read_fleet(tmp_path).state == "running"  # it is another's now


def test_requests_are_obeyed_while_it_runs(tmp_path: Path) -> None:
    workers = Simulated([Worker("a", 1)], at("s0", "poses", 1, kind="input", text="no."))
    asked: list[str] = []

    def ask() -> None:
        if not asked and any(scene == "s1" for scene, _, _ in workers.log):
            asked.append("")
            requests.ask(tmp_path, "retry", ["s0", "nobody"])
            requests.ask(tmp_path, "cancel", ["s1", "s3"])

    workers.between = ask
    found = run(tmp_path, workers, scenes(5))
    assert {scene.name: scene.state for scene in found.scenes} == {"s0": "done", "s1": "failed", "s2": "done", "s3": "failed", "s4": "done"}
    assert requests.take(tmp_path) == []
    workers = Simulated([Worker("a", 1)])
    workers.between = lambda: requests.ask(tmp_path, "cancel", None) if len(workers.log) == 7 else None
    found = run(tmp_path, workers, scenes(50))
    assert (found.state, found.exit_code, found.totals.waiting > 40) == ("cancelled", 3, True)
    assert not workers.running


def test_what_is_asked_for_while_the_last_scene_ends_is_not_lost(tmp_path: Path) -> None:
    """A request that comes after the last look for requests, and before the fleet is given back."""
    told: list[str] = []

    def report(event: dict[str, Any]) -> None:
        told.append(f"{event['event']} {event['scene']}")
        if told[-1] == "scene_done s1":
            requests.ask(tmp_path, "retry", ["s0"])
        if told[-1] == "scene_done s0":
            requests.ask(tmp_path, "cancel", None)

    workers = Simulated([Worker("a", 1)], at("s0", "poses", 1, kind="input", text="no."))
    assert run(tmp_path, workers, scenes(2), report=report).state == "done"
    assert told == ["scene_quarantined s0", "scene_done s1", "scene_done s0"]
    assert requests.take(tmp_path) == []


def test_who_asks_learns_what_became_of_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    now = itertools.count()
    monkeypatch.setattr(requests.time, "monotonic", lambda: float(next(now)))
    monkeypatch.setattr(requests.time, "sleep", lambda seconds: None)
    ended = requests.ask(tmp_path, "retry", ["s0"])
    assert requests.outcome(ended, lambda: False) == "ended"
    assert not ended.exists()
    assert requests.outcome(requests.ask(tmp_path, "retry", ["s0"]), lambda: True) == "left"
    requests.ask(tmp_path, "cancel", None)
    assert requests.left(tmp_path) == ["s0"]
    taken = requests.ask(tmp_path, "cancel", ["s0"])
    taken.unlink()
    assert requests.outcome(taken, lambda: True) == "taken"


def test_without_a_worker_it_waits_and_then_gives_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    workers = Simulated([])
    calls = itertools.count()
    workers.between = lambda: workers.workers.append(Worker("late", 1)) if next(calls) == 5 else None
    assert run(tmp_path, workers, scenes(2)).state == "done"
    monkeypatch.setattr(scheduler, "LONGEST_ABSENCE", 0.0)
    monkeypatch.setattr(scheduler, "REPORT_SECONDS", 0.0)
    told: list[dict[str, Any]] = []
    nobody = Simulated([])
    with pytest.raises(StageFailed, match="2 scenes wait"):
        run(tmp_path, nobody, scenes(2), report=told.append)
    found = read_fleet(tmp_path)
    assert {scene.state for scene in found.scenes} == {"waiting"}
    assert (found.state, found.exit_code, len(told)) == ("interrupted", 3, 1)
    assert "2 scenes wait" in (found.note or "")
    assert nobody.closed
    again = run(tmp_path, Simulated([Worker("a", 1)]), scenes(2), former=found)
    assert (again.state, again.note) == ("done", None)


def test_jobs_of_a_queue_are_waited_for_and_so_are_those_after_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scheduler, "LONGEST_ABSENCE", 0.0)
    calls = itertools.count()

    def between() -> None:
        call = next(calls)
        if call == 20:
            workers.workers = [Worker("job", 1)]
        if call == 40:
            workers.lose("job")
        if call == 60:
            assert "as long as it takes" in (read_fleet(tmp_path).note or "")
            workers.workers = [Worker("next", 1)]

    monkeypatch.setattr(scheduler, "REPORT_SECONDS", 0.0)
    workers = Simulated([], between=between, queued=True)
    assert run(tmp_path, workers, scenes(6)).state == "done"
    assert next(calls) > 60


def test_stages_are_admitted_by_what_they_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two of them do not fit side by side, though there are workers for both; one alone never fits and fails by circumstances."""
    monkeypatch.setattr(forecast, "free_space", lambda fleet: forecast.RESERVE + 5 * GIB)
    together: list[int] = []

    def answer(task: Task) -> dict[str, Any]:
        together.append(sum(what(other.request) == "train" for other in workers.running.values()))
        large = scene_of(task) == "s2"
        return done(task, space={"poses": GIB, "train": (6 if large else 3) * GIB, "bake": 1})

    workers = Simulated([Worker("a", 2, slots=2), Worker("b", 2, slots=2)], answer)
    found = run(tmp_path, workers, scenes(5))
    assert max(together) == 1
    assert [scene.state for scene in found.scenes] == ["done", "done", "failed", "done", "done"]
    assert all(words in (state_of(found, "s2").reason or "") for words in ("train", "6.0 GiB", "5.0 GiB", str(tmp_path)))
    monkeypatch.setattr(forecast, "free_space", lambda fleet: forecast.RESERVE + 2 * GIB)  # s2 has written most of it, another not
    monkeypatch.setattr(forecast, "written_in", lambda run: 5 * GIB if run.name == "s2" else 0)
    spacious = Simulated([Worker("a", 2)], lambda task: done(task, space={"poses": 1, "train": 6 * GIB, "bake": 1}))
    assert [scene.state for scene in run(tmp_path / "other", spacious, scenes(3)).scenes] == ["failed", "failed", "done"]
    monkeypatch.setattr(forecast, "free_space", lambda fleet: forecast.RESERVE + 7 * GIB)
    assert run(tmp_path, Simulated([Worker("a", 2)], answer), scenes(5), former=found).state == "done"


def test_a_full_disk_fails_a_scene_and_the_next_command_tries_it_again(tmp_path: Path) -> None:
    workers = Simulated([Worker("a", 2)], at("s1", "bake", kind="disk", text="bake: no space left."))
    found = run(tmp_path, workers, scenes(3))
    assert [(scene.state, scene.reason) for scene in found.scenes] == [("done", None), ("failed", "bake: no space left."), ("done", None)]
    assert run(tmp_path, Simulated([Worker("a", 2)]), scenes(3), former=found).state == "done"


def test_whatever_happens_every_scene_comes_to_an_end(tmp_path: Path) -> None:
    """Random failures of every kind and workers that come and go: no scene is lost, no run has two writers, no worker has more than it holds."""
    kinds = ["input", "error", "memory", "refused", "locked", "disk", "died", "lost", "unheard", "stopped", "nonsense"]
    for seed in range(30):
        chance, numbers = random.Random(seed), itertools.count(10)

        def answer(task: Task, chance: random.Random = chance) -> dict[str, Any]:
            if chance.random() < 0.8:
                return done(task)
            return {"ok": False, "kind": chance.choice(kinds), "signal": chance.choice([None, 9, 11]), "text": "x", "needed": chance.randrange(6) * GIB}

        workers = Simulated([Worker(f"w{n}", chance.randint(1, 8), chance.choice([None, 4 * GIB]), slots=chance.randint(1, 3)) for n in range(3)], answer)

        def come_and_go(workers: Simulated = workers, chance: random.Random = chance, numbers: Any = numbers) -> None:
            if chance.random() < 0.1 and len(workers.workers) > 1:
                workers.lose(chance.choice(workers.workers).name)
            if chance.random() < 0.1:
                workers.workers.append(Worker(f"w{next(numbers)}", 2, 4 * GIB, slots=2))

        workers.between = come_and_go
        found = run(tmp_path / str(seed), workers, scenes(12))
        assert {scene.state for scene in found.scenes} <= {"done", "failed", "quarantined"}
        assert all((scene.reason is None) == (scene.state == "done") for scene in found.scenes)
        assert all(memory <= 4 * GIB for name, (memory, _) in workers.most.items() if name.startswith("w1") and len(name) > 2)
        assert not workers.running
