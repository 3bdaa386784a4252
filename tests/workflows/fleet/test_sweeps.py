"""Sweeps: the product of values, names of folders, and which scene makes what others share."""

import itertools
from pathlib import Path

from pipeline.fleet.state import Scene, check_scenes
from pipeline.runner import run_stages, verify
from pipeline.sharing import take_over
from tests.workflows.toys import TOYS
from workflows.asset import STAGES
from workflows.cli.request import Options, plan_run
from workflows.fleet.sweeps import Sweep, swept
from workflows.workflow import Workflow

CHAIR, TABLE = Scene("chair", ("/chair",)), Scene("table", ("/table",))


def test_combinations_share_what_comes_before_the_swept_stage() -> None:
    sweeps = [Sweep("train", "iterations", (2000, 4000)), Sweep("bake", "max_mib", (8.0, 24.5))]
    made = swept([CHAIR, TABLE], sweeps, STAGES)
    check_scenes(made)
    combinations = list(itertools.product((2000, 4000), (8.0, 24.5)))
    assert [scene.name for scene in made[:4]] == [f"chair--iterations-{n}--max_mib-{m}" for n, m in combinations]
    assert [scene.sweep for scene in made[4:]] == [{"train.iterations": n, "bake.max_mib": m} for n, m in combinations]
    assert [scene.settings for scene in made[4:]] == [{"train": {"iterations": n}, "bake": {"max_mib": m}} for n, m in combinations]
    a, b, c, d, other, *_ = made
    assert a.shares == {} == other.shares
    assert b.shares == {"poses": a.name, "train": a.name}
    assert c.shares == {"poses": a.name}
    assert d.shares == {"poses": a.name, "train": c.name}


def test_what_is_shared_has_the_same_request(toys: Path, tmp_path: Path) -> None:
    """Each stage that `shared` names is taken over from the run that it names, and no other is; the runs are then as if each had been made alone."""
    workflow = Workflow(TOYS, toys.parent / "presets")
    scenes = swept([Scene("s", (str(toys),))], [Sweep("poses", "repeat", (1, 2)), Sweep("train", "rate", (0.5, 1.0))], TOYS)
    taken = 0
    for scene in scenes:
        plan = plan_run(tmp_path / "fleet" / scene.name, workflow, Options(source=toys, sets=tuple(_sets(scene))))
        alone = plan_run(tmp_path / "alone" / scene.name, workflow, Options(source=toys, sets=tuple(_sets(scene))))
        with plan.written() as run, alone.written() as reference:
            for stage in TOYS:
                for donor in scenes[: scenes.index(scene)]:
                    took = take_over(run, stage, tmp_path / "fleet" / donor.name)
                    assert not took or scene.shares[stage.name] == donor.name
                    taken += took
                outcome = run_stages(run, TOYS, until=stage.name)[-1]
                assert (outcome.action == "skipped") == (stage.name in scene.shares)
            assert [each.digest for each in verify(run, TOYS)] == [each.digest for each in run_stages(reference, TOYS)]
    assert taken == sum(len(scene.shares) for scene in scenes) == 2


def _sets(scene: Scene) -> list[str]:
    return [f"{stage}.{name}={value}" for stage, table in scene.settings.items() for name, value in table.items()]
