"""The assessment of a result: a grade, and for each problem its likely cause, what to do, and the picture that shows it.

    good    nothing stands against it
    usable  it shows the scene; parts are worse than they need be, or nobody can say
    poor    its pictures show less than strongly blurred photographs, or the asset is not where the scene is
    failed  its pictures show hardly more than one colour would

The figures are those of metrics.json (`stages.evaluate.summary`) and the verdict on the cameras; nothing else is looked at, so that worse figures never
give a better grade. Each threshold and its reason: docs/experiments/verdict.md.
"""

import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from efficientnerf.surface.roughness import BENT
from stages.artifacts import EvaluateOutputs, MeshOutputs, PosesOutputs, SplatsOutputs
from stages.evaluate.trivial import BLURS, equivalent_blur
from stages.formats.importers.source import abbreviated
from stages.reports import CameraVerdict
from stages.verdict.grades import GRADES

DETAILED = 30.0  # dB: a blurred photograph's detail has less where there is detail to be compared
USABLE_BLUR, POOR_BLUR, FAILED_BLUR = 0.0125, 0.0225, 0.04  # of the longest side: the blur that costs as much, beyond which a result is no better
FAILED_GAIN = 3.0  # dB over one colour, below which less than half of what a photograph shows is there
COLOURS_OFF = 2.0  # dB that fitted colours gain, from which exposure or white balance differ
POOR_VIEWS = 0.25  # of the views
GAP, LARGE_GAP = -0.5, -1.5  # dB of the asset behind its network: reported; parts are worse than they need be
HOLES, MANY_HOLES = 0.01, 0.1  # share of the pixels
VISIBLE = 0.03  # root mean square by which colours in holes are farther from the photographs than the network's: of less nothing is seen, as in a plain sky
FLOATERS, MANY_FLOATERS = 0.02, 0.15  # share of the asset's opacity, more than the network's own
SHORT = 0.5  # of the steps that are usual: a refinement with fewer comes before other causes
AGREEING, LEAST_AGREEING = 0.6, 0.3  # share of the sparse points that the asset's depth agrees with
MISSING, MOST_MISSING = 0.3, 0.6  # share of the subject's sparse points that the asset lies behind
ROUGH = 0.2  # share of lines across plain regions of the photographs that the mesh bends, in two views or more
OVERFIT = 5.0  # dB of views that training saw over those it did not

RUN = EvaluateOutputs.stage
SHEET = f"{RUN}/{EvaluateOutputs.contact_sheet}"
DEPTH = f"{RUN}/{EvaluateOutputs.sparse_points}"


@dataclass(frozen=True)
class ResultProblem:
    what: str  # a word for it
    grade: str  # the best that a result with it can have
    sentence: str  # it, in words
    cause: str  # what it is likely to come from
    remedy: str  # what to do
    picture: str  # that shows it: its path in the run
    images: tuple[str, ...] = ()  # names of the views that show it

    def text(self) -> str:
        """All of it in a line."""
        return f"{self.sentence} {self.cause} {self.remedy} ({self.picture})"


@dataclass(frozen=True)
class ResultVerdict:
    grade: str  # one of GRADES
    problems: tuple[ResultProblem, ...]  # worst first
    figures: Mapping[str, Any] = field(default_factory=dict)  # that it was made from

    def document(self) -> dict[str, Any]:
        """As JSON has it."""
        return {"grade": self.grade, "summary": self.summary(), **self.figures, "problems": [asdict(each) for each in self.problems]}

    def summary(self) -> str:
        """A sentence: the grade, and why."""
        worst = next((each for each in self.problems if each.grade == self.grade != "good"), None)
        if worst is not None:
            return f"Result: {self.grade}. {worst.sentence}"
        psnr, blur = self.figures["psnr"], self.figures["blur"]
        if psnr is None or blur is None:
            return f"Result: {self.grade}."
        return f"Result: {self.grade}; {psnr:.2f} dB on {self.figures['views']}, {blur_in_words(blur)}."


def blur_in_words(blur: float) -> str:
    """A blur, in words."""
    at_most = "at most " if blur <= BLURS[0] else ""
    return f"as near to the photographs as these are after a blur of {at_most}{100 * blur:.2f} % of their longest side"


