"""Small networks that behave as a detector and a matcher do, in the layouts of public exports: corners by fixed convolutions, patches, nearest neighbours."""

from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

COUNT = 600  # features of a picture
WIDE = 49  # numbers of a descriptor


class _Graph:
    """Nodes and constants in order."""

    def __init__(self) -> None:
        self.nodes: list[Any] = []
        self.constants: list[Any] = []

    def constant(self, value: Any, kind: Any = np.float32) -> str:
        name = f"constant_{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value, kind), name))
        return name

    def add(self, operation: str, *inputs: str, out: str = "", **attributes: Any) -> str:
        name = out or f"value_{len(self.nodes)}"
        self.nodes.append(helper.make_node(operation, list(inputs), [name], **attributes))
        return name

    def save(self, path: Path, inputs: list[Any], outputs: list[Any]) -> Path:
        graph = helper.make_graph(self.nodes, path.stem, inputs, outputs, self.constants)
        onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), path)
        return path


def value(name: str, shape: tuple[Any, ...] | None, kind: int = TensorProto.FLOAT) -> Any:
    return helper.make_tensor_value_info(name, kind, shape)


def detector(path: Path, layout: str = "LightGlue-ONNX", size: tuple[Any, Any] = ("height", "width")) -> Path:
    """Harris corners and the patches round them: in pixels ("LightGlue-ONNX"), from -1 to 1 without a first axis ("TensorRT"), or with COLMAP's inputs."""
    g = _Graph()
    grey = g.add("Conv", "image", g.constant(np.reshape([0.3, 0.6, 0.1], (1, 3, 1, 1))))
    smooth = np.outer([1, 4, 6, 4, 1], [1, 4, 6, 4, 1])[None, None] / 256
    blurred = g.add("Conv", grey, g.constant(smooth), pads=[2, 2, 2, 2])
    slope = np.array([[-1, 0, 1], [-2, 0, 2], [-1, 0, 1]], np.float32)
    x, y = (g.add("Conv", blurred, g.constant(each[None, None]), pads=[1, 1, 1, 1]) for each in (slope, slope.T))
    xx, yy, xy = (g.add("AveragePool", g.add("Mul", a, b), kernel_shape=[5, 5], pads=[2, 2, 2, 2]) for a, b in ((x, x), (y, y), (x, y)))
    trace = g.add("Add", xx, yy)
    squared = g.add("Mul", g.constant(0.05), g.add("Mul", trace, trace))
    corner = g.add("Sub", g.add("Sub", g.add("Mul", xx, yy), g.add("Mul", xy, xy)), squared)
    peak = g.add("Equal", corner, g.add("MaxPool", corner, kernel_shape=[7, 7], strides=[1, 1], pads=[3, 3, 3, 3]))
    flat = g.add("Reshape", g.add("Mul", corner, g.add("Cast", peak, to=TensorProto.FLOAT)), g.constant([-1], np.int64))
    g.nodes.append(helper.make_node("TopK", [flat, g.constant([COUNT], np.int64)], ["strength", "place"]))
    shape = g.add("Shape", "image")
    height, width = (g.add("Gather", shape, g.constant(axis, np.int64)) for axis in (2, 3))
    column, row = g.add("Mod", "place", width), g.add("Div", "place", width)
    normalised = layout != "LightGlue-ONNX"
    sides = []
    for place, side in ((column, width), (row, height)):
        pixel, last = (g.add("Cast", each, to=TensorProto.FLOAT) for each in (place, g.add("Sub", side, g.constant(1, np.int64))))
        there = g.add("Sub", g.add("Div", g.add("Mul", pixel, g.constant(2.0)), last), g.constant(1.0)) if normalised else pixel
        sides.append(g.add("Unsqueeze", there, g.constant([1], np.int64)))
    keypoints = g.add("Concat", *sides, axis=1)
    around = np.eye(WIDE).reshape(WIDE, 1, 7, 7)
    patches = g.add("Conv", blurred, g.constant(around), pads=[9, 9, 9, 9], dilations=[3, 3])
    chosen = g.add("Gather", g.add("Reshape", patches, g.constant([WIDE, -1], np.int64)), "place", axis=1)
    rows = g.add("Transpose", chosen, perm=[1, 0])
    centred = g.add("Sub", rows, g.add("ReduceMean", rows, axes=[1], keepdims=1))
    length = g.add("Add", g.add("ReduceL2", centred, axes=[1], keepdims=1), g.constant(1e-6))
    descriptors = g.add("Div", centred, length)
    first = g.constant([0], np.int64)
    for name, found in (("keypoints", keypoints), ("descriptors", descriptors), ("scores", "strength")):
        g.add("Identity", found, out=name) if layout == "TensorRT" else g.add("Unsqueeze", found, first, out=name)
    inputs = [value("image", (1, 3, *size))]
    if layout == "COLMAP":
        inputs += [value("max_keypoints", (), TensorProto.INT64), value("min_score", ())]
    return g.save(path, inputs, [value(name, None) for name in ("keypoints", "descriptors", "scores")])


def matcher(path: Path, layout: str = "LightGlue-ONNX", like: float = 0.85) -> Path:
    """Descriptors that are each other's nearest: pairs ("LightGlue-ONNX"), or for each feature of the first picture one of the second or -1 ("COLMAP")."""
    g = _Graph()
    alike = g.add("MatMul", "desc0", g.add("Transpose", "desc1", perm=[0, 2, 1]))
    there, back = (g.add("Squeeze", g.add("ArgMax", alike, axis=axis, keepdims=0), g.constant([0], np.int64)) for axis in (2, 1))
    best = g.add("Squeeze", g.add("ReduceMax", alike, axes=[2], keepdims=0), g.constant([0], np.int64))
    count = g.add("Squeeze", g.add("Shape", there), g.constant([0], np.int64))
    own = g.add("Range", g.constant(0, np.int64), count, g.constant(1, np.int64))
    mutual = g.add("And", g.add("Equal", g.add("Gather", back, there), own), g.add("Greater", best, g.constant(like)))
    inputs = [value(f"{name}{k}", (1, f"n{k}", wide)) for name, wide in (("kpts", 2), ("desc", WIDE)) for k in (0, 1)]
    if layout == "COLMAP":
        g.add("Where", mutual, there, g.constant(-1, np.int64), out="matches0")
        g.add("Identity", best, out="mscores0")
        inputs += [value(f"image_size{k}", (1, 2)) for k in (0, 1)]
    else:
        which = g.add("Squeeze", g.add("NonZero", mutual), g.constant([0], np.int64))
        pairs = [g.add("Unsqueeze", each, g.constant([1], np.int64)) for each in (which, g.add("Gather", there, which))]
        g.add("Concat", *pairs, out="matches0", axis=1)
        g.add("Gather", best, which, out="mscores0")
    return g.save(path, inputs, [value("matches0", None, TensorProto.INT64), value("mscores0", None)])
