"""The metadata that the bake stage writes into an asset: frame, orbit, licence and provenance; see FORMAT.md."""

from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from typing import Any

from efficientnerf.asset.captured import captured_metadata
from efficientnerf.model import Model
from pipeline.hashes import sha256_of
from pipeline.stage import Job
from stages.artifacts import PosesOutputs, TrainOutputs
from stages.bake.settings import BakeSettings
from stages.io.scene import Scene, similarity_to_json


def sources_of(job: Job) -> dict[str, str]:
    """SHA-256 of the files that the asset was made from: cameras and field."""
    files = PosesOutputs(job.inputs["poses"]).scene, TrainOutputs(job.inputs["train"]).field
    return {path.name: sha256_of(path) for path in files}


def metadata_of(s: Scene, settings: BakeSettings, m: Model) -> dict[str, Any]:
    """What an asset needs to be used without its run."""
    try:
        tool = version("efficientnerf")
    except PackageNotFoundError:
        tool = "unknown"
    spiral: dict[str, Any] = {}
    if (forward := s.forward) is not None:
        radii, tangents = ([float(x) for x in values] for values in (forward.radii, forward.tangents))
        spiral = {"radii": radii, "focus": float(forward.focus), "tangents": tangents, "far": float(forward.far)}
    return {
        "world_from_capture": similarity_to_json(s.world_from_capture),
        "orbit": asdict(s.orbit),
        "captured_path": captured_metadata([view.camera for view in s.views]),
        "metric": bool(s.metric),
        **({"spiral": spiral} if spiral else {}),
        "licence": settings.licence,
        "provenance": {
            "tool": f"efficientnerf {tool}",
            "kind": s.kind,
            "training_views": sum(v.split == "train" for v in s.views),
            "iterations": m.settings.iterations,
        },
    }
