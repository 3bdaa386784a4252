"""What is measured: folders, the command, and the version of the code."""

import hashlib
import json
import sys
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
DATA = ROOT.parent / "shared" / "data"
PACKAGES = ("pipeline", "efficientnerf", "stages", "workflows")
ENERF = (sys.executable, "-m", "workflows.cli.main")


def last_object(output: str) -> dict[str, Any]:
    """The last of the objects that `enerf --json` prints, a line each; empty where there is none."""
    lines = [line for line in output.splitlines() if line.startswith("{")]
    return dict(json.loads(lines[-1])) if lines else {}


def code_version() -> str:
    """Twelve digits of the SHA-256 of all Python sources and presets of the four packages."""
    digest = hashlib.sha256()
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*")):
            if path.suffix in (".py", ".toml") and "__pycache__" not in path.parts:
                digest.update(path.relative_to(ROOT).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:12]
