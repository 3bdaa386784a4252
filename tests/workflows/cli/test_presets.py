"""The presets that are shipped, against the real stages."""

from pathlib import Path

import pytest

from pipeline.errors import UsageError
from pipeline.stage import settings_dict, settings_from
from stages.settings import describe_settings
from workflows import asset
from workflows.cli.resolve import Settings, preset_names, read_preset, table_of

TYPES = {stage.name: stage.settings for stage in asset.STAGES}


PAPER = ["paper-n1", "paper-n2", "paper-n3", "paper-n4"]


def test_the_stages_are_in_order_and_these_presets_are_there() -> None:
    names = [stage.name for stage in asset.STAGES]
    assert names == ["poses", "train", "bake", "mesh", "splats", "evaluate", "turntable", "points"]
    assert all(set(stage.needs) <= set(names[:place]) for place, stage in enumerate(asset.STAGES))
    assert preset_names() == ["high", "nerf", "paper", *PAPER, "preview", "standard", "tiny"]


def test_the_papers_presets_are_the_papers() -> None:
    """Section 4.1 and table 3."""
    expected = {
        "field": "mlp", "sh_degree": 3, "hidden_dim": 256, "num_layers": 8, "coarse_hidden_dim": 128, "coarse_num_layers": 4, "occupancy_resolution": 384,
        "occupancy_initial_density": 10.0, "occupancy_beta": 0.1, "occupancy_rule": "momentum", "pivotal_threshold": 1e-4, "sampling": "efficient",
        "near_plane": 2.0, "far_plane": 6.0, "max_rays_per_batch": 1024, "sample_batch_size": "off", "iterations": 1_000_000, "learning_rate": 5e-4,
        "lr_final_ratio": 0.1, "lr_decay_steps": 500_000,
    }  # fmt: skip
    for name, samples in zip(PAPER, [(64, 2), (64, 3), (96, 4), (128, 5)], strict=True):
        settings = Settings(TYPES)
        settings.put_table(read_preset(name).table, name)
        train, bake = (settings.resolved()[stage] for stage in ("train", "bake"))
        assert {key: getattr(train, key) for key in expected} == expected
        assert (train.num_coarse_samples, train.samples_per_pivot) == samples
        assert train.max_pivots >= train.num_coarse_samples  # the paper drops none
        assert (bake.resolution // bake.brick_size, bake.brick_size) == (384, 4)


def test_a_preset_inherits_and_changes(tmp_path: Path) -> None:
    (tmp_path / "base.toml").write_text('description = "Base."\n[train]\niterations = 3\nseed = 1\n[mesh]\nmax_faces = 100\n', encoding="utf-8")
    (tmp_path / "middle.toml").write_text('description = "Middle."\ninherits = "base"\n[train]\nseed = 2\n', encoding="utf-8")
    (tmp_path / "heir.toml").write_text('description = "Heir."\ninherits = "middle"\n[train]\niterations = 5\n', encoding="utf-8")
    heir = read_preset("heir", tmp_path)
    assert heir.table == {"train": {"iterations": 5, "seed": 2}, "mesh": {"max_faces": 100}}
    assert (heir.inherits, heir.own) == ("middle", {"train": {"iterations": 5}})
    for name, parent in (("a", "b"), ("b", "c"), ("c", "b"), ("self", "self"), ("orphan", "nobody")):
        (tmp_path / f"{name}.toml").write_text(f'description = "."\ninherits = "{parent}"\n', encoding="utf-8")
    for name, named in (("a", "a -> b -> c -> b"), ("self", "self -> self"), ("orphan", "nobody")):
        with pytest.raises(UsageError, match=named):
            read_preset(name, tmp_path)


def test_the_settings_of_first_rank_are_few() -> None:
    common = [info for stage in asset.STAGES for info in describe_settings(stage.settings) if not info.advanced]
    assert 20 <= len(common) <= 30


@pytest.mark.parametrize("name", preset_names())
def test_presets_resolve_and_hold_only_what_differs(name: str) -> None:
    """From the defaults, and an heir from its parent."""
    preset = read_preset(name)
    assert preset.description.endswith(".")
    settings = Settings(TYPES)
    settings.put_table(preset.table, name)
    defaults, resolved = table_of(Settings(TYPES).resolved()), table_of(settings.resolved())
    assert not [setting for stage, entries in preset.table.items() for setting in entries if resolved[stage][setting] == defaults[stage][setting]]
    parent = read_preset(preset.inherits).table if preset.inherits else {}
    assert not [setting for stage, own in preset.own.items() for setting, value in own.items() if parent.get(stage, {}).get(setting) == value]


def test_every_setting_says_what_it_means_in_one_sentence() -> None:
    for stage in asset.STAGES:
        assert settings_from(stage.settings, settings_dict(stage.settings())) == stage.settings(), "a default is admitted by its type"
        for about in describe_settings(stage.settings):
            assert (about.doc[:1].isupper(), about.doc.endswith("."), ". " in about.doc) == (True, True, False), f"{stage.name}.{about.name}"
            for word in set(about.choices or ()) & {"auto", "off"}:
                assert f"{word}:" in about.doc or f"({word})" in about.doc or about.listed, f"{stage.name}.{about.name}: {word}"
