"""Photographs of 12 megapixels under a limit of the system: their pixels alone are more than the 1.6 GiB that the process gets."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).resolve().parents[3]
COUNT, DIFFERENT, WIDTH = 50, 5, 4000
LIMIT = int(1.6 * 2**30)
RUN = """
import resource, sys
resource.setrlimit(resource.RLIMIT_DATA, (int(sys.argv.pop(1)),) * 2)
from workflows.cli.main import main
sys.exit(main())
"""


def write_images(folder: Path, count: int, width: int) -> None:
    """Noise of low frequency from cameras on a circle, with their transforms.json."""
    height, rng, frames = 3 * width // 4, np.random.default_rng(0), []
    for n in range(count):
        small = rng.integers(0, 256, (30, 40, 3), np.uint8)
        Image.fromarray(small).resize((width, height), Image.Resampling.BICUBIC).save(folder / f"{n:04d}.jpg", quality=92)
        centre = np.array([4 * np.cos(2.4 * n), 4 * np.sin(2.4 * n), 0.6 + 2.4 * n / count])
        pose = np.eye(4)  # x right, y up, looking along -z at the middle
        pose[:3, 2], pose[:3, 3] = centre / np.linalg.norm(centre), centre
        pose[:3, 0] = np.cross([0.0, 0.0, 1.0], pose[:3, 2])
        pose[:3, 0] /= np.linalg.norm(pose[:3, 0])
        pose[:3, 1] = np.cross(pose[:3, 2], pose[:3, 0])
        frames.append({"file_path": f"{n:04d}.jpg", "transform_matrix": pose.tolist()})
    lens = {"camera_model": "PINHOLE", "w": width, "h": height, "fl_x": 0.9 * width, "fl_y": 0.9 * width, "cx": width / 2, "cy": height / 2}
    (folder / "transforms.json").write_text(json.dumps({**lens, "frames": frames}), encoding="utf-8")


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A few pictures under many names."""
    folder = tmp_path_factory.mktemp("photographs")
    write_images(folder, DIFFERENT, WIDTH)
    described = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))
    for number in range(DIFFERENT, COUNT):
        frame = described["frames"][number % DIFFERENT]
        os.link(folder / frame["file_path"], folder / f"{number:04d}.jpg")
        described["frames"].append({**frame, "file_path": f"{number:04d}.jpg"})
    (folder / "transforms.json").write_text(json.dumps(described), encoding="utf-8")
    return folder


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="RLIMIT_DATA holds for what is mapped on Linux alone")
@pytest.mark.timeout(1200)
def test_they_are_trained_on_and_baked_under_a_limit_of_the_system(photographs: Path, tmp_path: Path) -> None:
    sets = [f"poses.max_image_size={WIDTH}", "train.iterations=20", "train.preview_every=off", "bake.refine_steps=2"]
    command = [sys.executable, "-c", RUN, str(LIMIT), "run", str(photographs), "--out", str(tmp_path / "run"), "--preset", "tiny", "--until", "bake", "--json"]
    done = subprocess.run([*command, *(word for text in sets for word in ("--set", text))], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr + done.stdout[-2000:]
    warnings = [event["text"] for event in map(json.loads, done.stdout.splitlines()) if event["event"] == "warning"]
    assert sum("are kept in a file" in text for text in warnings) == 2  # by train and by bake
    for stage in ("poses", "train", "bake"):
        made = json.loads((tmp_path / "run" / stage / "manifest.json").read_text(encoding="utf-8"))
        stated = made["facts"]["memory"]
        assert made["peak_memory"] <= stated["needed"] <= stated["limit"] < LIMIT
