"""What `import efficientnerf` promises: names, types, an import that costs nothing, and names of earlier releases for a while."""

import ast
import importlib
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import efficientnerf as en
from efficientnerf.asset.format import save
from examples.asset import write_views
from tests.efficientnerf.trees import uniform_tree

ROOT = Path(__file__).resolve().parents[2]
PROMISED = {"load", "render", "turntable_cameras", "Camera", "NerfTree", "Rendering", "FormatError", "__version__"}


def test_all_names_are_there_and_promised() -> None:
    assert set(en.__all__) >= PROMISED
    assert all(getattr(en, name) is not None for name in en.__all__)
    assert set(en.__all__) <= set(dir(en))
    with pytest.raises(AttributeError, match="no attribute 'lode'"):
        en.lode  # type: ignore[attr-defined]  # noqa: B018


def test_type_checkers_see_the_same_names() -> None:
    """From the same modules."""
    stub = ast.parse((ROOT / "efficientnerf/__init__.pyi").read_text(encoding="utf-8"))
    imported = {name.asname: node.module for node in stub.body if isinstance(node, ast.ImportFrom) for name in node.names}
    places = {name: f"efficientnerf.{place}" for name, place in vars(en)["_PUBLIC"].items()}
    (stated,) = (ast.literal_eval(node.value) for node in stub.body if isinstance(node, ast.Assign))
    assert imported == places
    assert stated == en.__all__


def test_documents_name_what_is_promised() -> None:
    page = (ROOT / "docs/api.md").read_text(encoding="utf-8")
    assert set(re.findall(r"`en\.(\w+)", page)) == set(en.__all__)


def test_the_import_alone_is_light() -> None:
    program = "import sys, efficientnerf; print([name for name in ('numpy', 'torch', 'numba', 'scipy') if name in sys.modules])"
    assert subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True).stdout.strip() == "[]"


def test_the_example_renders_an_asset(tmp_path: Path) -> None:
    save(uniform_tree(sigma=60.0), tmp_path / "cube.nerftree")
    pictures = [np.asarray(Image.open(path)) for path in write_views(tmp_path / "cube.nerftree", tmp_path / "views", count=2, size=(40, 30))]
    assert [picture.shape for picture in pictures] == [(30, 40, 4)] * 2
    assert all(picture[15, 20, 3] > 200 and picture[0, 0, 3] == 0 for picture in pictures)


def test_a_name_of_0_1_warns_and_is_the_same() -> None:
    former = importlib.import_module("stages.framing.camera_paths")
    with pytest.warns(DeprecationWarning, match=r"efficientnerf\.turntable_cameras"):
        assert former.turntable_cameras is en.turntable_cameras
