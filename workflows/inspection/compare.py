"""`enerf diff`: two assets compared, their metadata, tensors and renders."""

import json
from pathlib import Path
from typing import Any

import click

from efficientnerf.asset.camera_paths import turntable_cameras
from efficientnerf.asset.format import contents
from efficientnerf.asset.rendering import render
from efficientnerf.asset.tree import NerfTree
from efficientnerf.evaluation.metrics import psnr
from workflows.cli.options import folder_type, output_options
from workflows.cli.output import conclude, listing
from workflows.cli.target import asset_of
from workflows.loading import load_asset

DIFFERENT = 6  # exit code; 1 would be that of a defect
PSNR_CAP = 100.0  # decibels: JSON has no infinity; equal renders get this


@click.command()
@click.argument("first", metavar="A", type=folder_type)
@click.argument("second", metavar="B", type=folder_type)
@click.option("--views", type=click.IntRange(0, 1000), default=4, show_default=True, help="Number of renders to compare, on an orbit of A.")
@click.option("--size", type=click.IntRange(16, 4096), default=400, show_default=True, help="Side of the renders in pixels.")
@output_options
def diff(first: Path, second: Path, views: int, size: int, as_json: bool, quiet: bool) -> int:
    """Compare the assets (or runs) A and B: metadata and tensors that differ, and the PSNR between their renders.

    The exit code is 0 if they are equal, 6 if they differ, 4 if one is damaged.
    """
    found = compare(first, second, views, size)
    code = 0 if found["equal"] else DIFFERENT
    if not as_json and not quiet:
        listing(*in_words(found))
    return conclude(as_json=as_json, quiet=True, code=code, ok=True, first=str(first), second=str(second), **found)


def compare(first: Path, second: Path, views: int, size: int) -> dict[str, Any]:
    """Metadata and tensors that differ, and the PSNR between renders of `size` pixels a side from `views` cameras on the first one's orbit.

    `equal` says that all tensors and all metadata are the same, whatever the order and the padding of the header.
    """
    a, b = load_asset(first), load_asset(second)  # refuses damaged files first
    (meta_a, tensors_a), (meta_b, tensors_b) = (contents(asset_of(path)) for path in (first, second))
    metadata = {key: [meta_a.get(key), meta_b.get(key)] for key in sorted({*meta_a, *meta_b}) if meta_a.get(key) != meta_b.get(key)}
    tensors = {name: _difference(tensors_a.get(name), tensors_b.get(name)) for name in sorted({*tensors_a, *tensors_b})}
    equal = not metadata and set(tensors.values()) <= {"same"}
    found: dict[str, Any] = {"equal": equal, "metadata": metadata, "tensors": tensors, "psnr": None, "views": []}
    if views:
        found["views"] = [PSNR_CAP] * views if equal else _psnr_of_renders(a, b, views, size)
        found["psnr"] = sum(found["views"]) / views
    return found


def _difference(a: dict[str, Any] | None, b: dict[str, Any] | None) -> str:
    if a is None or b is None:
        return "only in the second" if a is None else "only in the first"
    if a == b:
        return "same"
    if (a["dtype"], a["shape"]) == (b["dtype"], b["shape"]):
        return "other values"
    return f"{a['dtype']} {a['shape']} and {b['dtype']} {b['shape']}"


def _psnr_of_renders(a: NerfTree, b: NerfTree, views: int, size: int) -> list[float]:
    background = None if a.environment is not None or b.environment is not None else a.background or (1.0, 1.0, 1.0)  # what lies beyond is compared too
    cameras = turntable_cameras(a, frames=views, width=size, height=size)
    return [min(PSNR_CAP, psnr(*(render(tree, camera, background=background, normals=False).colour.clip(0, 1) for tree in (a, b)))) for camera in cameras]


def in_words(found: dict[str, Any]) -> list[str]:
    """The comparison as lines."""
    if found["equal"]:
        return ["equal"]
    lines = [f"{key:<24} {_short(a)} -> {_short(b)}" for key, (a, b) in found["metadata"].items()]
    lines += [f"{name:<24} {difference}" for name, difference in found["tensors"].items() if difference != "same"]
    if found["views"]:
        lines.append(f"{'renders':<24} {found['psnr']:.2f} dB apart (PSNR), mean of {len(found['views'])} views; least {min(found['views']):.2f}")
    return lines


def _short(value: Any) -> str:
    text = "absent" if value is None else json.dumps(value, sort_keys=True)
    return text if len(text) <= 60 else text[:57] + "..."
