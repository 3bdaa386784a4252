"""Tables 1 to 6 of the paper: the trainings that each compares, the figures printed in the paper, and the columns of ours."""

import dataclasses
from collections.abc import Sequence
from statistics import fmean
from typing import Any

from benchmarks.paper import pretrained
from benchmarks.paper.result import PAPER, Request, Result
from benchmarks.paper.runs import CONVERGED_PSNR, Figures, Row, measured, scenes, settings_of

# Table 1, percent: valid, pivotal.
SHARES = {
    "chair": (9.58, 3.79), "drums": (7.00, 2.25), "ficus": (3.85, 1.68), "hotdog": (9.35, 3.59), "lego": (15.43, 5.81), "materials": (19.47, 7.42),
    "mic": (8.44, 3.14), "ship": (11.32, 4.62),
}  # fmt: skip
# Original NeRF: 64 coarse samples, 128 more by importance, both networks 8x256, the direction a further input.
NERF: dict[str, Any] = {
    "field": "nerf", "sampling": "hierarchical", "num_coarse_samples": 64, "num_importance_samples": 128, "coarse_hidden_dim": 256, "coarse_num_layers": 8
}  # fmt: skip
LARGE = {"coarse_hidden_dim": 256, "coarse_num_layers": 8}
SMALL = {"hidden_dim": 128, "num_layers": 4}
# NeRF's numbers of samples, for the rows before pivotal sampling.
IMPORTANCE = {"num_coarse_samples": 64, "num_importance_samples": 128}

TIMED = "Frames/s are of rendering alone: on a device the framebuffer stays there."
FIT = "The tree's values were fitted to the training images after they were baked, so that it may be ahead of its network; the paper caches the network's."


def shares(request: Request) -> Result:
    """Table 1: shares of valid and pivotal samples of a trained NeRF (as in section 3.3) and of EfficientNeRF."""
    columns = ["scene", "method", "valid %", "valid %" + PAPER, "pivotal %", "pivotal %" + PAPER, "PSNR"]
    cases = [Row("nerf", NERF), Row("n4")]
    rows, curves = [], {}
    for scene in scenes(request.data):
        printed = next((SHARES[name] for name in SHARES if scene.name.lower().startswith(name)), (None, None))
        for row, method in zip(cases, ("NeRF", "EfficientNeRF"), strict=True):
            figures = measured(request, scene, row)
            ours = (100 * figures.valid, 100 * figures.pivotal)
            rows.append(dict(zip(columns, [scene.name, method, ours[0], printed[0], ours[1], printed[1], figures.psnr], strict=True)))
            curves[f"{scene.name}, {method}"] = figures.curve
    notes = [
        "Shares are counts over all rays of the test views times N_c (NeRF 64, EfficientNeRF 128), between near 2 and far 6, at the end of the run."
        " Valid: of a NeRF, coarse samples with a density before its activation above zero; of EfficientNeRF, those that its density voxels left."
        " Pivotal: with a coarse weight above 1e-4. The paper measured its shares on trained NeRFs.",
    ]
    return Result(columns, rows, [*notes, *_notes(request, cases)], curves)


def quality(request: Request) -> Result:
    """Table 2: NeRF and EfficientNeRF on the scenes given, network and tree."""
    columns = ["method", "PSNR", "PSNR" + PAPER, "SSIM", "SSIM" + PAPER, "training, hours", "training, hours" + PAPER, "frames/s", "frames/s" + PAPER, "frame"]
    rows = [Row("nerf", NERF), Row("n4", bakes=True)]
    means, curves = _means(request, rows)
    nerf, ours = means
    tree = [figures.tree for figures in ours if figures.tree is not None]

    def of(figures: Sequence[Figures], name: str) -> float:
        return fmean(getattr(each, name) for each in figures)

    table = [
        ["NeRF", of(nerf, "psnr"), 31.01, of(nerf, "ssim"), 0.947, of(nerf, "hours"), 56.0, None, 0.023, None],
        ["EfficientNeRF, network", of(ours, "psnr"), None, of(ours, "ssim"), None, of(ours, "hours"), 6.0, None, None, None],
        ["EfficientNeRF, NerfTree", fmean(t["psnr"] for t in tree), 31.68, fmean(t["ssim"] for t in tree), 0.954, None, None,
         fmean(t["fps"] for t in tree), 238.46, tree[0]["frame"]],
    ]  # fmt: skip
    notes = [
        "The paper's figures are means of the eight synthetic scenes at 800x800; LPIPS stands in metrics.json of `enerf run` where its weights are given.",
        FIT, TIMED,
    ]  # fmt: skip
    return Result(columns, [dict(zip(columns, row, strict=True)) for row in table], [*notes, *_notes(request, rows)], curves)


