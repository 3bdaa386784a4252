"""Structure from motion with COLMAP, step by step: photographs -> features -> pairs -> verified matches -> cameras -> adjusted cameras.

On the CPU, bit-exact from run to run. The capture's frame is COLMAP's: its scale and axes are arbitrary. `stages.sfm.cameras` runs it in a process of its
own; docs/experiments/sfm.md says why the steps are these.
"""

from __future__ import annotations

import errno
import os
import shutil
import sqlite3
from dataclasses import dataclass, field
from pathlib import Path
from typing import Unpack

from msgspec import UNSET, UnsetType, structs

from pipeline.errors import BadInput
from pipeline.files import remove
from stages.cores import count_cores
from stages.formats.importers.source import abbreviated
from stages.io.capture import Capture, Markers
from stages.sfm import attempts, mapping, matches, result
from stages.sfm.added.markers import keep_markers
from stages.sfm.attempts import BEGIN_ANEW, MERGED, NETWORK, NETWORK_ANEW, OWN_FOCAL_LENGTHS, OWN_PRINCIPAL_POINTS, SMALL_ANGLES, Attempt, Search, anew
from stages.sfm.database import open_database
from stages.sfm.images import Callables, prepare_images
from stages.sfm.intrinsics.own import with_own_intrinsics
from stages.sfm.mapping import DEFAULTS, FORWARD, RELAXED
from stages.sfm.pairs import features_for, matching_for

# What is tried after the mapper's first run, in order, where its condition holds; a result is kept where it is better than those before it.
#
#     sub-models are merged where the points that they share fit; the mapper goes on with fewer matches to a photograph, or begins anew from another pair
#     photographs without a camera are matched again, with more of the others and along the first geometry; then with more features, of less contrast
#     they are matched by networks, where the user has given them
#     each photograph gets a focal length or a principal point of its own, where single photographs would have another, as zoomed or cropped ones have
ATTEMPTS = (
    Attempt(MERGED, attempts.unmerged, attempts.merge, least=lambda s: s.agreement - attempts.MAX_AGREEMENT_LOSS),
    Attempt("fewer matches", lambda s: s.models and s.missing, lambda s: s.go_on()),
    anew(BEGIN_ANEW, lambda s: s.most_missing, RELAXED),
    anew(SMALL_ANGLES, lambda s: s.was_last(BEGIN_ANEW) and not s.enough, FORWARD),  # as of a way straight ahead
    Attempt("wider matching", lambda s: s.missing, attempts.match_more),
    Attempt(MERGED, attempts.unmerged, attempts.merge, least=lambda s: s.agreement - attempts.MAX_AGREEMENT_LOSS),
    Attempt("more features", lambda s: s.missing and not s.enough, attempts.detect_more),
    anew(BEGIN_ANEW, lambda s: not s.enough and not s.begun_anew(), RELAXED),
    anew(SMALL_ANGLES, lambda s: s.was_last(BEGIN_ANEW) and not s.enough, FORWARD),
    Attempt(NETWORK, lambda s: s.networks and s.missing, attempts.match_by_networks),
    anew(NETWORK_ANEW, lambda s: s.place.name == attempts.NETWORKS and s.most_missing, DEFAULTS),
    anew(NETWORK_ANEW, lambda s: s.was_last(NETWORK_ANEW) and not s.enough, RELAXED),
    Attempt(OWN_FOCAL_LENGTHS, attempts.zoomed, attempts.with_own_cameras, least=lambda s: 1 - attempts.MAX_STILL_DISAGREEING * (1 - s.agreement)),
    Attempt(OWN_PRINCIPAL_POINTS, attempts.cropped, attempts.with_own_principal_points, better=attempts.better_where_closer),
)


