"""The trained field on disk: the same after a round trip, and every kind of damage is refused."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save

from efficientnerf.geometry.cameras import Camera
from efficientnerf.model import state_of
from efficientnerf.rendering.field_renderer import FieldRenderer
from efficientnerf.training.settings import TrainSettings
from pipeline.errors import CorruptArtifact
from stages.artifacts import TrainOutputs
from stages.io.field_file import load_renderer, read_tensors, save_model, write_tensors
from tests.efficientnerf.balls import pose, untrained

CAMERA = Camera("view", 8, 6, "SIMPLE_PINHOLE", (10.0, 4.0, 3.0), pose(0.4, 0.3))


@pytest.mark.parametrize("contracted", [False, True])
@pytest.mark.parametrize("field", ["hash", "mlp"])
def test_a_saved_field_draws_the_same_picture(tmp_path: Path, field: str, contracted: bool) -> None:
    m = untrained(field=field, contracted=contracted)
    with torch.no_grad():
        for _, p in m.parameters():
            p.add_(torch.randn(p.shape, generator=torch.Generator().manual_seed(0)) * 0.1)
    save_model(m, 0.5, 20.0, tmp_path / TrainOutputs.field)
    again = load_renderer(tmp_path)
    assert (again.near, again.far) == (0.5, 20.0)
    assert again.model.settings == m.settings
    assert again.model.background == m.background
    for name, tensor in state_of(m).items():
        assert torch.equal(tensor, state_of(again.model)[name]), name
    assert np.array_equal(again.render(CAMERA).colour, FieldRenderer(m, 0.5, 20.0).render(CAMERA).colour)
    before = (tmp_path / TrainOutputs.field).read_bytes()
    save_model(again.model, 0.5, 20.0, tmp_path / TrainOutputs.field)
    assert (tmp_path / TrainOutputs.field).read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == [TrainOutputs.field]


def refused(folder: Path, *named: str) -> None:
    """That a field is refused in one short line, which names the file and all of `named`."""
    with pytest.raises(CorruptArtifact) as caught:
        load_renderer(folder)
    text = str(caught.value)
    assert text.isprintable()
    assert len(text) < 600
    assert [name for name in (TrainOutputs.field, *named) if name not in text] == [], text


def test_what_does_not_fit_is_named_and_hostile_text_stays_in_a_line(tmp_path: Path) -> None:
    path = tmp_path / TrainOutputs.field
    save_model(untrained(field="hash", contracted=False), 0.5, 20.0, path)
    tensors, about = read_tensors(path)
    write_tensors({name: t for name, t in tensors.items() if name != "sky.sh"}, about, path)
    refused(tmp_path, "sky.sh", "Train again")
    del about["sha256"], about["format"]
    values: dict[str, list[Any]] = {
        "settings": [[], {"field": 10**400}], "near": [10**400], "bounds": ["x", [[10**400] * 3] * 2], "background": [7], "ndc": [[]],
    }
    for name, hostile in values.items():
        for value in hostile:
            write_tensors(tensors, about | {name: value}, path)
            refused(tmp_path)
    write_tensors(tensors, about | {"settings": {"iterations": "many"}}, path)
    refused(tmp_path, "iterations", "Train again")
    for text in ("[" * 100_000, '{"format": 1' + "0" * 400 + "}", '{"format": []}', "[]", "1", '"\\ud800"'):
        path.write_bytes(save(tensors, metadata={"field": text}))
        refused(tmp_path)


def test_a_small_file_takes_no_memory_for_the_tables_that_it_states(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> None:
        raise AssertionError("a model of three gigabytes was made")

    monkeypatch.setattr("stages.io.field_file.model", refuse)
    stated = dataclasses.asdict(TrainSettings(field="hash", num_levels=24, log2_hashmap_size=24, finest_resolution=8192))
    about = {"settings": stated, "bounds": [[-1, -1, -1], [1, 1, 1]], "contracted": False, "near": 1.0, "far": 5.0, "background": None}
    side = stated["occupancy_resolution"] if isinstance(stated["occupancy_resolution"], int) else 128
    write_tensors(
        {"voxels": torch.zeros(side, side, side), "fine.table": torch.zeros(1, 2), "coarse.table": torch.zeros(1, 2)}, about, tmp_path / TrainOutputs.field
    )
    refused(tmp_path, "torch.float32", "expected")