def verdict_on_result(metrics: Mapping[str, Any], cameras: CameraVerdict | None = None) -> ResultVerdict:
    """
    metrics  the document of metrics.json
    cameras  the verdict on the cameras, where there is one
    """
    figures = _figures(metrics, cameras)
    # The picture of the worst view; without strips the contact sheet.
    files = {each["which"]: each["file"] for each in metrics["strips"]}
    name = files.get("worst") or files.get("median")
    strip = f"{RUN}/{name}" if name else SHEET
    found = [
        *_of_held_out(metrics, figures, cameras, strip),
        *_of_single_views(metrics, figures, strip),
        *_of_asset(metrics, strip),
        *_of_sparse_points(metrics),
        *_of_mesh(metrics, figures),
        *_of_splats(metrics, figures),
        *_of_cameras(cameras),
    ]
    # Where more than half of the asset's squared error is in its holes, these come before its pictures.
    errors = [10 ** (-view["asset"]["psnr"] / 10) for view in metrics["views"] if view["asset"]["psnr"] is not None]
    excess = metrics["holes_excess_error"]
    first = "holes" if errors and excess is not None and excess > 0.5 * statistics.fmean(errors) else None
    ordered = tuple(sorted(found, key=lambda each: (-GRADES.index(each.grade), each.what != first)))
    return ResultVerdict(ordered[0].grade if ordered else "good", ordered, figures)


def _figures(metrics: Mapping[str, Any], cameras: CameraVerdict | None) -> dict[str, Any]:
    """The figures that grades follow from. PSNR has fitted colours: the unknown exposure of a held-out photograph is no fault of the asset's.

    blur ..._blur  `equivalent_blur`: medians over the views; of mesh and Gaussians with as many decibels more as fitting its colours gives the asset
    detail_blur    that of what differs from shading; None where most photographs have none
    gain           PSNR with fitted colours over that of pictures of one colour, means over the views
    """
    views = _measured(metrics)
    train, split = metrics.get("train"), metrics["split"]
    fitted = [view["asset"]["psnr_colour_fitted"] for view in views]
    flat = [view["trivial"]["mean_colour"] for view in views]
    drawn = [view for view in views if view["network"] is not None and view["network"]["psnr_colour_fitted"] is not None]
    return {
        "views": f"{len(views)} {'view' if len(views) == 1 else 'views'} that training {'saw' if split == 'train' else 'did not see'}",
        "psnr": metrics["asset"]["psnr"],
        "ssim": metrics["asset"]["ssim"],
        "psnr_colour_fitted": statistics.fmean(fitted) if views else None,
        "mean_colour": statistics.fmean(flat) if views else None,
        "gain": statistics.fmean(fitted) - statistics.fmean(flat) if views else None,
        "blur": _median(view_blur(view) for view in views),
        "detail_blur": _detail_blur(views),
        "network_blur": _median(equivalent_blur(view["network"]["psnr_colour_fitted"], view["trivial"]["blurred"]) for view in drawn),
        "mesh_blur": _median(_other_blur(view, "mesh") for view in views),
        "splats_blur": None if metrics["splats"] is None else _median(_other_blur(view, "splats") for view in views),
        "train_psnr": None if train is None else train["psnr"],
        "train_blur": None if train is None else train["blur"],
        "cameras": None if cameras is None else cameras.grade,
    }


def _measured(metrics: Mapping[str, Any]) -> list[Any]:
    """The views whose masks leave pixels to compare."""
    return [view for view in metrics["views"] if view["trivial"] is not None and view["asset"]["psnr_colour_fitted"] is not None]


def view_blur(view: Mapping[str, Any]) -> float:
    """`equivalent_blur` of the asset in a view, as metrics.json has it."""
    return equivalent_blur(view["asset"]["psnr_colour_fitted"], view["trivial"]["blurred"])


def _detail_blur(views: Sequence[Mapping[str, Any]]) -> float | None:
    detailed = [view for view in views if view["trivial"]["blurred_detail"][-1] < DETAILED]
    blurs = (equivalent_blur(view["asset"]["psnr_detail"], view["trivial"]["blurred_detail"]) for view in detailed)
    return _median(blurs) if 2 * len(detailed) > len(views) else None


def _other_blur(view: Mapping[str, Any], what: str) -> float:
    credit = view["asset"]["psnr_colour_fitted"] - view["asset"]["psnr"]
    return equivalent_blur(view[what]["psnr"] + credit, view["trivial"]["blurred"])


def _median(values: Iterable[float]) -> float | None:
    known = list(values)
    return statistics.median(known) if known else None


