"""How far an asset was refined, of what is usual: a figure that is poor for want of steps asks for no other remedy."""

from __future__ import annotations

import json

from pipeline.files import read_json
from stages.artifacts import BakeOutputs
from stages.bake.refine.refinement import usual_steps
from stages.bake.settings import BakeSettings


def refinement_of(bake: BakeOutputs) -> dict[str, int]:
    """Steps that were taken, and the least that are usual for so many voxels and rays a step."""
    report = read_json(bake.report)
    last = json.loads(bake.log.read_text(encoding="utf-8").splitlines()[-1])
    rays = last["rays"] or BakeSettings().refine_rays_per_batch  # 0: there was no step
    return {"steps": report["optimisation"]["steps"], "usual_steps": usual_steps(report["voxels"], rays, 0 if "cascades" in report else None)}
