"""The presets that are shipped, against the real stages."""

from __future__ import annotations

import pytest

from workflows import asset
from workflows.cli.resolve import Settings, preset_names, read_preset, table_of

TYPES = {stage.name: stage.settings for stage in asset.STAGES}


def test_the_workflow_is_in_order() -> None:
    names = [stage.name for stage in asset.STAGES]
    assert names == ["poses", "train", "bake", "evaluate", "turntable", "mesh", "points"]
    for place, stage in enumerate(asset.STAGES):
        assert set(stage.needs) <= set(names[:place])


PAPER = ["paper-n1", "paper-n2", "paper-n3", "paper-n4"]


def test_these_are_there() -> None:
    assert preset_names() == ["high", "nerf", *PAPER, "preview", "standard", "tiny"]


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


def test_every_setting_says_what_it_means() -> None:
    for stage in asset.STAGES:
        for name, about in Settings(TYPES).about[stage.name].items():
            assert about.doc, f"{stage.name}.{name}"
