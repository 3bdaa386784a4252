"""Facts about a path for `enerf inspect`, and their text."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from pipeline.decide import survey
from pipeline.errors import BadInput
from stages.artifacts import BakeOutputs, EvaluateOutputs, PosesOutputs
from stages.formats.exporters import SPLAT_EXPORTERS
from stages.formats.exporters.splats.description import describe_splats
from stages.formats.importers.description import describe_source
from stages.io import scene
from stages.io.meshes.description import MESHES, describe_mesh
from stages.video import SUFFIXES
from workflows.asset import STAGES
from workflows.cli.output import plain
from workflows.cli.progress import size
from workflows.cli.target import ASSET, is_run, open_run
from workflows.loading import describe_asset
from workflows.report import documents
from workflows.report.summary import artifacts


def describe(path: Path) -> dict[str, Any]:
    """Facts about an asset, a run, the cameras of a run, a data set, a mesh, points or 3D Gaussians; `what` says which. Raises BadInput and CorruptArtifact."""
    if not path.exists():
        raise BadInput(f"{path}: no such file or folder.")
    if path.is_file():
        return _describe_file(path)
    if is_run(path):
        return _describe_run(path)
    if PosesOutputs(path).scene.is_file():
        return scene.describe(path)
    if (path / ASSET).is_file():
        return {"what": "asset", "path": str(path / ASSET), **describe_asset(path / ASSET)}

    return describe_source(path)


def _describe_file(path: Path) -> dict[str, Any]:
    suffix = path.suffix.lower()
    if suffix == ".nerftree":
        return {"what": "asset", "path": str(path), **describe_asset(path)}
    if suffix in SPLAT_EXPORTERS:
        splats = describe_splats(path)
        if splats is not None:
            return {"what": "splats", "path": str(path), "bytes": path.stat().st_size, **splats}
    if suffix in MESHES:
        return {"what": "mesh", "path": str(path), "bytes": path.stat().st_size, **describe_mesh(path)}
    if path.name == PosesOutputs.scene:
        return scene.describe(path.parent)
    if suffix in SUFFIXES or suffix in (".json", ".npy", ".bin", ".txt"):
        return describe_source(path if suffix in SUFFIXES else path.parent)
    known = f"an asset (.nerftree), a mesh ({', '.join(MESHES)}), 3D Gaussians ({', '.join(SPLAT_EXPORTERS)}), a run or the folder of a data set"
    raise BadInput(f"{path}: of no kind that can be described; expected {known}.")


def _describe_run(path: Path) -> dict[str, Any]:
    run = open_run(path)
    quality: dict[str, Any] = {}
    damaged = []
    try:
        measured = documents.read(EvaluateOutputs.of_run(run.path).metrics, documents.Metrics)
        quality = {} if measured is None else measured[1]
    except documents.Damaged as error:
        damaged.append(str(error))
    found: dict[str, Any] = {
        "what": "run",
        "path": str(run.path),
        "source": None if run.source is None else str(run.source),
        "preset": run.preset,
        "stages": {decision.stage: decision.state for decision in survey(STAGES, run)},
        "artifacts": artifacts(run.path),
        "quality": {name: quality[name] for name in ("network", "asset", "mesh") if name in quality},
        "damaged": damaged,
    }
    if PosesOutputs.of_run(path).scene.is_file():
        found["scene"] = scene.describe(PosesOutputs.of_run(path).folder)
    if "asset" in found["artifacts"]:
        found["asset"] = describe_asset(BakeOutputs.of_run(path).asset)
    return found


def in_words(found: dict[str, Any]) -> list[str]:
    """The facts as lines of `name  value`; lists of cameras are shown with --json only."""
    return _lines(plain(found), "")


def _lines(found: dict[str, Any], indent: str) -> list[str]:
    lines = []
    for name, value in found.items():
        label = f"{indent}{name.replace('_', ' ')}"
        if name == "cameras" and isinstance(value, list) and all(isinstance(camera, dict) for camera in value):
            first = value[0] if value else {}
            if {"name", "model", "params"} <= first.keys():
                lines.append(f"{label:<24} {len(value)}, listed with --json; the first: {first['name']}, {first['model']} {_shown(first['params'])}")
        elif name == "captured_path" and isinstance(value, dict) and isinstance(value.get("poses"), list):
            lines.append(f"{label:<24} {len(value['poses'])} cameras, listed with --json")
        elif name == "warnings" and isinstance(value, list):
            lines += [f"{label:<24} {sentence}" for sentence in value] or [f"{label:<24} nothing"]
        elif name in SCENE_PARTS and value and not isinstance(value, int):  # "environment" is the bytes of a tensor too
            lines += [f"{label:<24} {sentence}" for sentence in SCENE_PARTS[name](value)]
        elif isinstance(value, dict):
            lines += [label, *_lines(value, indent + "  ")]
        elif value not in (None, [], ""):
            lines.append(f"{label:<24} {size(value) if name == 'bytes' and isinstance(value, int) else _shown(value)}")
    return lines


def _cascades(found: list[dict[str, Any]]) -> list[str]:
    """The grids of an asset, a line for each."""
    first = f"{len(found)}, each with voxels twice as large as the one before" if len(found) > 1 else "1"
    rows = [f"voxels of {_shown(one['voxel_side'])}, {_shown(one['resolution'])} of them, {_box(one['bounds']['min'], one['bounds']['max'])}" for one in found]
    return [first, *(f"{n}: {row}" for n, row in enumerate(rows))]


def _environment(found: list[int]) -> list[str]:
    return [f"a map of {found[1]} x {found[0]} colours, beyond all voxels"]


def _region(found: dict[str, Any]) -> list[str]:
    """The foreground region."""
    about = [f"radius of its upright edges {_shown(float(found['corner_radius']))}"] if found["corner_radius"] else []
    about += [f"fading over {_shown(float(found['fade']))}"] if found["fade"] else []
    about += ["some of the bricks in it"] if found["bricks"] else []
    return [", ".join([_box(*found["bounds"]), *about])]


def _box(low: list[float], high: list[float]) -> str:
    return f"from {_shown(low)} to {_shown(high)}"


SCENE_PARTS: dict[str, Callable[[Any], list[str]]] = {"cascades": _cascades, "environment": _environment, "region": _region}


def _shown(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, list):
        return "[" + ", ".join(_shown(item) for item in value) + "]"
    if isinstance(value, dict):
        return ", ".join(f"{name} {_shown(item)}" for name, item in value.items())
    return str(value)
