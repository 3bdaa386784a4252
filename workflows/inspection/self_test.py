"""`python -m workflows.inspection.self_test FOLDER`: cameras, field and asset of a small made scene, written into an empty folder."""

import sys
from pathlib import Path

from workflows.cli.main import main
from workflows.precompilation.scene import write_scene


def self_test(folder: Path) -> int:
    """The exit code of the run."""
    write_scene(folder / "source")
    return main(["run", str(folder / "source"), "--out", str(folder / "run"), "--preset", "tiny", "--set", "poses.format=colmap", "--until", "bake", "--quiet"])


if __name__ == "__main__":
    sys.exit(self_test(Path(sys.argv[1])))
