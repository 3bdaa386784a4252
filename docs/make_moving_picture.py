"""Write docs/still_life.webp, with which the README opens: the photographs one after another, the asset going round, and its normals.

python docs/make_moving_picture.py runs/demo
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from efficientnerf.asset.camera_paths import turntable_cameras
from efficientnerf.asset.format import load
from efficientnerf.asset.rendering import render
from stages.artifacts import BakeOutputs
from stages.framing.restriction import restricted
from stages.io.pictures import opened, rgb_and_alpha

SIZE = WIDTH, HEIGHT = 300, 225
FRAMES, SECONDS = 36, 5.0
SUPERSAMPLE = 2
CAPTION = 22  # pixels
MOST_BYTES = 1_000_000
PHOTOGRAPHS = Path(__file__).parent.parent / "examples" / "still_life"


def captioned(pane: np.ndarray, text: str) -> Image.Image:
    """A pane (HEIGHT, WIDTH, 3) of sRGB from 0 to 1, with its caption below."""
    whole = Image.new("RGB", (WIDTH, HEIGHT + CAPTION), "white")
    whole.paste(Image.fromarray(np.round(np.clip(pane, 0, 1) * 255).astype(np.uint8)), (0, 0))
    ImageDraw.Draw(whole).text((WIDTH / 2, HEIGHT + CAPTION / 2), text, fill="#555", anchor="mm", font=ImageFont.load_default(13))
    return whole


def pictures(run: Path) -> list[Image.Image]:
    tree = restricted(load(BakeOutputs.of_run(run).asset), "foreground")
    photographs = sorted(PHOTOGRAPHS.glob("*.jpg"))
    made = []
    for k, camera in enumerate(turntable_cameras(tree, frames=FRAMES, width=WIDTH, height=HEIGHT)):
        with opened(photographs[k * len(photographs) // FRAMES]) as image:
            photograph = Image.fromarray(rgb_and_alpha(image)[0]).resize(SIZE, Image.Resampling.LANCZOS)
        rendering = render(tree, camera, background=(1.0, 1.0, 1.0), supersample=SUPERSAMPLE)
        seen = rendering.opacity[..., None]
        panes = (
            captioned(np.asarray(photograph) / 255, f"{len(photographs)} photographs"),
            captioned(rendering.colour, "the asset"),
            captioned((rendering.normal * 0.5 + 0.5) * seen + 1 - seen, "its normals"),
        )
        strip = Image.new("RGB", (WIDTH * len(panes), HEIGHT + CAPTION), "white")
        for n, pane in enumerate(panes):
            strip.paste(pane, (n * WIDTH, 0))
        made.append(strip)
    return made


def main() -> None:
    target = Path(__file__).parent / "still_life.webp"
    first, *others = pictures(Path(sys.argv[1]))
    first.save(target, save_all=True, append_images=others, duration=round(1000 * SECONDS / FRAMES), loop=0, quality=60, method=6)
    if target.stat().st_size > MOST_BYTES:
        raise SystemExit(f"{target}: {target.stat().st_size:,} bytes, more than {MOST_BYTES:,}")
    print(f"{target}: {target.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
