"""Pictures as a camera's sensor took them (DNG, CR2, CR3, NEF, ARW, RAF and others), through LibRaw: as Pillow's own formats are, so that all else is one.

Developed alike for all pictures of a set: white balance as shot, nothing that depends on the brightest pixel, sRGB. Pixels are as stored; the orientation goes
into EXIF.
"""

import io
from typing import Any

from PIL import Image, ImageFile
from PIL.ExifTags import IFD, Base
from PIL.JpegImagePlugin import JpegImageFile

from stages.io.decoders.jpeg_scans import MOST_SCANS, holds_more_scans

_ORIENTATIONS = {0: 1, 3: 3, 5: 8, 6: 6}  # LibRaw's -> EXIF's
_FOCAL_LENGTHS = (Base.FocalLength, Base.FocalLengthIn35mmFilm)
_DETAILS = (*_FOCAL_LENGTHS, Base.FocalPlaneXResolution, Base.FocalPlaneResolutionUnit, Base.ExifImageWidth, Base.LensModel)


class RawFile(ImageFile.ImageFile):
    """A camera's raw picture; it is developed when its pixels are loaded."""

    format = "RAW"
    format_description = "camera raw"

    def _open(self) -> None:
        try:
            import rawpy  # an extra
        except ImportError as error:
            raise ValueError("a camera's raw picture, which needs: pip install 'efficientnerf[raw]'") from error
        assert self.fp is not None
        data = self.fp.read()
        if holds_more_scans(data, MOST_SCANS):
            raise ValueError(f"a JPEG in it has more than {MOST_SCANS} scans, each of which takes as long as the picture")
        try:
            self._raw = rawpy.imread(io.BytesIO(data))
        except rawpy.LibRawError as error:
            raise ValueError(f"no raw picture of a known camera, or damaged ({_text(error)})") from error
        sizes = self._raw.sizes
        self._size, self._mode = (sizes.width, sizes.height), "RGB"
        self.info["exif"] = _exif(data, self._raw, _ORIENTATIONS.get(sizes.flip, 1)).tobytes()
        self.tile = [ImageFile._Tile("raw", (0, 0, *self.size), 0, self.mode)]

    def load(self) -> Any:
        if self.tile:
            import rawpy  # an extra

            options = {"use_camera_wb": True, "no_auto_bright": True, "output_bps": 8, "user_flip": 0, "adjust_maximum_thr": 0.0, "gamma": (2.4, 12.92)}
            try:
                pixels = self._raw.postprocess(output_color=rawpy.ColorSpace.sRGB, **options)
            except rawpy.LibRawError as error:
                raise ValueError(f"damaged ({_text(error)})") from error
            if pixels.shape != (self.size[1], self.size[0], 3):
                raise ValueError(f"of {pixels.shape[1]}x{pixels.shape[0]} pixels where {self.size[0]}x{self.size[1]} were stated")
            self.fp = io.BytesIO(pixels.tobytes())
            self._raw.close()
        return super().load()

    def load_seek(self, pos: int) -> None:
        """The pixels begin where the file does."""


def _exif(data: bytes, raw: Any, orientation: int) -> Any:
    """What of the camera's EXIF data is used; from the file itself where it is a TIFF, else from its preview."""
    exif = Image.Exif()
    exif[Base.Orientation] = orientation
    for found in (_of_tiff(data), _of_preview(raw)):
        details = dict(found.get_ifd(IFD.Exif)) if found is not None else {}
        if found is None or not any(tag in details for tag in _FOCAL_LENGTHS):
            continue
        for tag in (Base.Make, Base.Model):
            exif[tag] = str(found.get(tag, ""))
        exif[IFD.Exif] = {tag: details[tag] for tag in _DETAILS if tag in details}
        break
    return exif


def _of_tiff(data: bytes) -> Any:
    exif = Image.Exif()
    try:
        exif.load_from_fp(io.BytesIO(data))
        exif.get_ifd(IFD.Exif)
    except Exception:  # whatever a parser of TIFF stumbles over in another format
        return None
    return exif


def _of_preview(raw: Any) -> Any:
    try:
        return JpegImageFile(io.BytesIO(raw.extract_thumb().data)).getexif()
    except Exception:  # there is none, or it is no JPEG
        return None


def _text(error: Exception) -> str:
    found = error.args[0] if error.args else error
    return found.decode(errors="replace") if isinstance(found, bytes) else str(found)
