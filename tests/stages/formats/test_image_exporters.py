"""PNG, EXR and MP4: written, read again with the format's own library, compared."""

from pathlib import Path
from typing import Any

import av
import numpy as np
import OpenEXR
import pytest

from efficientnerf.evaluation.metrics import psnr
from efficientnerf.geometry.cameras import Camera, Similarity, project
from efficientnerf.rendering.colour import linear_from_srgb, linear_premultiplied, srgb_from_linear
from stages.formats.exporters.exr import write_exr
from stages.formats.exporters.frames import frame_from_rendering
from stages.formats.exporters.video import write_mp4
from stages.formats.exporters.writing import SourceFrame
from stages.io.png import read_png, write_png
from tests.fakes import BallTree

POSE = np.array([[1.0, 0, 0, 0], [0, 0, 1, -4], [0, -1, 0, 0], [0, 0, 0, 1]])  # looks along +y from y = -4, z up
CAMERA = Camera("front", 48, 36, "SIMPLE_PINHOLE", (60.0, 24.0, 18.0), POSE)


def passes(seen: Any) -> dict[str, Any]:
    return {name: getattr(seen, name) for name in ("colour", "opacity", "depth", "normal")}


def test_srgb_curve_and_its_inverse() -> None:
    assert linear_from_srgb(np.array([0.0, 0.04045, 0.5, 1.0])) == pytest.approx([0.0, 0.0031308, 0.2140411, 1.0], abs=1e-6)
    values = np.linspace(-0.1, 1.2, 50)
    np.testing.assert_allclose(srgb_from_linear(linear_from_srgb(values)), values, atol=1e-6)
    assert linear_from_srgb(np.zeros(3, np.float32)).dtype == np.float32


def test_png_keeps_its_pixels_and_bytes(tmp_path: Path) -> None:
    seen = BallTree().render(CAMERA)
    for background in (None, (1.0, 1.0, 1.0)):
        frame = frame_from_rendering(seen.colour, seen.opacity, background)
        assert frame.shape == (36, 48, 4 if background is None else 3)
        write_png(frame, tmp_path / "a.png")
        write_png(frame, tmp_path / "b.png")
        assert (read_png(tmp_path / "a.png") == frame).all()
        assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.png", "b.png"]


def test_exr_is_linear_premultiplied_and_in_the_capture_frame(tmp_path: Path) -> None:
    rotation = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    similarity = Similarity(0.25, rotation, np.array([0.3, 0.0, -0.1]))
    seen = BallTree(sigma=3.0).render(CAMERA)
    for name in ("a.exr", "b.exr"):
        write_exr(tmp_path / name, **passes(seen), camera=CAMERA, frame=SourceFrame(similarity))
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        channels = {name: channel.pixels for name, channel in file.channels().items()}
    assert set(channels) == {"R", "G", "B", "A", "depth.Z", *(f"{name}.{axis}" for name in ("normal", "position") for axis in "XYZ")}
    assert all(pixels.dtype == np.float32 and pixels.shape == (36, 48) for pixels in channels.values())
    np.testing.assert_array_equal(channels["A"], seen.opacity)
    rgb = np.stack([channels[k] for k in "RGB"], -1)
    np.testing.assert_allclose(rgb, linear_premultiplied(seen.colour, seen.opacity), atol=1e-6)
    np.testing.assert_allclose(channels["depth.Z"], seen.depth / 0.25, rtol=1e-6)
    assert np.isinf(channels["depth.Z"][0, 0])
    normal = np.stack([channels[f"normal.{k}"] for k in "XYZ"], -1)
    np.testing.assert_allclose(normal @ rotation.T, seen.normal, atol=1e-6)
    # the middle of the ball faces the camera, which in the capture's frame stands along R^T (0, -1, 0)
    np.testing.assert_allclose(normal[18, 24], rotation.T @ [0, -1, 0], atol=0.05)
    # what is hit lies where the camera sees it at that depth, on the ball
    position = np.stack([channels[f"position.{k}"] for k in "XYZ"], -1)
    hit = np.isfinite(seen.depth)
    assert (position[~hit] == 0).all()
    world = similarity.points(position[hit])
    pixels, depth = project(CAMERA, world)
    y, x = np.nonzero(hit)
    np.testing.assert_allclose(pixels, np.stack([x, y], 1) + 0.5, atol=1e-4)
    np.testing.assert_allclose(depth, seen.depth[hit], rtol=1e-6)
    assert len(world) > 100
    assert np.linalg.norm(world, axis=1).max() < 0.6 + 1e-3, "inside of the ball"


@pytest.mark.parametrize(("metric", "stated"), [(True, {"unit": "metre", "metersPerUnit": 1.0}), (False, {"unit": "unknown"})])
def test_exr_states_the_unit_of_depth(tmp_path: Path, metric: bool, stated: dict[str, object]) -> None:
    write_exr(tmp_path / "a.exr", **passes(BallTree().render(CAMERA)), camera=CAMERA, frame=SourceFrame(Similarity.identity(), metric))
    with OpenEXR.File(str(tmp_path / "a.exr")) as file:
        assert {name: value for name, value in file.header().items() if name in ("unit", "metersPerUnit")} == stated


def moving_frames(count: int, height: int, width: int) -> list[np.ndarray]:
    y, x = np.mgrid[0:height, 0:width] / 12.0
    pictures = []
    for k in range(count):
        rgb = np.stack([0.5 + 0.4 * np.sin(x + 0.3 * k), 0.5 + 0.4 * np.cos(y), np.full_like(x, k / count)], -1)
        pictures.append((rgb * 255).astype(np.uint8))
    return pictures


@pytest.mark.parametrize("size", [(64, 96), (63, 97)])
def test_mp4_decodes_to_its_frames(tmp_path: Path, size: tuple[int, int]) -> None:
    frames = moving_frames(7, *size)
    assert write_mp4(frames, tmp_path / "a.mp4", fps=24, crf=12) == 7
    write_mp4(iter(frames), tmp_path / "b.mp4", fps=24, crf=12)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.mp4", "b.mp4"]
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.pix_fmt, stream.frames, stream.average_rate) == ("h264", "yuv420p", 7, 24)
        assert (stream.width, stream.height) == (size[1] + size[1] % 2, size[0] + size[0] % 2)
        decoded = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
    assert len(decoded) == 7
    for frame, again in zip(frames, decoded, strict=True):
        assert psnr(again[: size[0], : size[1]] / 255.0, frame / 255.0) > 36
    # Colours come back without a cast: the wrong matrix or range would shift the means (the decoder rounds down, by up to 1.5).
    means = [np.abs(np.mean(a[: size[0], : size[1]].astype(float) - f, axis=(0, 1))).max() for f, a in zip(frames, decoded, strict=True)]
    assert max(means) < 2.0


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_a_full_disk_is_told_as_one_and_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write = OpenEXR.File.write
    monkeypatch.setattr(OpenEXR.File, "write", lambda file, path: write(file, "/dev/full"))
    with pytest.raises(OSError, match="Errno 28"):
        write_exr(tmp_path / "a.exr", **passes(BallTree().render(CAMERA)), camera=CAMERA)
    assert not list(tmp_path.iterdir())
