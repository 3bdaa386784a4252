"""Sweeps: the product of values, names of folders, and which scene makes what others share."""

from __future__ import annotations

import itertools
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


def test_lists_and_quotes_keep_their_commas() -> None:
    assert split_values("[1, 2],[3,4]") == ["[1, 2]", "[3,4]"]
    assert split_values("'a,b', \"c,'d\"") == ["'a,b'", '"c,\'d"']
    assert split_values("1,,2") == split_values("") == split_values("1,") == []


def test_all_mistakes_of_sweeps_at_once() -> None:
    with pytest.raises(Mistakes) as caught:
        read_sweeps(["train.iterations", "train.iterations=5,many", "bake.max_mb=8", "=1", "train.iterations=1", "train.seed=1,"], WORKFLOW)
    assert len(caught.value.details) == 6
    assert read_sweeps(["poses.mask_model=off,/net.onnx"], WORKFLOW) == [Sweep("poses", "mask_model", ("off", "/net.onnx"))], "it is given by hand"


def test_each_scene_with_each_combination() -> None:
    sweeps = [Sweep("train", "iterations", (2000, 4000)), Sweep("bake", "max_mib", (8.0, 24.5))]
    made = swept([CHAIR, TABLE], sweeps, STAGES)
    check_scenes(made)
    assert [scene.name for scene in made[:4]] == [f"chair--iterations-{n}--max_mib-{m}" for n, m in itertools.product((2000, 4000), ("8.0", "24.5"))]
    assert [scene.sweep for scene in made[4:]] == [{"train.iterations": n, "bake.max_mib": m} for n, m in itertools.product((2000, 4000), (8.0, 24.5))]
    assert all(
        scene.settings == {"train": {"iterations": scene.sweep["train.iterations"]}, "bake": {"max_mib": scene.sweep["bake.max_mib"]}}
        for scene in made
        if scene.sweep
    )


def test_what_comes_before_the_swept_stage_is_shared() -> None:
    sweeps = [Sweep("train", "iterations", (1, 2)), Sweep("bake", "max_mib", (8.0, 24.0))]
    a, b, c, d, other, *_ = swept([CHAIR, TABLE], sweeps, STAGES)
    assert a.shares == {} == other.shares
    assert b.shares == {"poses": a.name, "train": a.name}
    assert c.shares == {"poses": a.name}
    assert d.shares == {"poses": a.name, "train": c.name}


def test_scenes_of_different_sources_presets_or_seeds_share_nothing() -> None:
    from dataclasses import replace

    for another in (replace(CHAIR, name="x", sources=("/other",)), replace(CHAIR, name="x", preset="tiny"), replace(CHAIR, name="x", seed=1)):
        assert shared([CHAIR, another], STAGES)[1].shares == {}
    again = shared([CHAIR, replace(CHAIR, name="x")], STAGES)[1].shares
    assert again == {stage.name: "chair" for stage in STAGES}


def test_long_names_are_numbered() -> None:
    made = swept([Scene("c" * 100, ("/c",))], [Sweep("bake", "licence", ("x" * 50, "x" * 51))], STAGES)
    check_scenes(made)
    assert [scene.name[-6:] for scene in made] == ["--0001", "--0002"]
    check_scenes(swept([CHAIR], [Sweep("bake", "licence", ("a b", "a_b", "", "é/../"))], STAGES))
    check_scenes(swept([Scene("椅" * 66, ("/c",))], [Sweep("bake", "licence", ("a", "b"))], STAGES))


def test_the_scene_that_was_swept_is_known_whatever_its_name() -> None:
    sweeps = [Sweep("train", "iterations", (1, 2)), Sweep("bake", "seed", (-1, 0)), Sweep("train", "seed", (5,))]
    for name in ("a--b", "a--c", "a--0001x", "chair"):
        assert {unswept(each.name, each.sweep or {}) for each in swept([Scene(name, ("/a",))], sweeps, STAGES)} == {name}
    numbered = swept([Scene("a--" + "c" * 80, ("/c",))], [Sweep("bake", "licence", ("x" * 50, "x" * 51))], STAGES)
    assert {unswept(each.name, each.sweep or {}) for each in numbered} == {"a--" + "c" * 80}


def test_a_sweep_is_bounded() -> None:
    values = tuple(range(200))
    with pytest.raises(UsageError, match=f"at most {MOST_SCENES}"):
        swept([CHAIR], [Sweep("train", "iterations", values), Sweep("train", "seed", values)], STAGES)


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
