"""What libraries write beside the run: SECURITY.md lists it."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DRAW = """
import sys
from pathlib import Path
import numpy as np
import stages
try:
    import onnxruntime
except ImportError:
    pass
from stages.figures.pareto import pareto_plot
from stages.figures.plots import curve, error_map
out = Path(sys.argv[1])
error_map(np.zeros((2, 2, 3)), np.ones((2, 2, 3)))
curve(out / "curve.png", {"a": ([1, 2], [3, 4])}, x_label="x", y_label="y")
pareto_plot(out / "pareto.png", {"a": [(1.0, 2.0, "b")]}, x_label="x", y_label="y")
assert "matplotlib.font_manager" in sys.modules
"""


def drawn(home: Path, out: Path, cache: Path | None = None) -> bytes:
    home.mkdir()
    out.mkdir()
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("XDG_", "MPL", "ENERF_", "ORT_"))}
    environment |= {"HOME": str(home), "PYTHONPATH": str(ROOT)} | ({} if cache is None else {"ENERF_CACHE_DIR": str(cache)})
    subprocess.run([sys.executable, "-c", DRAW, str(out)], cwd=out, env=environment, check=True)
    return (out / "curve.png").read_bytes()


def test_libraries_write_into_our_cache_folder_alone(tmp_path: Path) -> None:
    """Lists of fonts, and identifiers of the device that would be sent to somebody."""
    drawn(tmp_path / "home", tmp_path / "out")
    made = [path.relative_to(tmp_path / "home") for path in (tmp_path / "home").rglob("*") if path.is_file()]
    assert made
    assert all("efficientnerf" in path.parts for path in made), made
    drawn(tmp_path / "another", tmp_path / "there", tmp_path / "cache")
    assert not any(path.is_file() for path in (tmp_path / "another").rglob("*"))


def test_settings_of_matplotlib_in_the_working_folder_change_no_figure(tmp_path: Path) -> None:
    plain = drawn(tmp_path / "home", tmp_path / "out")
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "matplotlibrc").write_text("axes.facecolor: red\nlines.linewidth: 9\n", encoding="utf-8")
    (tmp_path / "other").mkdir()
    script = "import os, sys; os.chdir(sys.argv.pop(1))\n" + DRAW
    environment = {**os.environ, "HOME": str(tmp_path / "other"), "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", script, str(tmp_path / "there"), str(tmp_path / "there")], env=environment, check=True)
    assert (tmp_path / "there" / "curve.png").read_bytes() == plain
