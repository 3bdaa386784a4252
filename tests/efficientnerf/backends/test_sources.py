"""The key of a module changes with each source that it depends on, and with no other."""

import os
import pickle
from pathlib import Path

import pytest

from efficientnerf.backends.sources import Sources
from efficientnerf.geometry.ndc import Ndc

FORMS = {
    "import efficientnerf.a.deep": {"a.deep", "a", "b", "c", "unrelated", ""},  # it binds the package, whose attributes lead anywhere
    "import efficientnerf.a.deep as deep": {"a.deep", "a", ""},
    "import efficientnerf.a as a": {"a.deep", "a", ""},
    "from efficientnerf.a import deep": {"a.deep", "a", ""},
    "from efficientnerf.a.deep import name": {"a.deep", "a", ""},
    "from efficientnerf.a.deep import *": {"a.deep", "a", ""},
    "from efficientnerf.a import *": {"a.deep", "a", ""},
    "from efficientnerf import a": {"a.deep", "a", ""},
    "from .a.deep import name": {"a.deep", "a", ""},
    "from .a import (  # that one (\n    deep,\n)": {"a.deep", "a", ""},
    "from . import b": {"b", ""},
    "def late():\n    try:\n        pass\n    except OSError:\n        from efficientnerf.b import name\n    return name": {"b", ""},
    "match 1:\n    case 1:\n        from efficientnerf import b": {"b", ""},
    "x = 1; from efficientnerf \\\n  import b": {"b", ""},
    "'''\nNo import\n'''\nfrom efficientnerf.b import name": {"b", ""},
    "from efficientnerf.c import name": {"c", "b", ""},
    "import efficientnerf.absent as absent": {""},
    "import os, numba; b = 1": {""},
}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    place = tmp_path / "efficientnerf"
    (place / "a").mkdir(parents=True)
    for name in ("__init__", "a/__init__", "a/deep", "b", "unrelated"):
        (place / f"{name}.py").write_text("name = 1")
    (place / "c.py").write_text("from efficientnerf.b import name")
    return tmp_path


@pytest.mark.parametrize("form", FORMS)
def test_a_key_stands_for_what_a_module_imports_however_it_does(root: Path, form: str) -> None:
    (root / "efficientnerf" / "own.py").write_text(f"import sys\n{form}\nthe_rest = (\n    1)\n")
    key = Sources(root).key(["efficientnerf.own"])
    found = set()
    for path in sorted((root / "efficientnerf").rglob("*.py")):
        text = path.read_text()
        path.write_text(f"{text}\n# edited")
        sources = Sources(root)
        if sources.key(["efficientnerf.own"]) != key:
            found.add((sources.module_of(path) or "").removeprefix("efficientnerf").removeprefix("."))
        path.write_text(text)
    assert found == FORMS[form] | {"own"}
    assert Sources(root).key(["efficientnerf.own"]) == key


def test_a_module_that_is_moved_or_appears_changes_the_key(root: Path) -> None:
    own = root / "efficientnerf" / "own.py"
    own.write_text("from efficientnerf import absent")
    keys = [Sources(root).key(["efficientnerf.own"])]
    (root / "efficientnerf" / "absent.py").touch()
    keys.append(Sources(root).key(["efficientnerf.own"]))
    own.rename(own.with_name("moved.py"))
    keys.append(Sources(root).key(["efficientnerf.moved"]))
    (root / "efficientnerf" / "moved").mkdir()
    (root / "efficientnerf" / "moved" / "__init__.py").touch()
    keys.append(Sources(root).key(["efficientnerf.moved"]))
    assert len(set(keys)) == 4


def test_what_was_changed_or_removed_since_is_known(root: Path) -> None:
    sources, names = Sources(root), ["efficientnerf.c"]
    began = max(path.stat().st_ctime for path in root.rglob("*.py"))
    assert not sources.changed_since(names, began)
    assert sources.changed_since(names, began - 1)
    os.utime(root / "efficientnerf" / "unrelated.py", (began + 9,) * 2)
    assert not sources.changed_since(names, began)
    os.utime(root / "efficientnerf" / "b.py", (began - 9,) * 2)
    assert sources.changed_since(names, (root / "efficientnerf" / "b.py").stat().st_ctime - 0.001), "an old file that was put there"
    (root / "efficientnerf" / "b.py").unlink()
    assert sources.changed_since(names, began + 99)


def test_modules_are_found_in_pickles() -> None:
    sources = Sources(Path(__file__).resolve().parents[3])
    assert sources.modules_named(pickle.dumps([Ndc, 1.0, "text"])) == {"efficientnerf.geometry.ndc"}
    assert sources.modules_named(b"efficientnerf.geometry.no.such") == {"efficientnerf.geometry"}
    assert sources.modules_named(pickle.dumps(Path())) == set()