def versions(request: Request) -> Result:
    """Table 3."""
    printed = {"n1": (64, 2, 29.54, 493.62), "n2": (64, 3, 30.49, 403.28), "n3": (96, 4, 31.22, 324.62), "n4": (128, 5, 31.68, 238.46)}
    columns = ["version", "coarse", "fine", "PSNR network", "PSNR tree", "PSNR" + PAPER, "frames/s", "frames/s" + PAPER, "frame", "s/iteration"]
    rows = [Row(name, {"num_coarse_samples": coarse, "samples_per_pivot": fine}, bakes=True) for name, (coarse, fine, *_) in printed.items()]
    means, curves = _means(request, rows)
    table = []
    for (name, (coarse, fine, psnr, fps)), figures in zip(printed.items(), means, strict=True):
        tree = [each.tree for each in figures if each.tree is not None]
        cells = [name.upper(), coarse, fine, fmean(f.psnr for f in figures), fmean(t["psnr"] for t in tree), psnr, fmean(t["fps"] for t in tree), fps]
        table.append(dict(zip(columns, [*cells, tree[0]["frame"], fmean(f.steady for f in figures)], strict=True)))
    notes = ["The tree is marched at half a voxel, whatever N_c and N_s: its frames/s depend on them only through what was baked.", FIT, TIMED]
    return Result(columns, table, [*notes, *_notes(request, rows)], curves)


def networks(request: Request) -> Result:
    """Table 4: NeRF's sampling and head with light or standard networks."""
    cases: list[tuple[str, str, dict[str, Any], float, float]] = [
        ("standard", "standard", NERF, 0.184, 31.01),
        ("light", "light", {**NERF, "coarse_hidden_dim": 128, "coarse_num_layers": 4, **SMALL}, 0.121, 29.28),
        ("standard", "light", {**NERF, **SMALL}, 0.132, 29.39),
        ("light", "standard", {**NERF, "coarse_hidden_dim": 128, "coarse_num_layers": 4}, 0.138, 30.96),
    ]
    columns = ["coarse MLP", "fine MLP", *PACE, "PSNR", "PSNR" + PAPER]
    rows = [Row("nerf" if changes is NERF else f"nerf-{coarse}-{fine}", changes) for coarse, fine, changes, *_ in cases]
    means, curves = _means(request, rows)
    table = [
        {"coarse MLP": coarse, "fine MLP": fine, **_pace(figures, seconds), "PSNR": fmean(f.psnr for f in figures), "PSNR" + PAPER: psnr}
        for (coarse, fine, _, seconds, psnr), figures in zip(cases, means, strict=True)
    ]
    return Result(columns, table, _notes(request, rows), curves)


def modules(request: Request) -> Result:
    """Table 5."""
    cases: list[tuple[str, str, dict[str, Any], float, float]] = [
        ("NeRF", "nerf", NERF, 31.01, 0.184),
        ("+ SH", "sh", {"sampling": "hierarchical", **IMPORTANCE, **LARGE}, 31.57, 0.183),
        ("+ lightweight coarse MLP", "light", {"sampling": "hierarchical", **IMPORTANCE}, 31.52, 0.137),
        ("+ coarse valid sampling", "valid", {"sampling": "valid", **IMPORTANCE}, 31.49, 0.085),
        ("+ fine pivotal sampling", "n4", {}, 31.68, 0.021),
    ]
    columns = ["method", "PSNR", "PSNR" + PAPER, *PACE, "less time %", "less time %" + PAPER]
    rows = [Row(name, changes) for _, name, changes, *_ in cases]
    means, curves = _means(request, rows)
    base = fmean(f.steady for f in means[0])
    table = []
    for (title, _, _, psnr, seconds), figures in zip(cases, means, strict=True):
        less = 100 * (1 - fmean(f.steady for f in figures) / base)
        table.append(
            {"method": title, "PSNR": fmean(f.psnr for f in figures), "PSNR" + PAPER: psnr, **_pace(figures, seconds)}
            | {"less time %": less, "less time %" + PAPER: 100 * (1 - seconds / 0.184)}
        )
    first, last = means[0], means[-1]
    faster, overall = (fmean(getattr(f, name) for f in first) / fmean(getattr(f, name) for f in last) for name in ("steady", "step"))
    notes = [
        f"All modules: {faster:.1f} times as fast as NeRF per iteration in the steady state (median of the last fifth of the run), {overall:.1f} times over the"
        " whole run, warm-up included; the paper: 8.8.",
        "The row of valid sampling takes its fine samples by importance among the valid ones, and none on rays without any.",
    ]
    return Result(columns, table, [*notes, *_notes(request, rows)], curves)


