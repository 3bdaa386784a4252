"""The sources of the runs, as small as every stage can bear."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from benchmarks.project import ROOT
from benchmarks.scenes.__main__ import as_blender, write_scene
from benchmarks.scenes.catalogue import recipes

KINDS = ("blender", "photographs", "llff")

# The preset tiny, smaller still; every stage keeps its checkpoints, previews and files.
SETTINGS = (
    "poses.max_image_size=64", "poses.max_features=512", "poses.feature_image_size=320",
    "train.iterations=24", "train.checkpoint_every=8", "train.preview_every=12", "train.occupancy_warmup_steps=8", "train.max_rays_per_batch=128",
    "bake.resolution=24", "bake.visibility_rays=2000", "bake.refine_steps=4", "bake.refine_rays_per_batch=256",
    "turntable.frames=4", "mesh.max_faces=400", "points.num_points=500", "splats.make=on", "splats.count=300", "splats.iterations=3",
)  # fmt: skip
OTHER = "poses.max_image_size=40"  # with it every artifact is another


@dataclass(frozen=True)
class Source:
    """A source, and how it is run."""

    kind: str
    folder: Path
    options: tuple[str, ...]

    def arguments(self, run: Path, *more: str) -> list[str]:
        """Of `enerf`."""
        return ["run", str(self.folder), "--out", str(run), "--json", *self.options, *more]


def options(settings: Sequence[str] = SETTINGS) -> tuple[str, ...]:
    return ("--preset", "tiny", "--device", "cpu", *(word for setting in settings for word in ("--set", setting)))


def make(kind: str, folder: Path, photographs: int = 6) -> Source:
    """Write the source of a kind below a folder."""
    place = folder / kind
    if kind == "photographs":
        place.mkdir(parents=True)
        for path in sorted((ROOT / "examples" / "still_life").glob("*.jpg"))[:photographs]:
            shutil.copyfile(path, place / path.name)
        return Source(kind, place, (*options(), "--jobs", "2"))  # stages side by side, which so small a run would not have
    if kind == "llff":
        write_scene(recipes()["window"], place, {"train": 6, "val": 0, "test": 2}, 48, 1)
        (place / "transforms.json").unlink()
        return Source(kind, place, ("--as", "llff", *options()))
    if kind == "blender":
        made = folder / "object"
        write_scene(recipes()["object"], made, {"train": 6, "val": 0, "test": 2}, 48, 1)
        return Source(kind, as_blender(made, place), ("--as", "blender", *options()))
    raise ValueError(f"kind {kind!r}: expected one of {', '.join(KINDS)}")
