"""The one place that opens picture files, whoever wrote them.

A file is recognised by its content, among the formats below and no others: Pillow knows more, and runs Ghostscript for one of them. Whatever the decoder
raises becomes UnreadableImage, so that one bad picture is left out and ends nothing. Pixels become 8 bits by the type of the file, never by their values:

    8 bits a channel            as they are; grey, palette, CMYK and LAB are converted to RGB by Pillow
    1 bit                       0 and 255
    16 bits, grey               value / 257, rounded
    16 bits, colour             the high byte, as Pillow reads it
    other widths, signed,       refused by name: what their white is the file does not say
    floating point

What is not sRGB by the picture's ICC profile is converted to it then (`decoders/colour_profile.py`); a profile that is damaged is left aside.
"""

import errno
import io
import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError
from PIL.ExifTags import Base

from pipeline.errors import PipelineError
from pipeline.files import open_plain
from pipeline.text import printable
from stages.io.decoders.colour_profile import AS_IT_IS, Conversion, conversion_of
from stages.io.decoders.jpeg_scans import has_more_scans, most_scans
from stages.io.decoders.raw import RawFile

FORMATS = ("PNG", "JPEG", "WEBP", "TIFF", "BMP", "HEIF", "AVIF", "RAW")  # Pillow's names, and our own; a JPEG of several pictures (MPO) comes with JPEG
RAW_SUFFIXES = (".dng", ".cr2", ".cr3", ".nef", ".nrw", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")  # most are TIFFs of a thumbnail to other readers
LOSSY = ("JPEG", "MPO", "WEBP", "HEIF", "AVIF")  # without a clean zero
MAX_SIDE = 65_535  # pixels
MAX_PIXELS = 178_956_970  # of a picture, from its header, before anything is decoded; Pillow's own limit
FEW_PIXELS = 32_000_000  # whatever the size of the file: memory stays within a few hundred MB
PIXELS_A_BYTE = 10_000  # of a larger picture at most: deflate makes 1,032 bytes of one, which are 8,256 pixels of 1 bit

_JPEG = ("JPEG", "MPO")
_LOWEST = 3  # rows and columns of a quantisation table that its coarseness is judged by; libjpeg's at quality 50 have this mean there
_LOWEST_MEAN = 118 / 9
_ALPHA_MODES = ("RGBA", "LA", "PA", "RGBa", "La")
# The fault of the process or the machine, not of one file: to leave pictures out for these would change results in silence.
ERRORS_OF_THE_MACHINE = (errno.EMFILE, errno.ENFILE, errno.ENOMEM)
# Nor may these leave a picture out: the engine has read all of the file just before, for its digest, so that they may be over by the next run, which would
# take the artifact without the picture for a fresh one.
_PASSING = (errno.EIO, errno.EACCES, errno.EPERM)


class UnreadableImage(Exception):
    """A picture that cannot be used; the text gives the reason, as "unreadable: ..."."""


@dataclass(frozen=True)
class Header:
    """The header of a picture."""

    # stored_width, stored_height: of the pixels as stored
    stored_width: int
    stored_height: int
    orientation: int  # EXIF's number, 1-8, of the pixels as they are decoded
    alpha: bool  # whether the format holds an alpha channel

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) after EXIF rotation."""
        width, height = self.stored_width, self.stored_height
        return (height, width) if self.orientation >= 5 else (width, height)


@contextmanager
def opened(path: Path, formats: Sequence[str] = FORMATS) -> Iterator[Any]:
    """A Pillow image of one of `formats`, whose pixels are not decoded yet. Nothing but decoding belongs into the block: whatever is raised in it becomes
    UnreadableImage, but for MemoryError, and OSError where the process has no more memory or open files, or the file cannot be read now.
    """
    try:
        with _Bounded(open_plain(path)) as file, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow remarks on damaged EXIF blocks, which do no harm here
            raw = path.suffix.lower() in RAW_SUFFIXES and "RAW" in formats
            image: Any
            with RawFile(file) if raw else Image.open(file, formats=_possible(file, formats)) as image:
                width, height = image.size
                _check_size(width, height, file.size)
                if image.format in _JPEG and has_more_scans(file, most_scans(width, height)):
                    raise UnreadableImage(f"unreadable: a JPEG of more than {most_scans(width, height)} scans, each of which takes as long as the picture")
                yield image
    except (UnreadableImage, MemoryError, PipelineError):
        raise
    except OSError as error:
        if error.errno in (*ERRORS_OF_THE_MACHINE, *_PASSING):
            raise
        raise UnreadableImage(f"unreadable: {_reason(error)}") from error
    except Exception as error:  # decoders raise whatever they stumble over: struct.error, TypeError, KeyError, RecursionError ...
        raise UnreadableImage(f"unreadable: {_reason(error)}") from error


class _Bounded(io.BufferedReader):
    """A file that never allocates more than it holds: decoders ask for as many bytes as a length in the file says."""

    def __init__(self, descriptor: int) -> None:
        super().__init__(io.FileIO(descriptor))
        self.size = os.fstat(descriptor).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        left = max(0, self.size - self.tell())
        return super().read(left if size is None or size < 0 else min(size, left))


def _check_size(width: int, height: int, size: int) -> None:
    """Raise UnreadableImage for more pixels than are read, or than a file of `size` bytes can mean in earnest."""
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE and width * height <= MAX_PIXELS):
        raise UnreadableImage(f"unreadable: {width}x{height} pixels; at most {MAX_SIDE} a side and {MAX_PIXELS // 10**6} million in all are read")
    if width * height > max(FEW_PIXELS, PIXELS_A_BYTE * size):
        raise UnreadableImage(f"unreadable: {width}x{height} pixels, more than {FEW_PIXELS // 10**6} million, in {size} bytes")


def _possible(file: _Bounded, formats: Sequence[str]) -> tuple[str, ...]:
    """The decoders that may try. Those of HEIF and AVIF are asked only for files of their kind, so that others never load them."""
    head = file.read(64)
    file.seek(0)
    brands = head[8 : min(64, int.from_bytes(head[:4], "big"))]
    if head[4:8] == b"ftyp" and (b"avif" in brands or b"avis" in brands) and "AVIF" in formats:
        return ("AVIF",)
    if head[4:8] == b"ftyp" and "HEIF" in formats:
        import pillow_heif  # other pictures are never decoded by it

        pillow_heif.register_heif_opener()
        return ("HEIF",)
    return tuple(name for name in formats if name not in ("HEIF", "AVIF", "RAW"))


def _reason(error: Exception) -> str:
    if isinstance(error, UnidentifiedImageError):
        return "no picture in a format that is read (PNG, JPEG, WebP, TIFF, BMP, HEIF, AVIF, camera raw), or damaged at its start"
    if isinstance(error, Image.DecompressionBombError):
        return f"more than {MAX_PIXELS // 10**6} million pixels"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    text = printable(next(iter(str(error).splitlines()), ""), 100)
    return text if text and isinstance(error, OSError | SyntaxError | ValueError) else f"damaged ({type(error).__name__}{': ' if text else ''}{text})"


def read_header(path: Path) -> Header:
    """Size, orientation and alpha of a picture; its pixels are not decoded. Raises UnreadableImage."""
    with opened(path) as image:
        return Header(image.width, image.height, orientation_of(image), image.mode in _ALPHA_MODES or "transparency" in image.info)


def orientation_of(image: Any) -> int:
    """EXIF's number, 1-8, of an opened image whose pixels are not decoded yet."""
    number = 1 if image.format == "HEIF" else exif_of(image).get(Base.Orientation, 1)  # libheif turns the pixels itself
    return int(number) if number in range(1, 9) else 1