def grade_of(blur: float, gain: float) -> str:
    """Of the pictures of a result.

    blur  `equivalent_blur`
    gain  decibels over pictures of one colour
    """
    if gain < FAILED_GAIN and blur > FAILED_BLUR:
        return "failed"
    return "poor" if blur > POOR_BLUR else "usable" if blur > USABLE_BLUR else "good"


def _of_held_out(metrics: Mapping[str, Any], figures: Mapping[str, Any], cameras: CameraVerdict | None, strip: str) -> list[ResultProblem]:
    """Of the asset's pictures against photographs that training did not see."""
    blur, gain = figures["blur"], figures["gain"]
    if blur is None:
        sentence = "No view was measured: its masks leave no pixel."
        return [ResultProblem("not measured", "usable", sentence, "The masks cover what the photographs show.", "Look at the masks (poses.masks).", SHEET)]
    found = []
    grade = grade_of(blur, gain)
    shaded = grade == "poor" and figures["detail_blur"] is not None and figures["detail_blur"] <= USABLE_BLUR
    grade = "usable" if shaded else grade
    if metrics["split"] == "train":
        sentence = "All views were trained on: how others would look was not measured."
        found.append(ResultProblem("nothing held out", "usable", sentence, "No photograph was held out.", "Hold some out (poses.test_every).", strip))
    if grade != "good":
        if grade == "failed":
            sentence = f"The asset shows hardly more than one colour: {figures['psnr']:.1f} dB on {figures['views']}, a picture of the mean colour has"
            sentence += f" {figures['mean_colour']:.1f} dB."
        else:
            sentence = f"The asset's renders differ {'strongly ' if grade == 'poor' else ''}from the photographs: {figures['psnr']:.1f} dB on"
            sentence += f" {figures['views']}, as much as a blur of {100 * blur:.2f} % of their longest side would; captures that went well have"
            sentence += f" {100 * USABLE_BLUR:.2f} % at most."
        cause = _cause(metrics, figures, cameras, strip)
        if shaded:
            sentence += f" Their detail is right: it differs as much as after a blur of {100 * figures['detail_blur']:.2f} %."
            remedy = "Lock the exposure, light the scene evenly, and keep your shadow off it."
            cause = "The shading of plain surfaces differs from photograph to photograph.", remedy, strip
        found.append(ResultProblem("pictures", grade, sentence, *cause))
    off = figures["psnr_colour_fitted"] - figures["psnr"]
    if grade in ("good", "usable") and off > COLOURS_OFF:
        sentence = f"The colours of views are off by as much as costs {off:.1f} dB; what they show is right."
        remedy = "Lock exposure and white balance, or learn them (train.exposure)."
        flat = figures["psnr"] < figures["mean_colour"] + 1.0
        found.append(ResultProblem("colours", "usable" if flat else "good", sentence, "Exposure or white balance differ between photographs.", remedy, strip))
    return found


def _cause(metrics: Mapping[str, Any], figures: Mapping[str, Any], cameras: CameraVerdict | None, strip: str) -> tuple[str, str, str]:
    """The likeliest cause of pictures that are not good, what to do, and the picture to look at: what is known to come first."""
    gap, points, short = metrics["gap"]["psnr"], metrics["sparse_points"], _short(metrics)
    if points is not None and (points["subject_farther"] or 0.0) > MOST_MISSING:
        return (*_missing(points["subject_farther"]), DEPTH)
    if short is not None:
        return (*short, strip)
    if gap is not None and gap < LARGE_GAP:
        return "The network had more: it was lost in baking.", "Give the asset more voxels (bake.max_mib) or more steps (bake.refine_steps).", strip
    if cameras is not None and cameras.grade in ("poor", "failed"):
        return f"The cameras are {cameras.grade}: {cameras.worst.sentence}", cameras.worst.remedy, f"{PosesOutputs.stage}/{PosesOutputs.cameras}"
    train = figures["train_psnr"]
    if train is not None and train - figures["psnr"] > OVERFIT:
        cause = f"Views that training saw are right ({train:.1f} dB), and others not: too few photographs, cameras that are off, or something that moved."
        return cause, "Take more photographs between those that are there; where the subject was turned, leave its background out (--mask).", SHEET
    if points is not None and points["farther"] > MISSING:
        return (*_missing(points["farther"]), DEPTH)
    if points is not None and points["nearer"] > MISSING:
        return f"Fog hangs before {100 * points['nearer']:.0f} % of the sparse points.", "Try a longer training.", DEPTH
    return "The network has learned too little.", "Give it more time (--budget, train.iterations) or --preset standard.", strip


