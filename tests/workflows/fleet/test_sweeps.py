"""Sweeps: the product of values, names of folders, and which scene makes what others share."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import pytest

from pipeline.errors import Mistakes, UsageError
from pipeline.fleet.state import MOST_SCENES, Scene, check_scenes
from pipeline.runner import run_stages, verify
from pipeline.sharing import take_over
from tests.workflows.toys import TOYS
from workflows.asset import STAGES, WORKFLOW
from workflows.cli.request import Options, plan_run
from workflows.fleet.sweeps import Sweep, read_sweeps, shared, split_values, swept, unswept
from workflows.workflow import Workflow

CHAIR, TABLE = Scene("chair", ("/chair",)), Scene("table", ("/table",))


def test_values_are_those_of_set() -> None:
    found = read_sweeps(["train.iterations=2000,4000,2000", "bake.max_mib=8,24.5", "mesh.max_faces=20k,100k"], WORKFLOW)
    assert found == [Sweep("train", "iterations", (2000, 4000)), Sweep("bake", "max_mib", (8.0, 24.5)), Sweep("mesh", "max_faces", ("20k", "100k"))]
    assert read_sweeps(["poses.mask_model=off,/net.onnx"], WORKFLOW) == [Sweep("poses", "mask_model", ("off", "/net.onnx"))], "it is given by hand"
    assert split_values("[1, 2],[3,4]") == ["[1, 2]", "[3,4]"]
    assert split_values("'a,b', \"c,'d\"") == ["'a,b'", '"c,\'d"']
    assert split_values("1,,2") == split_values("") == split_values("1,") == []
    with pytest.raises(Mistakes) as caught:
        read_sweeps(["train.iterations", "train.iterations=5,many", "bake.max_mb=8", "=1", "train.iterations=1", "train.seed=1,"], WORKFLOW)
    assert len(caught.value.details) == 6
    values = tuple(range(200))
    with pytest.raises(UsageError, match=str(MOST_SCENES)):
        swept([CHAIR], [Sweep("train", "iterations", values), Sweep("train", "seed", values)], STAGES)


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


def test_scenes_of_different_sources_presets_or_seeds_share_nothing() -> None:
    for another in ({"sources": ("/other",)}, {"preset": "tiny"}, {"seed": 1}):
        assert shared([CHAIR, replace(CHAIR, name="x", **another)], STAGES)[1].shares == {}  # type: ignore[arg-type]
    assert shared([CHAIR, replace(CHAIR, name="x")], STAGES)[1].shares == {stage.name: "chair" for stage in STAGES}


def test_long_names_are_numbered_and_the_swept_scene_is_known() -> None:
    for name, values in (("c" * 100, ("x" * 50, "x" * 51)), ("a--" + "c" * 80, ("x" * 50, "x" * 51)), ("chair", ("a b", "a_b", "", "é/../")),
                         ("椅" * 66, ("a", "b")), ("a--b", ("-1", "0")), ("a--0001x", ("1",))):  # fmt: skip
        made = swept([Scene(name, ("/c",))], [Sweep("bake", "licence", values)], STAGES)
        check_scenes(made)
        assert [scene.name[-6:] for scene in made] == ["--0001", "--0002"] or len(values[0]) < 50
        assert {unswept(scene.name, scene.sweep or {}) for scene in made} == {name} or len(name.encode()) > 83


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