def read_quality(path: Path) -> int | None:
    """1 to 100, the quality by libjpeg's count that a JPEG's luminance table stands for, whoever wrote it; None of other files. Raises UnreadableImage."""
    with opened(path) as image:
        tables = getattr(image, "quantization", None)
        if not tables:
            return None
        table = np.array(tables[min(tables)], np.float64).reshape(8, 8)  # in natural order, as Pillow has it
    scale = 100 * float(table[:_LOWEST, :_LOWEST].mean()) / _LOWEST_MEAN
    return int(np.clip(round(5000 / scale if scale > 100 else (200 - scale) / 2), 1, 100))


def exif_of(image: Any) -> Any:
    """The EXIF data before the pixels: getexif() would decode the whole of a PNG to look for a late block."""
    if image.format != "PNG":
        return image.getexif()
    exif = Image.Exif()
    exif.load(image.info.get("exif"))
    return exif


def holds_eight_bits(image: Any) -> bool:
    """Whether an opened PNG has at most 8 bits a channel: Pillow cuts 16 to 8 without a word."""
    return os.pread(image.fp.fileno(), 1, 24) <= b"\x08"  # IHDR's bit depth


def profile_of(image: Any) -> Conversion:
    """How the colours of an opened image become sRGB."""
    if image.mode in ("1", "LAB"):
        return AS_IT_IS  # no colours, or those of Pillow's own conversion
    grey = image.mode in ("L", "LA", "La") or image.mode.startswith("I")
    return conversion_of(image.info.get("icc_profile"), "L" if grey else "CMYK" if image.mode == "CMYK" else "RGB")


