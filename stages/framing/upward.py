"""Which way is up: what the source states, GPS, markers or the accelerometers of phones say, in this order, and whether they agree with each other and with the
floor or table that the sparse points show."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from efficientnerf.capture.supports import level_plane
from stages.framing.training_frame import estimated_up, up_vector
from stages.io.capture import Capture
from stages.io.photo import read_gravity
from stages.io.pictures import UnreadableImage

MIN_PHOTOGRAPHS = 6  # photographs with a gravity vector, and half of all
MAX_SPREAD = 5.0  # degrees, of the median photograph's gravity from that of all, up to which they give up
MAX_DISAGREEMENT = 5.0  # degrees between two that say which way is up, beyond which a warning names them
THE_CAMERAS, PLANE = "level cameras", "the floor or table"


def with_up(capture: Capture, choice: str, say: Callable[[str], None], warn: Callable[[str], None]) -> Capture:
    """The capture with the upward axis that is best known, where any is; all that say one in its facts, and a warning where they contradict each other.

    choice  `poses.up`, which is taken whatever they say
    """
    # The upward axes that are known, by what says them, the most trusted first.
    found: dict[str, np.ndarray] = {}
    gps, gravity = capture.provenance.gps, up_by_gravity(capture)
    if capture.up is not None:
        found["GPS" if gps is not None and "up" in gps.used else "the source"] = np.asarray(capture.up, np.float64) / np.linalg.norm(capture.up)
    if capture.markers_up is not None:
        found["markers"] = capture.markers_up
    if gravity is not None:
        found["gravity"] = gravity
    by = next(iter(found), THE_CAMERAS)
    cameras = estimated_up([photo.camera for photo in capture.photos])
    up = found.get(by, cameras)
    if choice != "auto":
        by, up = "poses.up", up_vector(capture, choice)[0]
    near = None if capture.points is None else level_plane(capture.points.xyz, np.array([photo.camera.centre for photo in capture.photos]), up)
    found |= {THE_CAMERAS: cameras} | ({} if near is None else {PLANE: near[0]})
    degrees = {name: round(float(np.degrees(np.arccos(np.clip(up @ other, -1, 1)))), 2) for name, other in found.items() if name != by}
    apart = [f"{name} ({angle:.0f} degrees)" for name, angle in degrees.items() if angle > MAX_DISAGREEMENT and name not in (THE_CAMERAS, PLANE)]
    if apart:
        warn(f"up is taken from {by}, and contradicted by {', '.join(apart)}. Set it by poses.up, or afterwards by enerf orient.")
    if degrees.get(PLANE, 0.0) > MAX_DISAGREEMENT:  # it may be a slope
        say(f"{PLANE} is {degrees[PLANE]:.0f} degrees off level by {by}. If it is level: enerf orient RUN --plane, afterwards.")
    facts = capture.facts | {"up": {"by": by, "degrees": degrees}}
    return replace(capture, facts=facts, up=capture.up if by in (THE_CAMERAS, "poses.up") else up)


def up_by_gravity(capture: Capture) -> np.ndarray | None:
    """(3,) unit, by the accelerometer's vectors in photographs' EXIF data; None where few have one, or they contradict each other."""
    ups = []
    for photo in capture.photos:
        try:
            gravity = read_gravity(photo.image)
        except UnreadableImage:  # reported where it is needed
            continue
        if gravity is not None:
            ups.append(-photo.camera.world_from_camera[:3, :3] @ gravity)
    if len(ups) < max(MIN_PHOTOGRAPHS, len(capture.photos) / 2):
        return None
    all_of, weight = np.array(ups), np.ones(len(ups))
    for _ in range(20):
        mean = weight @ all_of
        mean /= max(float(np.linalg.norm(mean)), 1e-9)
        angle = np.degrees(np.arccos(np.clip(all_of @ mean, -1, 1)))
        weight = 1 / (1 + (angle / max(2 * float(np.median(angle)), 1e-3)) ** 2)
    return mean if np.median(angle) <= MAX_SPREAD else None
