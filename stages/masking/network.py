"""Masks by a network that the user has: an ONNX file as rembg and others keep them, run by onnxruntime. Nothing is downloaded.

A network takes (1, 3, h, w) RGB, normalised, and gives (1, 1, h, w) of how much of each pixel is subject, as probabilities or as logits. What a file does not
say is as rembg has it for the networks that it knows: U2-Net, silueta and BiRefNet are normalised by ImageNet's mean and deviation, IS-Net (DIS) by its own.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pipeline.errors import BadInput, UsageError
from pipeline.files import open_plain
from pipeline.text import printable
from stages.cores import count_cores

MOST_BYTES = 2**31 - 1  # an ONNX file cannot have more
MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet
OWN_MEAN, OWN_DEVIATION = (0.5, 0.5, 0.5), (1.0, 1.0, 1.0)  # of IS-Net
SIDE, OWN_SIDE, MOST_SIDE = 320, 1024, 4096  # px, of networks that take any size: U2-Net's, and IS-Net's and BiRefNet's
LEAST_CONTRAST = 0.05  # between subject and background, below which there is no subject


class MaskNetwork:
    """Raises UsageError where onnxruntime or the file is missing, BadInput where the file holds no such network."""

    def __init__(self, path: Path) -> None:
        self._path = path
        data = _bytes_of(path)
        try:
            import onnxruntime
        except ImportError:
            raise UsageError("--mask-model needs the package onnxruntime, which is not installed. Install it: pip install 'efficientnerf[rembg]'") from None
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = count_cores()
        options.log_severity_level = 4  # what fails is said here
        try:
            self._session: Any = onnxruntime.InferenceSession(data, options, providers=["CPUExecutionProvider"])
        except Exception as error:  # a class of its own for each status, of which only Exception is common
            raise self._refused(printable(error, 200)) from error
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        shape = inputs[0].shape if len(inputs) == 1 else []
        if len(shape) != 4 or inputs[0].type != "tensor(float)" or (isinstance(shape[1], int) and shape[1] != 3) or not outputs:
            raise self._refused(f"it takes {', '.join(f'{each.name} {each.type} {each.shape}' for each in inputs)}")
        name = path.stem.lower()
        own = name.startswith("isnet") or ("dis" in name and "birefnet" not in name)
        self._mean, self._deviation = (np.array(each, np.float32) for each in ((OWN_MEAN, OWN_DEVIATION) if own else (MEAN, DEVIATION)))
        usual = OWN_SIDE if own or "birefnet" in name else SIDE
        self._size = tuple(side if isinstance(side, int) and side > 0 else usual for side in shape[2:])  # height, width
        if max(self._size) > MOST_SIDE:
            raise self._refused(f"it takes {self._size[1]}x{self._size[0]} pixels; at most {MOST_SIDE} on a side are given")
        self._input, self._output = inputs[0].name, outputs[0].name

    def mask(self, rgb: np.ndarray) -> np.ndarray | None:
        """(h, w) uint8 at the network's size: how much of each pixel of an sRGB image (H, W, 3) uint8 is subject, 0 to 255; None where there is none."""
        import cv2

        small = cv2.resize(rgb, self._size[::-1], interpolation=cv2.INTER_AREA).astype(np.float32)
        small = (small / max(float(small.max()), 1e-6) - self._mean) / self._deviation
        try:
            found = self._session.run([self._output], {self._input: np.ascontiguousarray(small.transpose(2, 0, 1)[None], np.float32)})[0]
        except Exception as error:
            raise self._refused(printable(error, 200)) from error
        found = np.asarray(found, np.float64)
        if found.ndim != 4 or found.shape[0] != 1 or min(found.shape) < 1 or not np.isfinite(found).all():
            raise self._refused(f"it gives {found.shape}, or what is no number; expected (1, 1, height, width)")
        level = found[0, 0]
        if level.min() < -0.01 or level.max() > 1.01:  # logits
            level = 1 / (1 + np.exp(-np.clip(level, -60, 60)))
        low, high = float(level.min()), float(level.max())
        return None if high - low < LEAST_CONTRAST else np.round(255 * (level - low) / (high - low)).astype(np.uint8)

    def _refused(self, why: str) -> BadInput:
        expected = "Expected an ONNX file with one image in and one mask out, as rembg's."
        return BadInput(f"--mask-model {self._path}: no network that makes masks ({why}). {expected}")


def _bytes_of(path: Path) -> bytes:
    try:
        with open(open_plain(path), "rb") as file:
            data = file.read(MOST_BYTES + 1)
    except OSError as error:
        remedy = "Name the ONNX file of a network that you have; none is downloaded."
        raise UsageError(f"--mask-model {path}: cannot be read ({error.strerror or error}). {remedy}") from None
    if len(data) > MOST_BYTES:
        raise UsageError(f"--mask-model {path}: of more than {MOST_BYTES:,} bytes, which no ONNX file has.")
    return data
