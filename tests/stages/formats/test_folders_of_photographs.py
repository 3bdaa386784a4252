"""Which files of a folder are photographs: nothing is left aside without a word, and nothing is read that is none."""

import unicodedata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipeline.errors import BadInput
from stages.formats import importers
from stages.formats.importers.description import describe_source
from stages.formats.importers.photographs import photographs
from stages.formats.importers.source import Source
from stages.io.material import find_material
from tests.stages import captures
from tests.stages.captures import HEIGHT, WIDTH, Settings

BLACK = np.zeros((HEIGHT, WIDTH), np.uint8)


def write(folder: Path, *names: str) -> Path:
    """Photographs, masks, and videos, which nobody opens here."""
    for seed, name in enumerate(names):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".mp4":
            path.write_bytes(b"")
        else:
            captures.write_picture(path, BLACK if "mask" in name.lower() else captures.picture(seed))
    return folder


def read(folder: Path, **more: Any) -> tuple[list[str], str]:
    """The names of what is read, and what is said."""
    source = Source(folder, **more)
    found = [source.name_of(path) for path in photographs(source)]
    return found, "\n".join(source.warnings())


# --- where they lie


def test_photographs_come_before_videos_unless_they_are_too_few(tmp_path: Path) -> None:
    """And a cover hides none of them; unless there is a folder `images`."""
    names = ["photos/1.png", "photos/2.png", "photos/3.png"]
    found, said = read(write(tmp_path / "a", "clip.mp4", *names))
    assert found == names
    assert "clip.mp4" in said
    found, said = read(write(tmp_path / "b", "clip.mp4", "cover.png", "photos/2.png"))
    assert found == ["clip.mp4"]
    assert "cover.png, photos/2.png" in said
    found, _ = read(write(tmp_path / "c", "cover.png", *names))
    assert found == ["cover.png", *names]
    assert find_material({"": tmp_path / "c"}, False, lambda text: None).paths.keys() == set(found)
    found, said = read(write(tmp_path / "d", "cover.png", "images/1.png", "images/2.png", "images/3.png", "images_4/1.png"))
    assert found == ["images/1.png", "images/2.png", "images/3.png"]
    assert "1 more image" in said


def test_photographs_in_other_folders_are_named(tmp_path: Path) -> None:
    folder = write(tmp_path, "1.png", "2.png", "3.png", "day 1/4.png", "day 2/5.png", "day 2/6.png", "masks/1.png", "Depth/1.png", "images_2/1.png")
    found, said = read(folder)
    assert found == ["1.png", "2.png", "3.png"]
    assert "3 more images in other folders (day 1, day 2) are not read, for 3 lie directly in it. Name the folders as sources of their own" in said
    told: list[str] = []
    find_material({"": folder}, False, told.append)
    assert "\n".join(told) == said
    assert said in describe_source(folder)["warnings"]
    assert read(write(tmp_path / "alone", "1.png", "2.png", "3.png", "masks/1.png"))[1] == ""


# --- one picture in two formats


def heic(path: Path, pixels: np.ndarray, **more: Any) -> Path:
    import pillow_heif

    pillow_heif.register_heif_opener()
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, "HEIF", quality=90, **more)
    return path


def smooth(seed: int) -> np.ndarray:
    """A picture that compression does little to."""
    small = Image.fromarray(captures.picture(seed, 6, 4))
    return np.asarray(small.resize((192, 128), Image.Resampling.BICUBIC))


def taken(time: str) -> bytes:
    exif = Image.Exif()
    exif.get_ifd(34665)[36867] = time
    return bytes(exif.tobytes())


def test_a_picture_in_two_formats_is_read_once(tmp_path: Path) -> None:
    folder = tmp_path / "shoot"
    for seed in range(3):
        captures.write_picture(folder / f"IMG_{seed}.JPG", smooth(seed), quality=90)
        heic(folder / f"IMG_{seed}.HEIC", smooth(seed))
    found, said = read(folder)
    assert found == ["IMG_0.JPG", "IMG_1.JPG", "IMG_2.JPG"]
    assert "3 pictures lie there twice, in two formats, and are read once (IMG_0.HEIC is IMG_0.JPG, " in said
    assert len(importers.files(folder, Settings())) == 6  # what they hold decides
    assert read(tmp_path)[0] == [f"shoot/{name}" for name in found]  # anywhere below, too


def test_the_time_tells_pictures_apart_and_the_one_that_has_it_is_read(tmp_path: Path) -> None:
    captures.write_picture(tmp_path / "a.jpg", smooth(0), exif=taken("2026:11:23 10:00:00"))
    heic(tmp_path / "a.heic", smooth(0), exif=taken("2026:11:23 10:00:01"))
    captures.write_picture(tmp_path / "b.jpg", smooth(1))
    heic(tmp_path / "b.heic", smooth(1), exif=taken("2026:11:23 10:00:02"))
    captures.write_picture(tmp_path / "c.jpg", smooth(2) // 2, exif=taken("2026:11:23 10:00:03"))  # edited
    heic(tmp_path / "c.heic", smooth(2), exif=taken("2026:11:23 10:00:03"))
    assert read(tmp_path)[0] == ["a.heic", "a.jpg", "b.heic", "c.jpg"]


# --- linked folders


def test_linked_folders_are_named_and_followed_where_that_is_allowed(tmp_path: Path) -> None:
    write(tmp_path / "disk", "1.png", "2.png", "sub/3.png")
    (tmp_path / "disk/sub/back").symlink_to(tmp_path / "disk")
    (tmp_path / "disk/sub/home").symlink_to(tmp_path / "source")
    source = tmp_path / "source"
    source.mkdir()
    (source / "photos").symlink_to(tmp_path / "disk")
    with pytest.raises(BadInput, match=r"photos -> .*--allow-"):
        photographs(Source(source))
    assert read(source, allow_outside=True) == (["photos/1.png", "photos/2.png", "photos/sub/3.png"], "")
    write(source, "4.png")
    found, said = read(source)
    assert found == ["4.png"]
    assert "holds linked folders, which are not followed (photos -> " in said


# --- names


def test_names_are_compared_composed(tmp_path: Path) -> None:
    """Archives made on macOS hold the letter and its accent, lists one character."""
    made = captures.cameras(4)
    composed = ["caf\u00e9_0.png", "\u00fcber_1.png", "images/\u00e5_2.png", "C:\\sets\\\u00e9t\u00e9_3.png"]
    frames = captures.frames(made)
    for seed, (frame, name) in enumerate(zip(frames, composed, strict=True)):
        frame["file_path"] = name if "/" in name or "\\" in name else f"images/{name}"
        file = unicodedata.normalize("NFD", name.replace("\\", "/").split("/")[-1])
        captures.write_picture(tmp_path / "images" / file, captures.picture(seed))
        captures.write_picture(tmp_path / "masks" / unicodedata.normalize("NFC", file), BLACK)
    captures.write_json(tmp_path / "transforms.json", {"w": WIDTH, "h": HEIGHT, "fl_x": 40.0, "frames": frames, "camera_model": "OPENCV"})
    capture = importers.IMPORTERS["nerfstudio"].read(tmp_path, Settings())
    assert len(capture.photos) == 4
    assert all(photo.mask is not None for photo in capture.photos)
    assert any("1 images are not where they are listed" in warning for warning in capture.warnings)  # that of the other computer