def _missing(share: float) -> tuple[str, str]:
    cause = f"The asset is empty where {100 * share:.0f} % of the sparse points are: something kept density from being learned there."
    return cause, "Try train.min_views=off, and without masks (poses.masks=ignore)."


def _short(metrics: Mapping[str, Any]) -> tuple[str, str] | None:
    """Cause and remedy where the asset's refinement was short."""
    done = metrics["refinement"]
    if done is None or done["steps"] >= SHORT * done["usual_steps"]:
        return None
    steps, usual = done["steps"], done["usual_steps"]
    cause = f"The asset's refinement had {steps:,} step{'' if steps == 1 else 's'}, where {usual:,} are usual."
    return cause, "Give it more time (--budget, bake.time_budget) or steps (bake.refine_steps), fewer voxels (bake.max_mib), or a machine without other work."


def _of_single_views(metrics: Mapping[str, Any], figures: Mapping[str, Any], strip: str) -> list[ResultProblem]:
    """Of views that are much worse than the others."""
    views = _measured(metrics)
    bad = tuple(view["name"] for view in views if view_blur(view) > POOR_BLUR)
    if not bad or figures["blur"] > POOR_BLUR:
        return []
    sentence = f"{len(bad)} of {len(views)} views {'is' if len(bad) == 1 else 'are'} much worse than the others: {abbreviated(bad)}."
    cause = "Their cameras are off, they show what few others show, or something moved."
    remedy = "Look at these photographs; take more from about there."
    return [ResultProblem("single views", "usable" if len(bad) > POOR_VIEWS * len(views) else "good", sentence, cause, remedy, strip, bad)]


def _of_asset(metrics: Mapping[str, Any], strip: str) -> list[ResultProblem]:
    """Of the asset against its network; holes and floaters only where the photographs side with the network, of holes visibly."""
    found = []

    def add(what: str, grade: str, sentence: str, cause: str, remedy: str) -> None:
        found.append(ResultProblem(what, grade, sentence, *(_short(metrics) or (cause, remedy)), strip))

    gap, holes, excess = metrics["gap"]["psnr"], metrics["holes"], metrics["holes_excess_error"]
    if gap is not None and gap < GAP:
        sentence = f"The asset is {-gap:.2f} dB behind its network on the same pixels: it has lost detail that the network had."
        remedy = "Give it more voxels (bake.max_mib), or more steps to fit them (bake.refine_steps)."
        add("gap", "usable" if gap < LARGE_GAP else "good", sentence, "It has too few voxels, or too few steps fitted them.", remedy)
    if holes is not None and holes > HOLES and (excess is None or excess >= VISIBLE**2 * holes):
        sentence = f"The asset has holes: {100 * holes:.1f} % of the pixels show through where the network shows something solid."
        remedy = "Keep more voxels (a lower bake.weight_threshold, more bake.visibility_rays), or allow a larger asset (bake.max_mib)."
        add("holes", "poor" if holes > MANY_HOLES else "usable", sentence, "Voxels that few rays see were left out.", remedy)
    floaters, own, excess = metrics["floaters"], metrics["network"]["floaters"] or 0.0, metrics["floaters_excess_error"]
    if floaters is not None and floaters - own > FLOATERS and (excess is None or excess > 0):
        shown = f"{100 * floaters:.1f} % of what it shows hangs before the network's surfaces (in the network itself {100 * own:.1f} %)."
        remedy = "Drop faint voxels (a higher bake.weight_threshold) or small pieces (a higher bake.min_component)."
        grade = "poor" if floaters - own > MANY_FLOATERS else "usable"
        add("floaters", grade, f"The asset has floaters: {shown}", "Faint voxels before the surfaces were kept.", remedy)
    return found


