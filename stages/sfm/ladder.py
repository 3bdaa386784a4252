"""From features to verified matches of the pairs that are worth comparing."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from stages.sfm import matches, pairs
from stages.sfm.database import database_path, inlier_counts
from stages.sfm.images import Progress, SafePoint, WorkImage

MAX_EXHAUSTIVE = 60  # photographs; of more, not every pair is matched: that would take longer than the rest of the stage
OVERLAPPING = 30  # verified matches, from which two photographs are said to overlap
FEW_NEIGHBOURS = 3  # photographs that one overlaps with; of fewer, more are looked for
WIDER = 48  # photographs that are most like one, which it is compared with then


def matching_for(count: int) -> str:
    """What "auto" stands for."""
    return "exhaustive" if count <= MAX_EXHAUSTIVE else "retrieval"


def match(work: Path, images: Sequence[WorkImage], how: str, *, seed: int, workers: int, progress: Progress, safe_point: SafePoint) -> None:
    """Verified matches of the pairs that `how` stands for; of retrieval also of more pairs of the photographs that overlap with few others."""
    if how == "exhaustive":
        wanted = pairs.all_pairs(len(images))
    elif how == "sequential":
        wanted = pairs.sequential_pairs(len(images))
    elif how == "retrieval":
        likeness = matches.likeness(work, seed, safe_point)
        wanted = pairs.retrieved_pairs(likeness)
    else:
        raise ValueError(f"matching {how!r}: expected 'exhaustive', 'retrieval' or 'sequential'")
    matches.match_pairs(work, images, wanted, seed=seed, workers=workers, progress=progress, safe_point=safe_point)
    if how == "retrieval":
        near = neighbours(work, len(images))
        weak = [i for i, others in near.items() if len(others) < FEW_NEIGHBOURS] + [i for part in components(near)[1:] for i in part]
        wanted = pairs.wider_pairs(likeness, weak, near, WIDER)
        matches.match_pairs(work, images, wanted, name="wider_", seed=seed, workers=workers, progress=progress, safe_point=safe_point)


def neighbours(work: Path, count: int, least: int = OVERLAPPING) -> dict[int, set[int]]:
    """The positions of the photographs that each overlaps with: of `least` verified matches."""
    found: dict[int, set[int]] = {i: set() for i in range(count)}
    for (i, j), inliers in inlier_counts(database_path(work)).items():
        if inliers >= least:
            found[i - 1].add(j - 1)
            found[j - 1].add(i - 1)
    return found


def components(near: dict[int, set[int]]) -> list[list[int]]:
    """Photographs that are joined by overlaps, the largest component first."""
    left, found = set(near), []
    while left:
        part, edge = set[int](), {min(left)}
        while edge:
            part |= edge
            edge = {j for i in edge for j in near[i]} - part
        left -= part
        found.append(sorted(part))
    return sorted(found, key=lambda part: (-len(part), part))