def rgb_and_alpha(image: Any, as_stored: bool = False) -> tuple[np.ndarray, np.ndarray | None]:
    """(rgb, alpha or None) as uint8 sRGB, decoded by the rules above; raises UnreadableImage for a type of pixel that has none.

    as_stored  without the picture's colour profile: of masks, whose levels are no colours
    """
    _refuse_unknown_samples(image)
    image.load()  # here, and not within NumPy, which takes some errors for another kind of object
    conversion = AS_IT_IS if as_stored else profile_of(image)
    alpha = None
    if image.mode.startswith("I"):
        deep = np.asarray(image)
        grey = np.rint(deep / 257.0).astype(np.uint8)
        see_through = image.info.get("transparency")
        alpha = None if see_through is None else np.where(deep == see_through, np.uint8(0), np.uint8(255))
        colours = Image.fromarray(grey)
    elif image.mode in _ALPHA_MODES or "transparency" in image.info:
        colours = (image.convert("LA") if image.mode == "La" else image).convert("RGBA")
        if conversion.transform is None:
            rgba = np.asarray(colours)
            return rgba[..., :3], rgba[..., 3]
        alpha = np.asarray(colours.getchannel("A"))
    else:
        colours = image
    if conversion.transform is not None:
        return conversion.rgb_of(colours), alpha
    return np.asarray(colours if colours.mode == "RGB" else colours.convert("RGB")), alpha


def grey_of(image: Any) -> np.ndarray:
    """(H, W) uint8 of an opened image for masks: its alpha channel where that leaves anything out, as Brush has it, else the largest of its channels as they
    are stored, whose levels are no colours. Black alone is 0: of 16 bits the least other level is 1."""
    rgb, alpha = rgb_and_alpha(image, as_stored=True)
    if alpha is not None and (alpha < 255).any():
        return alpha
    levels = rgb.max(axis=2)
    return np.maximum(levels, np.asarray(image) > 0) if image.mode.startswith("I") else levels


def integers_of(image: Any) -> np.ndarray:
    """(H, W) int32 samples of an opened PNG of one channel, as they are stored; raises UnreadableImage for another kind of picture."""
    if image.format != "PNG" or not (image.mode == "L" or image.mode.startswith("I")):
        raise UnreadableImage(f"unreadable: {image.format} of mode {image.mode}; expected a PNG of one channel")
    image.load()
    return np.asarray(image, np.int32)


def _refuse_unknown_samples(image: Any) -> None:
    """Raise UnreadableImage unless the samples are unsigned integers of up to 8, or of exactly 16 bits."""
    if image.format == "PNG":
        return  # 16 bits at most, unsigned, whatever Pillow's version calls them
    tags = getattr(image, "tag_v2", {})
    bits, kinds, white_is_zero = tags.get(258, (8,)), tags.get(339, (1,)), tags.get(262) == 0
    what = None
    if image.mode == "F" or 3 in kinds:
        what = "floating point"
    elif 2 in kinds:
        what = f"signed {max(bits)}-bit integer"
    elif image.mode.startswith("I") and (image.mode == "I" or set(bits) != {16} or white_is_zero):
        what = f"{max(bits)}-bit integer{' with white as 0' if white_is_zero else ''}"
    if what is not None:
        raise UnreadableImage(f"unreadable: {what} {image.format}: unsupported pixel type; convert it to 8 or 16 bits")