@dataclass(frozen=True)
class Request:
    folder: Path  # of the photographs, for errors
    paths: dict[str, Path]  # the file of each photograph, by name
    work: Path  # scratch folder; what a killed call left in it is used again, and the result has the same bits
    max_side: int = 1600  # longest side of the photographs in which features are detected, pixels
    features: int | None = None  # most features of a photograph; None: as `pairs.features_for` has it
    # "exhaustive", "retrieval", "sequential" (the sorted names follow a path; `stages.sfm.pairs`), or "auto": exhaustive up to 60 photographs
    matching: str = "auto"
    seed: int = 0
    threads: int | None = None  # on which features are detected, and processes in which pairs are matched; None: as many as the process may use. Changes no bit
    # of some or all names: no features where the mask is black, nor where a photograph is transparent; None: features everywhere
    masks: dict[str, Path | None] = field(default_factory=dict)
    lens: str = "auto"  # "fisheye", "perspective", or "auto": fisheye where EXIF data say so
    # files of a detector and a matcher (`stages.sfm.added.networks`), for photographs that SIFT leaves without a camera
    networks: tuple[Path, Path] | None = None
    copies: Path | None = None  # folder in which the stage keeps photographs that were decoded; None: one in the scratch folder
    markers: Markers = field(default_factory=dict)  # those in the photographs, whose corners tie them


def reconstruct(r: Request, **callables: Unpack[Callables]) -> Capture:
    """The capture of photographs. Raises BadInput where fewer than 3, or less than half of them, get a camera."""
    progress, safe_point, threads = callables["progress"], callables["safe_point"], r.threads or count_cores()
    features = r.features or features_for(len(r.paths))

    images, unreadable = prepare_images(
        r.paths, max_side=r.max_side, features=features, seed=r.seed, masks=r.masks, lens=r.lens, threads=threads, work=r.work, copies=r.copies,
        **callables,
    )  # fmt: skip
    if len(images) < mapping.MIN_MODEL_SIZE:
        found = f"{r.folder}: {len(images)} readable photographs; at least {mapping.MIN_MODEL_SIZE} are needed, and 20 or more all round a subject are better."
        names = abbreviated([name for name, _ in unreadable], result.MAX_NAMES)
        raise BadInput(found + (f" Unreadable: {names}." if unreadable else ""))
    keep_markers(r.work, images, r.markers)

    # Features, matches of pairs, and COLMAP's mapper, with further attempts where photographs have no camera.
    search = Search(r.work, images, r.seed, features, threads, progress, safe_point, r.networks)
    matching = matching_for(len(images)) if r.matching == "auto" else r.matching
    try:
        open_database(r.work, images, callables["warn"])
        matches.extract_features(r.work, images, features=features, threads=threads, progress=progress, safe_point=safe_point)
        find_models(search, matching)
    except (RuntimeError, sqlite3.OperationalError) as error:  # COLMAP reports a full disk as one of many RuntimeErrors
        if shutil.disk_usage(r.work).free < 1 << 20:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(r.work)) from error
        raise
    rejected = [*unreadable, *result.unregistered(search)]
    if mapping.num_registered(search.models) < max(mapping.MIN_MODEL_SIZE, len(images) / 2):
        raise result.not_found(r.folder, r.paths, search, rejected, matching)

    # Bundle adjustment with a robust loss; then intrinsics for each photograph, where they explain what they were not fitted to.
    model = search.models[0]
    own: str | UnsetType | None = UNSET
    if search.best != OWN_PRINCIPAL_POINTS:
        model = mapping.bundle_adjusted(search.work, images, model, safe_point)
    if search.best not in (OWN_FOCAL_LENGTHS, OWN_PRINCIPAL_POINTS):
        model, own = with_own_intrinsics(images, model, safe_point)

    moving = mapping.moving_shares(search.work, images, model, safe_point)
    provenance = structs.replace(result.provenance_of(search, matching), own_intrinsics=own, moving_parts=moving)
    capture = result.capture_of(search, model, r.paths, r.masks, rejected, provenance)
    for sentence in capture.warnings:
        callables["warn"](sentence)
    return capture


def find_models(search: Search, matching: str) -> Search:
    """Match the photographs, run the mapper, and make the attempts whose condition holds; the best sub-models are in the search."""
    for name in (attempts.MATCHED_AGAIN, attempts.NETWORKS, attempts.OWN_CAMERAS):
        remove(search.base / name)
    matches.match_photographs(search.base, search.images, matching, seed=search.seed, workers=search.threads, **search.quiet)
    search.keep(matching, search.begin(DEFAULTS))
    search.others = search.models[1:]
    for attempt in ATTEMPTS:
        if attempt.when(search) and (models := attempt.run(search)) is not None:
            search.keep(attempt.name, models, least=attempt.least(search), better=attempt.better(search, models))
    return search
