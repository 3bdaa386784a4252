"""Masks by a network that the user has: an ONNX file as rembg and others keep them, run by onnxruntime. Nothing is downloaded.

A network takes (1, 3, h, w) RGB, normalised, and gives (1, 1, h, w) of how much of each pixel is subject, as probabilities or as logits. The rest
follows rembg for the networks that it knows: U2-Net, silueta and BiRefNet are normalised by ImageNet's mean and deviation, IS-Net (DIS) by its own.
"""

from pathlib import Path

import cv2
import numpy as np

from stages.cores import count_cores
from stages.io.network_file import Network, in_words

MEAN, DEVIATION = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)  # of ImageNet
OWN_MEAN, OWN_DEVIATION = (0.5, 0.5, 0.5), (1.0, 1.0, 1.0)  # of IS-Net
SIDE, OWN_SIDE, MOST_SIDE = 320, 1024, 4096  # px, of networks that take any size: U2-Net's, and IS-Net's and BiRefNet's
LEAST_CONTRAST = 0.05  # between subject and background, below which there is no subject


class MaskNetwork(Network):
    def __init__(self, path: Path) -> None:
        super().__init__(path, "--mask-model", count_cores(), "makes masks", "Expected an ONNX file with one image in and one mask out, as rembg's.")
        inputs, outputs = self.inputs, self.outputs
        shape = inputs[0].shape if len(inputs) == 1 else []
        if len(shape) != 4 or inputs[0].type != "tensor(float)" or (isinstance(shape[1], int) and shape[1] != 3) or not outputs:
            raise self.refused(f"it takes {in_words(inputs)}")
        name = path.stem.lower()
        own = name.startswith("isnet") or ("dis" in name and "birefnet" not in name)
        self._mean, self._deviation = (np.array(each, np.float32) for each in ((OWN_MEAN, OWN_DEVIATION) if own else (MEAN, DEVIATION)))
        usual = OWN_SIDE if own or "birefnet" in name else SIDE
        self._size = tuple(side if isinstance(side, int) and side > 0 else usual for side in shape[2:])  # height, width
        if max(self._size) > MOST_SIDE:
            raise self.refused(f"it takes {self._size[1]}x{self._size[0]} pixels; at most {MOST_SIDE} on a side are given")
        self._input, self._output = inputs[0].name, outputs[0].name

    def mask(self, rgb: np.ndarray) -> np.ndarray | None:
        """(h, w) uint8 at the network's size: how much of each pixel of an sRGB image (H, W, 3) uint8 is subject, 0 to 255; None where there is none."""
        small = cv2.resize(rgb, self._size[::-1], interpolation=cv2.INTER_AREA).astype(np.float32)
        small = (small / max(float(small.max()), 1e-6) - self._mean) / self._deviation
        picture = np.ascontiguousarray(small.transpose(2, 0, 1)[None], np.float32)
        found = self.run([self._output], {self._input: picture})[0].astype(np.float64)
        if found.ndim != 4 or found.shape[0] != 1 or min(found.shape) < 1 or not np.isfinite(found).all():
            raise self.refused(f"it gives {found.shape}, or what is no number; expected (1, 1, height, width)")
        level = found[0, 0]
        if level.min() < -0.01 or level.max() > 1.01:  # logits
            level = 1 / (1 + np.exp(-np.clip(level, -60, 60)))
        low, high = float(level.min()), float(level.max())
        return None if high - low < LEAST_CONTRAST else np.round(255 * (level - low) / (high - low)).astype(np.uint8)