def _of_sparse_points(metrics: Mapping[str, Any]) -> list[ResultProblem]:
    """Of the asset's depth where structure from motion found points."""
    points = metrics["sparse_points"]
    if points is None:
        return []
    found = []
    missing = points["subject_farther"]
    if missing is not None and missing > MISSING:
        sentence = f"Parts of the subject are missing: the asset lies behind {100 * missing:.0f} % of the sparse points of it, or is empty there."
        cause = "Something kept density from being learned there, or it was dropped in baking."
        remedy = "Try train.min_views=off and without masks (poses.masks=ignore); a lower bake.weight_threshold."
        found.append(ResultProblem("missing", "poor" if missing > MOST_MISSING else "usable", sentence, cause, remedy, DEPTH))
    grade = "poor" if points["agreeing"] < LEAST_AGREEING else "usable"
    if points["agreeing"] < AGREEING and not any(each.grade in ("poor", grade) for each in found):  # else it comes from what is missing
        agreeing, nearer, farther = (f"{100 * points[name]:.0f} %" for name in ("agreeing", "nearer", "farther"))
        sentence = f"The asset's depth agrees with {agreeing} of the sparse points: it is nearer than {nearer} of them, farther than {farther}."
        cause = "Colours stand at a wrong depth: too few directions show the scene, or the cameras are off."
        remedy = "Move sideways between photographs."
        found.append(ResultProblem("depth", grade, sentence, cause, remedy, DEPTH))
    return found


def _of_mesh(metrics: Mapping[str, Any], figures: Mapping[str, Any]) -> list[ResultProblem]:
    """Of the mesh where the asset's pictures have a better grade; and whether there is one."""
    picture = f"{MeshOutputs.stage}/{MeshOutputs.check}"
    if metrics["mesh"]["faces"] == 0:
        remedy = "Train longer, or set mesh.density_threshold by hand."
        return [ResultProblem("mesh", "usable", "The mesh is empty.", "The asset has no clear surface.", remedy, picture)]
    found = []
    rough = [view["mesh"]["roughness"] for view in metrics["views"] if view["mesh"]["roughness"] is not None]
    if len(rough) > 1 and (share := statistics.fmean(rough)) > ROUGH:
        sentence = f"The mesh is rough: {100 * share:.0f} % of what photographs show as plain is bent by more than {BENT:.0f} degrees."
        cause = "Photographs say little about walls and tables of one colour, which come out in rags; the asset shows them right from near the photographs."
        remedy = "Photograph such surfaces with something on them that has texture (posters, newspapers, chalk); use the asset or the splats."
        found.append(ResultProblem("rough mesh", "usable", sentence, cause, remedy, picture))
    if not any(_passes(limit, figures["mesh_blur"], figures) for limit in (USABLE_BLUR, POOR_BLUR)):
        return found
    sentence = f"The mesh is behind the asset: {metrics['mesh']['psnr']:.1f} dB, {blur_in_words(figures['mesh_blur'])}."
    cause = "Its surface is not where the asset's is, or what it shows has none (fur, leaves, glass)."
    remedy = "Raise mesh.max_faces, or set mesh.density_threshold by hand; use the asset or the splats."
    return [*found, ResultProblem("mesh", "usable", sentence, cause, remedy, picture)]


def _of_splats(metrics: Mapping[str, Any], figures: Mapping[str, Any]) -> list[ResultProblem]:
    if not _passes(POOR_BLUR, figures["splats_blur"], figures):
        return []
    sentence = f"The 3D Gaussians are behind the asset: {metrics['splats']['psnr']:.1f} dB, {blur_in_words(figures['splats_blur'])}."
    picture = f"{SplatsOutputs.stage}/{SplatsOutputs.preview}"
    remedy = "Raise splats.count or splats.iterations, or give more time (--budget, splats.time_budget)."
    return [ResultProblem("splats", "usable", sentence, "They are too few, or too few steps fitted them.", remedy, picture)]


def _passes(limit: float, blur: float | None, figures: Mapping[str, Any]) -> bool:
    """Whether pictures are worse than that, and the asset's are not: else that is reported."""
    return blur is not None and figures["blur"] is not None and figures["blur"] <= limit < blur


def _of_cameras(cameras: CameraVerdict | None) -> list[ResultProblem]:
    """Faults of cameras that held-out photographs cannot show: cameras are missing, or depth is a guess."""
    if cameras is None or cameras.grade not in ("poor", "failed"):
        return []
    picture = f"{PosesOutputs.stage}/{PosesOutputs.cameras}"
    sentence = f"The cameras are {cameras.grade}: {cameras.worst.sentence}"
    return [ResultProblem("cameras", "usable", sentence, "The photographs, as the verdict on the cameras has it.", cameras.worst.remedy, picture)]
