"""The presets that are shipped, against the real stages."""

from __future__ import annotations

from pathlib import Path

import pytest

from pipeline.errors import UsageError
from pipeline.stage import Stage, settings_dict, settings_from
from stages.settings import describe_settings
from workflows import asset
from workflows.cli.resolve import Settings, preset_names, read_preset, table_of

TYPES = {stage.name: stage.settings for stage in asset.STAGES}


def test_the_workflow_is_in_order() -> None:
    names = [stage.name for stage in asset.STAGES]
    assert names == ["poses", "train", "bake", "mesh", "splats", "evaluate", "turntable", "points"]
    for place, stage in enumerate(asset.STAGES):
        assert set(stage.needs) <= set(names[:place])


PAPER = ["paper-n1", "paper-n2", "paper-n3", "paper-n4"]


def test_these_are_there() -> None:
    assert preset_names() == ["high", "nerf", "paper", *PAPER, "preview", "standard", "tiny"]


def test_the_papers_presets_are_the_papers() -> None:
    """Section 4.1 and table 3."""
    samples = []
    for name in PAPER:
        settings = Settings(TYPES)
        settings.put_table(read_preset(name).table, name)
        train, bake = (settings.resolved()[stage] for stage in ("train", "bake"))
        samples.append((train.num_coarse_samples, train.samples_per_pivot))
        assert (train.field, train.sh_degree, train.hidden_dim, train.num_layers, train.coarse_hidden_dim, train.coarse_num_layers) == (
            "mlp",
            3,
            256,
            8,
            128,
            4,
        )
        assert (train.occupancy_resolution, train.occupancy_initial_density, train.occupancy_beta, train.occupancy_rule) == (384, 10.0, 0.1, "momentum")
        assert (train.pivotal_threshold, train.sampling, train.near_plane, train.far_plane) == (1e-4, "efficient", 2.0, 6.0)
        assert train.max_pivots >= train.num_coarse_samples  # the paper drops none
        assert (train.max_rays_per_batch, train.sample_batch_size, train.iterations, train.learning_rate) == (1024, "off", 1_000_000, 5e-4)
        assert (train.lr_final_ratio, train.lr_decay_steps) == (0.1, 500_000)
        assert (bake.resolution // bake.brick_size, bake.brick_size) == (384, 4)
    assert samples == [(64, 2), (64, 3), (96, 4), (128, 5)]


def test_a_preset_inherits_and_changes(tmp_path: Path) -> None:
    (tmp_path / "base.toml").write_text('description = "Base."\n[train]\niterations = 3\nseed = 1\n[mesh]\nmax_faces = 100\n', encoding="utf-8")
    (tmp_path / "middle.toml").write_text('description = "Middle."\ninherits = "base"\n[train]\nseed = 2\n', encoding="utf-8")
    (tmp_path / "heir.toml").write_text('description = "Heir."\ninherits = "middle"\n[train]\niterations = 5\n', encoding="utf-8")
    heir = read_preset("heir", tmp_path)
    assert heir.table == {"train": {"iterations": 5, "seed": 2}, "mesh": {"max_faces": 100}}
    assert (heir.inherits, heir.own) == ("middle", {"train": {"iterations": 5}})
    assert read_preset("base", tmp_path).inherits is None


def test_a_preset_cannot_inherit_from_itself_or_from_none(tmp_path: Path) -> None:
    for name, parent in (("a", "b"), ("b", "c"), ("c", "b"), ("self", "self"), ("orphan", "nobody")):
        (tmp_path / f"{name}.toml").write_text(f'description = "."\ninherits = "{parent}"\n', encoding="utf-8")
    with pytest.raises(UsageError, match=r"cannot inherit from itself \(a -> b -> c -> b\)"):
        read_preset("a", tmp_path)
    with pytest.raises(UsageError, match=r"cannot inherit from itself \(self -> self\)"):
        read_preset("self", tmp_path)
    with pytest.raises(UsageError, match=r"preset orphan: inherits 'nobody': no such preset\."):
        read_preset("orphan", tmp_path)


def test_an_heir_says_only_what_its_parent_does_not() -> None:
    for preset in map(read_preset, preset_names()):
        if preset.inherits is not None:
            parent = read_preset(preset.inherits).table
            assert not [f"{stage}.{name}" for stage, own in preset.own.items() for name, value in own.items() if parent.get(stage, {}).get(name) == value]


def test_the_settings_of_first_rank_are_few() -> None:
    common = [info for stage in asset.STAGES for info in describe_settings(stage.settings) if not info.advanced]
    assert 20 <= len(common) <= 30


@pytest.mark.parametrize("name", preset_names())
def test_presets_resolve_and_hold_only_what_differs(name: str) -> None:
    preset = read_preset(name)
    assert preset.description.endswith(".")
    settings = Settings(TYPES)
    settings.put_table(preset.table, name)
    defaults = table_of(Settings(TYPES).resolved())
    resolved = table_of(settings.resolved())
    for stage, entries in preset.table.items():
        for setting in entries:
            assert resolved[stage][setting] != defaults[stage][setting], f"{name}: {stage}.{setting} is the default"


def test_every_setting_says_what_it_means_in_one_sentence() -> None:
    for stage in asset.STAGES:
        for name, about in Settings(TYPES).about[stage.name].items():
            assert about.doc[:1].isupper(), f"{stage.name}.{name}"
            assert about.doc.endswith("."), f"{stage.name}.{name}"
            assert ". " not in about.doc, f"{stage.name}.{name}"


@pytest.mark.parametrize("stage", asset.STAGES, ids=lambda stage: stage.name)
def test_a_default_is_admitted_by_its_type(stage: Stage) -> None:
    defaults = settings_dict(stage.settings())
    assert settings_from(stage.settings, defaults) == stage.settings()


def test_words_that_choose_or_switch_off_are_explained() -> None:
    for stage in asset.STAGES:
        for about in describe_settings(stage.settings):
            for word in set(about.choices or ()) & {"auto", "off"}:
                assert f"{word}:" in about.doc or f"({word})" in about.doc or about.listed, f"{stage.name}.{about.name}: {word}"
