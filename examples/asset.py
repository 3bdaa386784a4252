"""Render views of an asset in Python: python examples/asset.py runs/mine/bake/asset.nerftree views/"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

import efficientnerf as en


def write_views(asset: Path, folder: Path, count: int = 4, size: tuple[int, int] = (320, 240)) -> list[Path]:
    """Write PNGs of an asset from around it; transparent where nothing is. Returns their paths."""
    tree = en.load(asset)
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for camera in en.turntable_cameras(tree, frames=count, width=size[0], height=size[1]):
        picture: en.Rendering = en.render(tree, camera)
        alpha = picture.opacity[..., None]
        colour = picture.colour / np.maximum(alpha, 1e-6)  # it was premultiplied
        pixels = np.concatenate([colour, alpha], axis=-1).clip(0, 1) * 255 + 0.5
        paths.append(folder / f"{camera.name}.png")
        Image.fromarray(pixels.astype(np.uint8)).save(paths[-1])
    return paths


if __name__ == "__main__":
    write_views(Path(sys.argv[1]), Path(sys.argv[2]))
