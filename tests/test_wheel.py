"""The wheel holds all that the packages need, and makes an asset where it is installed."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import zipfile
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parent.parent
PHOTOGRAPHS = 12  # of the example, to be quick
PACKAGES = ("pipeline", "efficientnerf", "stages", "workflows")


def call(*command: object, **options: Any) -> str:
    done = subprocess.run([str(part) for part in command], capture_output=True, text=True, check=False, **options)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from a copy, which has none of what earlier builds left behind."""
    copy, out = tmp_path_factory.mktemp("source"), tmp_path_factory.mktemp("wheel")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copyfile(ROOT / name, copy / name)
    for package in PACKAGES:
        shutil.copytree(ROOT / package, copy / package, ignore=shutil.ignore_patterns("__pycache__"))
    call(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "--wheel-dir", out, copy)
    (built,) = out.glob("*.whl")
    return built


@pytest.mark.slow
def test_the_wheel_holds_each_file_of_the_packages_and_no_other(wheel: Path) -> None:
    kept = {path for package in PACKAGES for path in (ROOT / package).rglob("*") if path.is_file() and "__pycache__" not in path.parts}
    held = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert held == {path.relative_to(ROOT).as_posix() for path in kept}


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_notebook_runs_where_the_wheel_is_installed(wheel: Path, tmp_path: Path) -> None:
    """Its cells one after another, as a program, in an environment of its own that borrows the libraries of this one."""
    place = tmp_path / "environment"
    call(sys.executable, "-m", "venv", "--without-pip", place)
    python = place / "bin" / "python"
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    call(sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", "--no-index", wheel, env=environment)
    (packages,) = (place / "lib").glob("python*/site-packages")
    (packages / "borrowed.pth").write_text(sysconfig.get_path("purelib") + "\n")
    where = call(python, "-c", "import workflows, efficientnerf; print(workflows.__file__, efficientnerf.__file__)", cwd=tmp_path, env=environment)
    assert all(name.startswith(str(packages)) for name in where.split())
    cells = json.loads((ROOT / "examples/still_life.ipynb").read_text(encoding="utf-8"))["cells"]
    program = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "code")
    (tmp_path / "still_life").mkdir()
    for photograph in sorted((ROOT / "examples/still_life").glob("*.jpg"))[:PHOTOGRAPHS]:
        shutil.copyfile(photograph, tmp_path / "still_life" / photograph.name)
    ending = '\nassert metrics["asset"]["psnr"] > 10 and picture.shape == (240, 1280, 3) and hit.any()'
    call(python, "-c", program + ending, cwd=tmp_path, env=environment)
    for name in ("bake/asset.nerftree", "mesh/mesh.glb", "points/points.ply", "turntable/turntable.mp4", "evaluate/verdict.json", "report.html"):
        assert (tmp_path / "runs/notebook" / name).stat().st_size > 0
    version = call(place / "bin" / "enerf", "--version", cwd=tmp_path, env=environment)
    assert version.split()[-1] in wheel.name
