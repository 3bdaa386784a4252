"""LPIPS: the perceptual distance of two images, by the features of a network trained to recognise things (Zhang et al. 2018, "The unreasonable effectiveness
of deep features as a perceptual metric").

    d(x, y) = sum_l mean_hw sum_c h_lc (f_l(x) - f_l(y))_c^2,  f_l of unit length at each pixel

with f_l the activations of AlexNet or VGG-16 after five of their ReLUs, and h_l >= 0 the heads that Zhang et al. fitted to people's judgement. The networks
are torchvision's and the heads LPIPS 0.1's; both come as files (`stages.evaluate`), for neither is part of this package. Only the convolutions are stated
here, so that torchvision itself, which does not work with every build of torch, is not needed.
"""

from collections.abc import Mapping
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor, nn

NETWORKS = ("alex", "vgg")
SMALLEST = 64  # pixels: with less, nothing is left of an image after the last pooling
# What the networks were trained with, for images from -1 to 1.
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
CHANNELS = {"alex": (64, 192, 384, 256, 256), "vgg": (64, 128, 256, 512, 512)}
TAPS = {"alex": (1, 4, 7, 9, 11), "vgg": (3, 8, 15, 22, 29)}  # modules of torchvision's `features` whose output is compared


def _layers(network: str) -> nn.Sequential:
    """torchvision's `alexnet().features` or `vgg16().features` up to the last tap, module for module."""
    if network == "alex":
        sizes = ((3, 64, 11, 4, 2), (64, 192, 5, 1, 2), (192, 384, 3, 1, 1), (384, 256, 3, 1, 1), (256, 256, 3, 1, 1))
        convolutions = [nn.Sequential(nn.Conv2d(i, o, k, stride, pad), nn.ReLU()) for i, o, k, stride, pad in sizes]
        pooled = [nn.MaxPool2d(3, 2), nn.MaxPool2d(3, 2), None, None, None]
        modules = [m for c, p in zip(convolutions, pooled, strict=True) for m in (*c, *([p] if p is not None else []))]
    else:
        modules = []
        for block, ((i, o), depth) in enumerate(zip(pairwise((3, 64, 128, 256, 512, 512)), (2, 2, 3, 3, 3), strict=True)):
            modules += [nn.MaxPool2d(2)] if block else []
            for n in range(depth):
                modules += [nn.Conv2d(i if n == 0 else o, o, 3, padding=1), nn.ReLU()]
    return nn.Sequential(*modules)


class Lpips:
    """`Lpips(network, features, heads)(image, truth)`.

    network   "alex" or "vgg"
    features  torchvision's state of the full network, of which `features.*` is used
    heads     LPIPS 0.1's state: `lin0.model.1.weight` (1, C, 1, 1) to `lin4.model.1.weight`
    Raises ValueError where a tensor is missing or of another shape.
    """

    def __init__(self, network: str, features: Mapping[str, Tensor], heads: Mapping[str, Tensor]) -> None:
        if network not in NETWORKS:
            raise ValueError(f"LPIPS network {network!r}: expected {' or '.join(NETWORKS)}")
        self.network = network
        self.layers = _layers(network)
        own = self.layers.state_dict()
        self.layers.load_state_dict({name: _checked(features, f"features.{name}", tensor.shape) for name, tensor in own.items()})
        self.layers.requires_grad_(False).eval()
        self.heads = [_checked(heads, f"lin{n}.model.1.weight", torch.Size((1, c, 1, 1))).float() for n, c in enumerate(CHANNELS[network])]

    @torch.no_grad()
    def __call__(self, image: np.ndarray, truth: np.ndarray, mask: np.ndarray | None = None) -> float:
        """The distance of two images (H, W, 3), sRGB, 0 to 1; at least 64 pixels a side. 0 where they are equal.

        mask  (H, W) bool: pixels that do not count are taken to be equal in both
        """
        if image.shape != truth.shape or image.ndim != 3 or min(image.shape[:2]) < SMALLEST:
            raise ValueError(f"LPIPS: images of shapes {image.shape} and {truth.shape}; expected two of one shape, at least {SMALLEST} pixels a side")
        if mask is not None:
            image = np.where(mask[..., None], image, truth)
        total = 0.0
        for one, other, head in zip(self._features(image), self._features(truth), self.heads, strict=True):
            total += float(((one - other) ** 2 * head).sum(dim=1).mean())
        return total

    def _features(self, image: np.ndarray) -> list[Tensor]:
        x = torch.from_numpy(np.ascontiguousarray(image, np.float32)).permute(2, 0, 1)[None] * 2 - 1
        x = (x - torch.tensor(SHIFT)[:, None, None]) / torch.tensor(SCALE)[:, None, None]
        found = []
        for n, layer in enumerate(self.layers):
            x = layer(x)
            if n in TAPS[self.network]:
                found.append(x / torch.sqrt((x**2).sum(dim=1, keepdim=True) + 1e-8))
        return found


def _checked(state: Mapping[str, Tensor], name: str, shape: torch.Size) -> Tensor:
    if name not in state:
        raise ValueError(f"tensor '{name}' is missing")
    if state[name].shape != shape:
        raise ValueError(f"tensor '{name}' is {tuple(state[name].shape)}; expected {tuple(shape)}")
    return state[name]
