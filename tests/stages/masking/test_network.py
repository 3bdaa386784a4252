"""Masks by a network that the user has: tiny ones, made here, in the shapes that rembg's have."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipeline.errors import BadInput
from stages.io.capture import Provenance
from stages.io.png import read_png, write_png
from stages.masking.made import masks_by_network
from stages.masking.photographs import mask_choice
from stages.poses.settings import PosesSettings

onnx = pytest.importorskip("onnx", reason="the package onnx, which makes the networks of these tests, is not installed")
pytest.importorskip("onnxruntime", reason="the package onnxruntime is not installed (extra rembg)")

from stages.masking.network import MaskNetwork  # noqa: E402

SIDE = 32


def red(path: Path, *, logits: bool = False, shape: tuple[Any, ...] = (1, 3, SIDE, SIDE), kind: int = 1) -> Path:
    """A network that calls what is redder than it is green the subject."""
    helper, tensor = onnx.helper, onnx.numpy_helper
    weights = np.array([[[[3.0]], [[-3.0]], [[0.0]]]], np.float32)
    nodes = [helper.make_node("Conv", ["image", "weights"], ["score"])]
    nodes.append(helper.make_node("Identity" if logits else "Sigmoid", ["score"], ["mask"]))
    graph = helper.make_graph(
        nodes, "red", [helper.make_tensor_value_info("image", kind, shape)], [helper.make_tensor_value_info("mask", kind, None)],
        [tensor.from_array(weights.astype(np.float32 if kind == 1 else np.float64), "weights")],
    )  # fmt: skip
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8), path)
    return path


def scene() -> np.ndarray:
    """(96, 128, 3): a red disc before green."""
    y, x = np.mgrid[:96, :128] + 0.5
    inside = np.hypot(x - 70, y - 50) < 24
    return np.where(inside[..., None], np.uint8([220, 40, 60]), np.uint8([40, 180, 60]))


@pytest.mark.parametrize("logits", [False, True])
@pytest.mark.parametrize("shape", [(1, 3, SIDE, SIDE), ("batch", 3, "height", "width")])
def test_the_subject_is_where_the_network_sees_it(tmp_path: Path, logits: bool, shape: tuple[Any, ...]) -> None:
    mask = MaskNetwork(red(tmp_path / "u2net.onnx", logits=logits, shape=shape)).mask(scene())
    assert mask.shape == ((SIDE, SIDE) if shape[2] == SIDE else (320, 320))
    height, width = mask.shape
    assert mask[int(50 / 96 * height), int(70 / 128 * width)] > 240
    assert mask[2, 2] < 15


def made(paths: dict[str, Path], model: Path, folder: Path, told: list[str]) -> dict[str, Path]:
    return masks_by_network(paths, model, folder, safe_point=lambda: None, progress=lambda *_: None, warn=lambda text, **_: told.append(text))


def test_masks_are_files_at_the_size_of_their_photographs_and_silhouettes(tmp_path: Path) -> None:
    for name, picture in (("a.png", scene()), ("b.png", np.full((96, 128, 3), 90, np.uint8))):
        write_png(picture, tmp_path / name)
    told: list[str] = []
    masks = made({name: tmp_path / name for name in ("a.png", "b.png")}, red(tmp_path / "net.onnx"), tmp_path / "masks", told)
    assert list(masks) == ["a.png"]
    assert told == ["--mask-model net.onnx: no subject in 1 of 2 photographs, such as b.png; they get no mask"]
    mask = read_png(masks["a.png"])
    expected = (scene() == [220, 40, 60]).all(-1)
    assert mask.shape == expected.shape
    assert ((mask > 127) & expected).sum() / ((mask > 127) | expected).sum() > 0.85
    assert mask_choice(PosesSettings(mask_model="net.onnx"), Provenance()) == "silhouette"
    with pytest.raises(BadInput):
        made({"b.png": tmp_path / "b.png"}, tmp_path / "net.onnx", tmp_path / "masks", told)


def test_what_is_no_such_network_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "text.onnx").write_text("no network")
    red(tmp_path / "flat.onnx", shape=(1, 3, SIDE))
    red(tmp_path / "grey.onnx", shape=(1, 1, SIDE, SIDE))
    red(tmp_path / "double.onnx", kind=11)
    for name in ("text", "flat", "grey", "double"):
        with pytest.raises(BadInput) as caught:
            MaskNetwork(tmp_path / f"{name}.onnx")
        assert "\n" not in str(caught.value)
        assert str(tmp_path / f"{name}.onnx") in str(caught.value)
    huge = MaskNetwork(red(tmp_path / "ok.onnx"))
    assert huge.mask(scene()) is not None
    with pytest.raises(BadInput):
        MaskNetwork(red(tmp_path / "huge.onnx", shape=(1, 3, 65536, 65536)))
