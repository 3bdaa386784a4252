"""Readers of photographs and masks."""

import json
from pathlib import Path

import numpy as np

from benchmarks.fuzz import image_bytes
from benchmarks.fuzz.datasets import COUNT, open_file, with_poses
from benchmarks.fuzz.reader import Opened, Reader
from tests.stages import captures

# The name that an input is given, by its first bytes: formats that hide under another extension are among the seeds.
_BY_HEAD = {b"\x89PNG": ".png", b"\xff\xd8": ".jpg", b"II*\0": ".tif", b"MM\0*": ".tif", b"RIFF": ".webp", b"BM": ".bmp", b"\0\0\0": ".heic"}


def _suffix(data: bytes) -> str:
    return next((suffix for head, suffix in _BY_HEAD.items() if data.startswith(head)), ".png")


def opened(folder: Path) -> Opened:
    """A folder of photographs of which one is the input: its header, its pixels as structure from motion and as later stages read them."""
    from stages.io import photo, pictures, working_images

    source = folder / "source"
    captures.write_pictures(source, [f"{k}.png" for k in range(3)])
    last = source / "x.png"

    def read(data: bytes) -> None:
        nonlocal last
        last.unlink(missing_ok=True)
        last = source / f"x{_suffix(data)}"
        last.write_bytes(data)
        refused: Exception | None = None
        for call in (pictures.read_header, lambda path: photo.read_photo(path, 16), working_images.decode):
            try:
                result = call(last)
            except pictures.UnreadableImage as error:
                refused = error
                continue
            pixels = getattr(result, "rgb", getattr(result, "pixels", None))
            assert pixels is None or (pixels.dtype == np.uint8 and pixels.ndim == 3 and pixels.size > 0), "pixels of another type"
        if refused is not None:
            raise refused

    return Opened(read, (("inspect", str(source)), ("inspect", str(source), "--json")))


def open_mask(folder: Path) -> Opened:
    """Both ways in which masks are read: for structure from motion and for the working images."""
    from stages.io import photo, working_images
    from stages.io.capture import Photo
    from stages.io.pictures import UnreadableImage

    source = folder / "source"
    captures.nerfstudio(source, captures.cameras(COUNT))
    document = json.loads((source / "transforms.json").read_text())
    document["frames"][0]["mask_path"] = "mask.png"
    captures.write_json(source / "transforms.json", document)
    image, path, out = source / "images" / "img_0.png", source / "mask.png", folder / "out"
    out.mkdir()
    taken = photo.read_photo(image, 16)

    def read(data: bytes) -> None:
        path.write_bytes(data)
        refused: Exception | None = None
        try:
            assert photo.read_mask_file(path, taken).shape == taken.rgb.shape[:2], "a mask of another size"
        except UnreadableImage as error:
            refused = error
        working_images.write(Photo(captures.cameras(COUNT)[0], image, path), out, "a.png", max_side=16)
        if refused is not None:
            raise refused

    return with_poses(read, source)


def mask_seeds() -> list[bytes]:
    """Masks of the photographs' size in every mode, and pictures of another."""
    import io

    from PIL import Image

    made = []
    pixels = np.random.default_rng(1).integers(0, 2, (captures.HEIGHT, captures.WIDTH), np.uint8) * 255
    kinds = [("L", "PNG"), ("1", "PNG"), ("RGB", "PNG"), ("RGBA", "PNG"), ("P", "PNG"), ("I;16", "PNG"), ("L", "JPEG"), ("L", "TIFF"), ("F", "TIFF")]
    for mode, kind in (*kinds, ("LA", "PNG"), ("I", "TIFF")):
        out = io.BytesIO()
        base = Image.fromarray(pixels)
        (Image.fromarray(pixels.astype(np.uint16) * 257) if mode == "I;16" else base.convert(mode)).save(out, kind)
        made.append(out.getvalue())
    return [*made, *image_bytes.seeds()[:3]]  # the last three of another size


READERS = (
    Reader("images", "photographs with EXIF: JPEG, PNG, TIFF, WEBP, BMP, HEIF, others under a wrong name", image_bytes.seeds, image_bytes.changed, opened,
           ("UnreadableImage",), every=200),
    Reader("posed_images", "an image of a posed data set", image_bytes.seeds, image_bytes.changed, open_file(captures.nerfstudio, "images/img_0.png"),
           every=100, share=0.2),
    Reader("masks", "masks of photographs", mask_seeds, image_bytes.changed, open_mask, ("UnreadableImage", "PipelineError"), every=200),
)  # fmt: skip
