"""Whether photographs show a subject before a white backdrop that nothing can be learned of: then it is left out.

Where a subject was turned or laid anew between photographs before white, no scene holds its backdrop: training fills it with fog, before the subject, too.
Witnesses are what is white along the border of nine photographs in ten, the visual hull that the rest of them agrees on, and the sparse points: where more
than a few of them lie in the white, there is something, and nothing is masked. What stands next to the subject and moved against it, as a ruler or the rim
of a turntable, is not in that hull, and left out too. docs/experiments/silhouettes.md
"""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from msgspec import structs

from efficientnerf.capture.keying import key_of, keyed
from pipeline.errors import BadInput
from pipeline.stage import Job
from stages.framing.mask_use import MIN_AGREEING, alike, hull_of, points_of_object, projection, share_that_fits
from stages.framing.near_planes import reliable_points
from stages.framing.scene_bounds import chosen_photos
from stages.framing.view_coverage import MAX_CONTRADICTED
from stages.io.capture import Capture, Silhouettes
from stages.io.pictures import UnreadableImage
from stages.io.png import read_png, write_png
from stages.io.reader import SMALL, PhotoReader
from stages.masking.made import made_masks, with_masks

WHITE = "white"
MARGIN = 3  # px at `SMALL`, that a silhouette may reach beyond the hull, whose voxels are as wide
LEAST_POINTS = 300  # reliable sparse points, without which nothing refutes


def without_white_backdrop(job: Job, capture: Capture, paths: Mapping[str, Path], reader: PhotoReader, warn: Any) -> Capture:
    """The capture with silhouettes of its subject as masks, where it stands before such a backdrop; else as it is."""
    points = capture.points
    reliable = np.zeros(0, int) if points is None else np.flatnonzero(reliable_points(points, len(capture.photos)))
    if points is None or len(reliable) < LEAST_POINTS or not _white_at_borders(job, capture, reader):
        return capture
    names = [photo.camera.name for photo in capture.photos]
    try:
        masks = made_masks({name: paths[name] for name in names}, WHITE, job.work / "masks", safe_point=job.safe_point, progress=job.progress, warn=warn)
    except BadInput:
        return capture
    kind = Silhouettes(masks=True)
    masked = replace(with_masks(capture, masks), silhouettes=kind, points=points.only(reliable))
    if 1 - points_of_object(masked, reader).mean() > MAX_CONTRADICTED or share_that_fits(masked, kind, reader) < MIN_AGREEING:
        return capture
    # What lies more than MARGIN from the projection of the visual hull is left out of the mask files.
    chosen = [(photo, mask >= 128) for photo in chosen_photos(masked.photos) if (mask := reader.mask(photo)) is not None]
    hull = hull_of(masked, chosen)
    assert hull is not None  # silhouettes fit to it
    for photo in masked.photos:
        job.safe_point()
        small = reader.mask(photo)
        if photo.mask is None or small is None:
            continue
        near = cv2.dilate(projection(*hull, photo.camera, small.shape).astype(np.float32), np.ones((2 * MARGIN + 1,) * 2, np.uint8))
        mask = read_png(photo.mask)
        write_png(np.where(cv2.resize(near, mask.shape[::-1], interpolation=cv2.INTER_LINEAR) >= 0.5, mask, np.uint8(0)), photo.mask, durable=False)
    in_white = 1 - float(points_of_object(masked, reader).mean())
    if in_white > MAX_CONTRADICTED:
        return capture
    job.say("the subject stands before a white backdrop without a feature, which is left out; --mask off uses the full images", points_in_backdrop=in_white)
    return replace(capture, photos=masked.photos, provenance=structs.replace(capture.provenance, background="white"))


def _white_at_borders(job: Job, capture: Capture, reader: PhotoReader) -> bool:
    """Whether nearly all photographs keep one compact thing where the white that touches their border is left out; by small copies."""
    pictures = []
    for photo in chosen_photos(capture.photos):
        job.safe_point()
        if reader.alpha(photo) is not None:
            return False  # cut out already
        try:
            pictures.append((photo, keyed(reader.photo(photo.image, SMALL).rgb(), key_of(WHITE))))
        except UnreadableImage:
            pictures.append((photo, None))
    return not alike(pictures)[0]
