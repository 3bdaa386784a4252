"""The assessment of a capture's cameras: a grade, and for each problem the photographs that show it and what to do.

    good    nothing stands against it
    usable  it will give an asset, of which parts may be worse than they need be
    poor    the asset is likely to be wrong or incomplete
    failed  no asset can be made of it
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from msgspec import to_builtins

from efficientnerf.geometry.cameras import Camera
from stages.formats.importers.source import MIN_IMAGES, abbreviated
from stages.io.capture import Capture
from stages.verdict import looks as looks_of
from stages.verdict.grades import GRADES
from stages.verdict.looks import Look
from stages.verdict.parallax import Parallax, parallax

# Of a capture's provenance, that stand among the figures.
FIGURES = (
    "matching", "components", "models", "pairs_agreeing", "planar_pairs", "attempts", "lens", "own_intrinsics", "gps", "stated_cameras", "background",
)  # fmt: skip
NEAREST = 3  # registered photographs that are listed for one that is not registered
FEW = 12  # views all round a subject
FEW_POINTS = 60  # sparse points of a photograph, below which its pose is doubtful
SHARE = 0.1  # of the photographs, from which a problem of single ones is one of the capture
LARGE_ERROR = 2.0  # px at LONGEST
MOST_PLANAR = 0.8  # share of the pairs
DOUBTFUL = 0.94  # of the matches, that agree with the cameras; docs/experiments/sfm.md
TINY = 150  # px of the longest side, below which too few features are detected
LARGE_PART = 0.05  # of the picture, from which what moves may have more matches than what stands still
ZOOM = 1.05  # between focal lengths, from which they differ
OFF_MIDDLE = 0.03  # of the longest side, from the middle to the principal point of a photograph that was cropped
WITHOUT_TEXTURE = "blurred, dark or without texture"
MOST_PIXELS = 1000  # of the largest reprojection error that is stated
LONGEST = 1600  # px that reprojection errors are stated at
MORE_PHOTOGRAPHS = "Take more photographs between those that do not fit together, with at least 60 % overlap between neighbours."


@dataclass(frozen=True)
class Problem:
    what: str  # a word for it
    grade: str  # the best that a capture with this problem can have
    sentence: str  # it, in words
    remedy: str  # what to do
    images: tuple[str, ...] = ()  # names of the photographs that show it


@dataclass(frozen=True)
class Verdict:
    grade: str  # one of GRADES
    problems: tuple[Problem, ...]  # worst first
    figures: Mapping[str, Any] = field(default_factory=dict)  # of the capture
    images: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # of each photograph

    def document(self) -> dict[str, Any]:
        """As JSON has it."""
        return {"grade": self.grade, "summary": self.summary(), **self.figures, "problems": [asdict(each) for each in self.problems], "images": self.images}

    def summary(self) -> str:
        """A sentence."""
        of, registered = self.figures.get("photographs"), self.figures.get("registered")
        if registered is None:  # before cameras are looked for
            return f"Photographs: {self.grade}; {of} of them, {len(self.problems) or 'no'} problem{'' if len(self.problems) == 1 else 's'}."
        words = [f"{registered} of {of} photographs have a camera"]
        if self.figures.get("reprojection_error") is not None:
            words.append(f"reprojection error {_pixels(self.figures['reprojection_error'], 2)}")
        if self.figures.get("triangulation_angle") is not None:
            words.append(f"parallax {self.figures['triangulation_angle']:.0f} degrees")
        if (used := self.figures.get("gps", {}).get("used", "nothing")) != "nothing":
            words.append(f"{used} by GPS")
        return f"Cameras: {self.grade}; {', '.join(words)}."


def plural(count: int, many: str, one: str) -> str:
    """The words that go with a number."""
    return one if count == 1 else many


def _pixels(error: float, digits: int) -> str:
    """A reprojection error in words: points behind a camera make it as large as can be."""
    return f"{error:.{digits}f} px" if error < MOST_PIXELS else f"more than {MOST_PIXELS:,} px"


def verdict_on(capture: Capture, looks: Mapping[str, Look], *, in_folder: int | None = None) -> Verdict:
    """The verdict on cameras that were found or read.

    looks      of the photographs, registered or not, that can be read
    in_folder  photographs in the source's folder, where the cameras were read from a model of some of them
    """
    names = [photo.camera.name for photo in capture.photos]
    total = max(len(names) + len(capture.rejected), in_folder or 0)
    provenance = to_builtins(capture.provenance)
    seen = counts = None
    if capture.points is not None and any(capture.points.tracks):
        seen = parallax(capture.points, capture.photos)
        # (C,) sparse points that each photograph sees
        counts = np.bincount([photo for track in capture.points.tracks for photo in set(track)], minlength=len(capture.photos))
    figures: dict[str, Any] = {
        "photographs": total,
        "registered": len(names),
        "reprojection_error": None if capture.reprojection_error is None else min(capture.reprojection_error, 1e9),
        "triangulation_angle": None if seen is None else round(seen.angle, 2),
        "points": 0 if capture.points is None else len(capture.points.xyz),
        "points_per_image": None if counts is None else float(np.median(counts)),
        **{key: provenance[key] for key in FIGURES if key in provenance},
        "sharpness": round(float(np.median([each.sharpness for each in looks.values()])), 3) if looks else None,
    }
    problems = [
        *_of_registration(capture, len(names), total, in_folder),
        *_of_matches(capture, flat=seen is None or seen.small),
        *_of_lens(capture),
        *_of_moving_parts(capture),
        *_of_geometry(capture, seen, counts),
        *_of_gps(capture),
        *of_looks(looks),
        *(of_sizes(looks) if capture.kind == "photographs" else ()),
    ]
    rows = _rows(capture, looks, counts)
    ordered = tuple(sorted(problems, key=lambda each: -GRADES.index(each.grade)))
    return Verdict(ordered[0].grade if ordered else "good", ordered, figures, rows)


def failed(sentence: str, remedy: str, registered: int, capture: Capture, looks: Mapping[str, Look]) -> Verdict:
    """The verdict on a capture of photographs that no cameras were found of."""
    others = [*_of_matches(capture, flat=True), *_of_parts(capture), *of_looks(looks), *of_sizes(looks)]
    problems = (Problem("failed", "failed", sentence, remedy, tuple(name for name, _ in capture.rejected)), *others)
    return Verdict("failed", problems, {"photographs": len(looks), "registered": registered, **to_builtins(capture.provenance)}, _rows(capture, looks, None))


def _of_registration(capture: Capture, registered: int, total: int, in_folder: int | None) -> list[Problem]:
    found = []
    lost = tuple(name for name, _ in capture.rejected)
    share = registered / max(1, total)
    if in_folder is not None and registered < in_folder:
        if share < 0.9:
            remedy = "--as photographs finds the cameras of all of them afresh."
            sentence = f"The model that was read has cameras of {registered} of the {in_folder} photographs in the folder."
            found.append(Problem("few of the folder", "poor" if share < 0.5 else "usable", sentence, remedy, lost))
    elif lost:
        sentence = f"{len(lost)} of {total} photographs {plural(len(lost), 'have', 'has')} no camera: {abbreviated(list(lost))}."
        grade = "poor" if share < 0.5 else "usable" if share < 0.95 else "good"
        found.append(Problem("not registered", grade, sentence, MORE_PHOTOGRAPHS, lost))
    found += _of_parts(capture)
    if registered < FEW:
        sentence = f"Only {registered} photographs have cameras."
        found.append(Problem("few", "usable", sentence, "20 or more all round a subject are better."))
    return found


def _of_matches(capture: Capture, *, flat: bool) -> list[Problem]:
    """Why photographs that were matched have no cameras, or doubtful ones. flat: no depth was found, or hardly any."""
    found = []
    bare = tuple(name for name, reason in capture.rejected if WITHOUT_TEXTURE in reason)
    if len(bare) > SHARE * (len(capture.photos) + len(capture.rejected)):
        words = plural(len(bare), "photographs show hardly a feature; they are", "photograph shows hardly a feature; it is")
        sentence = f"{len(bare)} {words} {WITHOUT_TEXTURE}: {abbreviated(list(bare))}."
        remedy = "Photograph a subject with texture in good light; put a patterned cloth or newspaper under a plain one."
        found.append(Problem("without texture", "poor", sentence, remedy, bare))
    planar, background = capture.provenance.planar_pairs, capture.provenance.background
    if flat and isinstance(planar, float) and planar > MOST_PLANAR:
        sentence = f"In {planar:.0%} of the pairs one homography explains all matches: the camera only turned on the spot, or all is one flat thing."
        found.append(Problem("one place", "poor", sentence, "Move round the subject between photographs; turning the camera alone shows no depth."))
    if background is not None:
        found.append(_of_background(background))
    return found


def _of_lens(capture: Capture) -> list[Problem]:
    """Of photographs that were found to have focal lengths or principal points of their own, unknown to EXIF data."""
    cameras = [photo.camera for photo in capture.photos]
    if capture.provenance.lens == "zoomed":
        groups = zooms({camera.name: 1000.0 * camera.intrinsics["fx"] / max(camera.width, camera.height) for camera in cameras})
        rest = tuple(sorted(name for _, names in groups[1:] for name in names))
        words = ", ".join(f"{len(names)} at {focal:.0f} px" for focal, names in groups)
        sentence = f"The zoom changed between photographs (of a longest side of 1000 px {words}); another than most {plural(len(rest), 'have', 'has')}"
        found = Problem("zoom", "good", f"{sentence} {abbreviated(list(rest))}.", "Use one lens at one zoom, and keep EXIF data.", rest)
    elif capture.provenance.lens == "cropped":
        rest = tuple(camera.name for camera in cameras if _off_middle(camera) > OFF_MIDDLE)
        sentence = f"{len(rest)} {plural(len(rest), 'photographs were', 'photograph was')} cropped: what the lens looks at is not in the middle of"
        found = Problem("cropped", "good", f"{sentence} {abbreviated(list(rest))}.", "Give the photographs as they were taken.", rest)
    else:
        return []
    return [found] if found.images else []


def _of_moving_parts(capture: Capture) -> list[Problem]:
    """Of photographs in which something moves while the rest stands still."""
    shares, agreeing = capture.provenance.moving_parts, capture.provenance.pairs_agreeing
    if not shares or capture.provenance.background is not None:
        return []
    large = float(np.median(list(shares.values()))) > LARGE_PART and agreeing is not None and agreeing < DOUBTFUL
    names, most = tuple(sorted(shares)), max(shares.values())
    of = f"{len(names)} of {len(capture.photos)} photographs"
    sentence = f"Something moves between photographs while the rest stands still, over {most:.0%} of a picture at most, in {of}: {abbreviated(list(names))}."
    if large:
        sentence += " So many matches are of it that the cameras may be wrong."
    remedy = (
        "Leave it out: masks next to the photographs (masks/, black over it), or --mask-model where the subject itself stands still."
        " Or photograph again while nothing moves."
    )
    grade = "poor" if large else "usable" if len(names) > SHARE * len(capture.photos) else "good"
    return [Problem("moving parts", grade, sentence, remedy, names)]


def _off_middle(camera: Camera) -> float:
    """How far the principal point is from the middle, over the longest side."""
    off = camera.intrinsics["cx"] - camera.width / 2, camera.intrinsics["cy"] - camera.height / 2
    return float(np.hypot(*off)) / max(camera.width, camera.height)


def zooms(focal_lengths: Mapping[str, float]) -> list[tuple[float, list[str]]]:
    """(smallest focal length, names) of each focal length, the commonest first; those that are about the same are one."""
    groups: list[tuple[float, list[str]]] = []
    for name, focal in sorted(focal_lengths.items(), key=lambda item: (item[1], item[0])):
        same = next((names for known, names in groups if focal / known < ZOOM), None)
        if same is None:
            groups.append((focal, [name]))
        else:
            same.append(name)
    return sorted(groups, key=lambda group: (-len(group[1]), group[0]))


def _of_background(background: str) -> Problem:
    """Of a subject that turned before a background that stands still, or that stands before white."""
    if background == "white":
        sentence = "The subject stands before a white backdrop without a feature: it is left out, and the subject alone is made."
        return Problem("background", "good", sentence, "To make both, give the backdrop texture, and use --mask off.")
    sentence = "The background stands still while the subject turns"
    if background == "left out":
        return Problem("background", "good", f"{sentence}: it is left out, and the subject alone is made.", "To make both, walk round the subject.")
    remedy = "Turn it by less between photographs, give it texture, or take it before a background without any."
    return Problem("background", "poor", f"{sentence}, and the subject alone shows too little to find cameras by.", remedy)


def _of_parts(capture: Capture) -> list[Problem]:
    parts, models = [count for count in capture.provenance.components or () if count >= MIN_IMAGES], capture.provenance.models or ()
    found = []
    if len(parts) > 1:
        sizes = ", ".join(map(str, parts))
        sentence = f"The photographs fall into {len(parts)} groups that do not overlap, of {sizes}; the largest is used."
        if len(capture.photos) >= sum(parts):
            sentence = f"The photographs fall into {len(parts)} groups that hardly overlap, of {sizes}; few matches tie their cameras."
        found.append(Problem("components", "usable", sentence, MORE_PHOTOGRAPHS))
    if len(models) > 1:
        sentence = f"There are {len(models)} sub-models, of {', '.join(map(str, models))} photographs; the largest is used."
        found.append(Problem("sub-models", "good", sentence, MORE_PHOTOGRAPHS))
    return found


def _of_geometry(capture: Capture, seen: Parallax | None, counts: np.ndarray | None) -> list[Problem]:
    found = []
    agreeing = capture.provenance.pairs_agreeing
    if agreeing is not None and agreeing < 0.8:
        sentence = f"Only {agreeing:.0%} of the matches agree with the cameras: repeated structure may have folded the scene."
        found.append(Problem("folded", "poor", sentence, "Look at cameras.png. Photographs with more of the surroundings tell repeated parts apart."))
    elif agreeing is not None and agreeing < DOUBTFUL:
        sentence = f"Only {agreeing:.0%} of the matches agree with the cameras, as where photographs were zoomed, cropped or blurred, or where something moved."
        found.append(Problem("disagreement", "usable", sentence, "Look at cameras.png. Use one lens at one zoom, and photographs as they were taken."))
    if seen is not None and seen.small:
        sentence = f"The photographs were taken from almost one place (parallax {seen.angle:.1f} degrees): depth will be poor."
        wrong = agreeing is not None and agreeing < DOUBTFUL  # so little parallax fits most matches, even with wrong cameras
        found.append(Problem("parallax", "poor" if wrong or seen.angle < 2.0 else "usable", sentence, "Move sideways between photographs, not only turn."))
    if capture.reprojection_error is not None and capture.photos:
        longest = float(np.median([max(photo.camera.width, photo.camera.height) for photo in capture.photos]))
        if capture.reprojection_error > LARGE_ERROR * max(1.0, longest / LONGEST):
            sentence = f"The reprojection error is large: {_pixels(capture.reprojection_error, 1)}."
            remedy = "Use one lens at one zoom, and a shutter fast enough for a moving camera; nothing in the scene should move."
            found.append(Problem("reprojection error", "usable", sentence, remedy))
    if counts is not None and len(counts):
        few = tuple(photo.camera.name for photo, count in zip(capture.photos, counts, strict=True) if count < FEW_POINTS)
        if few:
            grade = "usable" if len(few) > SHARE * len(counts) else "good"
            seeing, unsure = plural(len(few), "photographs see", "photograph sees"), plural(len(few), "their cameras are", "its camera is")
            sentence = f"{len(few)} {seeing} fewer than {FEW_POINTS} sparse points; {unsure} less sure: {abbreviated(list(few))}."
            found.append(Problem("few points", grade, sentence, "Texture helps: leave more of the surroundings in view.", few))
    return found


def _of_gps(capture: Capture) -> list[Problem]:
    """Why GPS positions are not used. This lowers no grade, and is usual indoors or round a small subject."""
    gps = capture.provenance.gps
    if gps is None or gps.used != "nothing":
        return []
    words = f"{gps.photographs} of {len(capture.photos)} photographs {plural(gps.photographs, 'have', 'has')} a GPS position"
    if gps.distance is not None and not gps.extent:
        words += ", all of them the same one, and not used."
    elif gps.distance is not None:
        words += f", {gps.distance:.2g} m from the cameras found in the median: too far for an extent of {gps.extent:.2g} m, and not used."
    else:
        words += ": too few to be used."
    return [Problem("gps", "good", words, "Nothing need be done: a phone's positions are metres off. Lengths are in no unit then, and up is estimated.")]


def of_looks(looks: Mapping[str, Look]) -> list[Problem]:
    """Problems of the pictures themselves."""

    def those(shows: Callable[[Look], bool]) -> list[str]:
        return sorted(name for name, each in looks.items() if shows(each))

    dark, noisy = those(lambda each: each.brightness < looks_of.DARK), those(lambda each: each.noise > looks_of.NOISY)
    compressed, clipped = those(lambda each: each.compressed), those(lambda each: each.clipped > looks_of.MOST_CLIPPED)
    found = []
    for what, names, words, remedy in (
        ("blurred", looks_of.blurred(looks), "blurred", "Move slower, give more light, or film at a faster shutter speed."),
        ("exposure", looks_of.of_other_exposure(looks), "brighter or darker than the others by more than 0.75 stops", "Lock exposure and white balance."),
        ("dark", dark, "so dark that little but noise is left", "Give more light, or expose longer with the camera on a stand."),
        ("noise", noisy, "so noisy that weak features are lost", "Give more light, or expose longer at a lower ISO, with a stand."),
        (
            "compression",
            compressed,
            "compressed so strongly that blocks of 8 pixels show",
            "Give the originals, not what a messenger or a web page has made of them, or save them at quality 75 or more.",
        ),
        ("clipped", clipped, "black or white in more than 40 % of the pixels", "Expose for the subject; black and white hold no detail."),
    ):
        if names:
            share = len(names) / len(looks)
            sentence = f"{len(names)} of {len(looks)} photographs ({share:.0%}) {plural(len(names), 'are', 'is')} {words}: {abbreviated(names)}."
            found.append(Problem(what, "usable" if share > SHARE else "good", sentence, remedy, tuple(names)))
    same = looks_of.duplicates(looks)
    if same:
        words = plural(len(same), "photographs look", "photograph looks")
        sentence = f"{len(same)} {words} the same as another: {abbreviated([f'{name} as {first}' for name, first in same.items()])}."
        grade = "poor" if len(looks) - len(same) < 3 else "usable" if len(same) > 0.4 * len(looks) else "good"
        found.append(Problem("duplicates", grade, sentence, "They add nothing; photographs from other places would.", tuple(same)))
    return found


def of_sizes(looks: Mapping[str, Look]) -> list[Problem]:
    """Photographs that are too small for features to be found in."""
    tiny = {name: each.longest for name, each in sorted(looks.items()) if each.longest < TINY}
    if not tiny:
        return []
    low, high = min(tiny.values()), max(tiny.values())
    side = f"{low} px" if low == high else f"{low} to {high} px"
    sentence = f"{len(tiny)} of {len(looks)} photographs {plural(len(tiny), 'are', 'is')} too small, {side} on the longest side: {abbreviated(list(tiny))}."
    share = len(tiny) / len(looks)
    return [Problem("tiny", "poor" if share > 0.5 else "usable" if share > SHARE else "good", sentence, "Give the originals, of 1000 px or more.", tuple(tiny))]


def _rows(capture: Capture, looks: Mapping[str, Look], counts: np.ndarray | None) -> dict[str, dict[str, Any]]:
    """Of each photograph what is known of it."""
    same, moving = looks_of.duplicates(looks), capture.provenance.moving_parts
    registered = {photo.camera.name for photo in capture.photos}
    rows: dict[str, dict[str, Any]] = {}
    for index, photo in enumerate(capture.photos):
        rows[photo.camera.name] = {"registered": True, "points": None if counts is None else int(counts[index])}
        if photo.camera.name in moving:
            rows[photo.camera.name]["moving"] = moving[photo.camera.name]
    for name, reason in capture.rejected:
        near = sorted(((n, b if a == name else a) for a, b, n in capture.overlaps if name in (a, b)), reverse=True)
        nearest = [{"image": other, "matches": n} for n, other in near if other in registered or not registered][:NEAREST]
        rows[name] = {"registered": False, "reason": reason, "nearest": nearest}
    for name, row in rows.items():
        if name in looks:
            each = looks[name]
            row |= each.figures()
            if name in same:
                row["same_as"] = same[name]
    return dict(sorted(rows.items()))
