"""Training pixels on a device: `efficientnerf.training.pixels` without looking them up on the host. R rays, C views, P pixels."""

import numpy as np
import torch
from torch import Tensor

from efficientnerf.backends import dispatch
from efficientnerf.backends.layout import PixelTables
from efficientnerf.backends.transfer import sent
from efficientnerf.training.pixels import Pixels

MEMORY_FRACTION = 0.5  # of the device's free memory: photographs that would take more stay on the host
ROWS_AT_A_TIME = 2**24  # of images that are not in the host's memory


class DevicePixels:
    """The pixels, and all that their rays are made of, on a device. They are chosen on the host, by the same random numbers as there."""

    def __init__(self, pixels: Pixels, device: str | torch.device) -> None:
        self.pixels, self.device = pixels, torch.device(device)
        self.tables = PixelTables(*map(self._to_device, pixels.tables))
        free = torch.cuda.mem_get_info(self.device)[0] if self.device.type == "cuda" else np.inf
        self.images = self._images_to_device() if pixels.images.nbytes <= MEMORY_FRACTION * free else None

    def _to_device(self, values: np.ndarray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(self.device)

    def _images_to_device(self) -> Tensor:
        """All images, a part at a time where they are not in memory."""
        rows = self.pixels.images
        if isinstance(rows, np.ndarray):
            return self._to_device(rows)
        there = torch.empty(rows.shape, dtype=torch.uint8, device=self.device)
        for at in range(0, len(rows), ROWS_AT_A_TIME):
            there[at : at + ROWS_AT_A_TIME] = self._to_device(rows[at : at + ROWS_AT_A_TIME])
        return there

    def __len__(self) -> int:
        return len(self.pixels)

    def colours_to_send(self, index: np.ndarray) -> np.ndarray | None:
        """(R, 3 or 4) uint8 of pixels whose images stay on the host; None where they are here."""
        return np.ascontiguousarray(self.pixels.images[index]) if self.images is None else None

    def bundle(self, index: np.ndarray) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """`Pixels.bundle` on the device."""
        return self.bundle_at(*sent((np.ascontiguousarray(index), self.colours_to_send(index)), self.device))

    def bundle_at(self, at: Tensor, colour: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """The same of indices on the device, and `colours_to_send` there."""
        if colour is None:
            assert self.images is not None
            colour = self.images[at]
        return *dispatch.pixel_rays(self.tables, self.pixels.stride, at), colour.float() / 255


def on_host(pixels: Pixels | DevicePixels) -> Pixels:
    """The pixels where they are chosen."""
    return pixels.pixels if isinstance(pixels, DevicePixels) else pixels