def strategies(request: Request) -> Result:
    """Table 6: NeRF, and NeRF-SH, which PlenOctree trains, from nothing; IBRNet and MVSNeRF finetuned (`benchmarks.paper.pretrained`)."""
    cases: list[tuple[str, str, str, dict[str, Any], float, float]] = [
        ("NeRF", "uniform", "nerf-uniform", {**NERF, "sampling": "uniform"}, 41.0, 30.06),
        ("NeRF", "NeRF", "nerf", NERF, 56.0, 31.01),
        ("NeRF", "ours", "nerf-ours", {"field": "nerf"}, 6.0, 31.25),
        ("PlenOctree", "NeRF", "sh", {"sampling": "hierarchical", **IMPORTANCE, **LARGE}, 58.0, 31.71),
        ("PlenOctree", "ours", "n4", {}, 6.0, 31.66),
    ]
    pace = [column for column in PACE if not column.endswith(PAPER)]
    columns = ["method", "sampling", "training, hours", "training, hours" + PAPER, *pace, pretrained.EQUAL, "PSNR", "PSNR" + PAPER]
    rows = [Row(name, changes) for _, _, name, changes, *_ in cases]
    means, curves = _means(request, rows)
    table = [
        {"method": field, "sampling": sampling, "training, hours": fmean(f.hours for f in figures), "training, hours" + PAPER: hours}
        | {"PSNR": fmean(f.psnr for f in figures), "PSNR" + PAPER: psnr, **{name: _pace(figures, None)[name] for name in pace}}
        for (field, sampling, _, _, hours, psnr), figures in zip(cases, means, strict=True)
    ]
    finetuned = pretrained.rows(request, scenes(request.data), settings_of(Row("pretrained"), request.scale))
    notes = [
        "Uniform: 64 + 128 even samples through the fine network alone, the number that the paper's times imply (41 h to 56 h as 192 to 256 evaluations).",
        "Our sampling is N4 with the lightweight coarse network.",
        *_notes(request, rows),
    ]
    return Result(columns, [*table[:3], *finetuned.rows, *table[3:]], [*notes, *finetuned.notes], {**curves, **finetuned.curves})


PACE = ["s/iteration", "s/iteration" + PAPER, "mean s/iteration", "coarse samples/ray", "fine samples/ray"]


def _pace(figures: Sequence[Figures], printed: float | None) -> dict[str, Any]:
    """The columns of PACE: steady state, the paper's, mean over the run, samples that went through the networks."""
    values = [fmean(f.steady for f in figures), printed, fmean(f.step for f in figures), fmean(f.coarse for f in figures), fmean(f.fine for f in figures)]
    return dict(zip(PACE, values, strict=True))


def _means(request: Request, rows: Sequence[Row]) -> tuple[list[list[Figures]], dict[str, tuple[Sequence[float], Sequence[float]]]]:
    """The figures of each row on each scene, and the curves of the first scene."""
    found = scenes(request.data)
    figures = [[measured(request, scene, row) for scene in found] for row in rows]
    return figures, {row.name: of[0].curve for row, of in zip(rows, figures, strict=True)}


def _notes(request: Request, rows: Sequence[Row]) -> list[str]:
    """Notes of every table that trains."""
    found, settings = scenes(request.data), settings_of(rows[-1], request.scale)
    train, poses = settings["train"], settings["poses"]
    sizes = f"{train['num_layers']}x{train['hidden_dim']} and {train['coarse_num_layers']}x{train['coarse_hidden_dim']}"
    notes = [
        f"Scenes: {', '.join(scene.name for scene in found)}; images of at most {poses['max_image_size']} pixels, {train['iterations']} iterations of"
        f" {train['max_rays_per_batch']} rays, networks {sizes} (last row),"
        f" density voxels {train['occupancy_resolution']}^3, learning rate {train['learning_rate']:.2g}, warm-up of {train['occupancy_warmup_steps']} steps.",
        "All rows share kernels, number type, batch, learning rate and loss. Seconds are of training steps alone; PSNR is of the network on test views.",
    ]
    if request.scale != 1:
        quiet = dataclasses.replace(request, say=lambda text: None, report=None)
        low = [f"{row.name} on {scene.name}" for row in rows for scene in found if not measured(quiet, scene, row).converged]
        verdict = f"Rows that have not converged (less than {CONVERGED_PSNR:g} dB) and do not count: {', '.join(low)}." if low else (
            f"All rows have converged (at least {CONVERGED_PSNR:g} dB)."
        )  # fmt: skip
        notes.append(verdict)
    return notes
