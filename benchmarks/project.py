"""What is measured: folders, the command, and the version of the code."""

import hashlib
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results"
DATA = ROOT.parent / "shared" / "data"
PACKAGES = ("pipeline", "efficientnerf", "stages", "workflows")
ENERF = (sys.executable, "-m", "workflows.cli.main")


def code_version() -> str:
    """Twelve digits of the SHA-256 of all Python sources and presets of the four packages."""
    digest = hashlib.sha256()
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*")):
            if path.suffix in (".py", ".toml") and "__pycache__" not in path.parts:
                digest.update(path.relative_to(ROOT).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:12]
