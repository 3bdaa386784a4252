"""verify, diff and convert with bare asset files."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from efficientnerf.asset.file import memory
from efficientnerf.asset.format import WRITERS, describe, load, save
from tests.efficientnerf.trees import random_tree
from tests.workflows.command import Enerf, Result
from workflows.inspection.convert import LAYOUTS

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def asset(tmp_path: Path) -> Path:
    path = tmp_path / "asset.nerftree"
    save(random_tree(3, shape=(5, 5, 5), brick=4, degree=2, sigma=60.0, metadata={"licence": "CC0-1.0", "provenance": {"tool": "a test"}}), path)
    return path


def test_a_bare_asset_is_verified(enerf: Enerf, asset: Path) -> None:
    assert tuple(WRITERS) == LAYOUTS
    result = enerf("verify", asset)
    assert (result.code, "format 1.0, sparse" in result.out) == (0, True), result.err
    assert enerf("verify", asset, "--json").object["damaged"] == []
    assert enerf("verify", asset, "--quiet") == Result(0, "", "")
    data = asset.read_bytes()
    for damaged in (data[:-100] + bytes([data[-100] ^ 1]) + data[-99:], data[:-1]):
        asset.write_bytes(damaged)
        broken = enerf("verify", asset, "--json")
        assert (broken.code, broken.objects[-1]["damaged"]) == (4, [str(asset)])
    assert enerf("verify", asset.with_name("none.nerftree")).code == 2


def test_what_differs_is_said(enerf: Enerf, asset: Path, tmp_path: Path) -> None:
    other = tmp_path / "b.nerftree"
    other.write_bytes(asset.read_bytes())
    assert enerf("diff", asset, other, "--views", 2, "--size", 32).code == 0
    found = enerf("diff", asset, other, "--views", 2, "--json").object
    assert (found["equal"], found["psnr"], set(found["tensors"].values())) == (True, 100.0, {"same"})
    tree = load(asset)
    save(replace(tree, density_values=tree.density_values * 2).with_metadata(licence="MIT"), other)
    result = enerf("diff", asset, other, "--size", 48)
    assert result.code == 6
    assert all(name in result.out for name in ("CC0-1.0", "MIT", "voxel.density"))
    assert "voxel.sh" not in result.out
    found = enerf("diff", asset, other, "--size", 48, "--json").object
    assert (found["exit_code"], found["equal"], found["metadata"]) == (6, False, {"licence": ["CC0-1.0", "MIT"]})
    assert {name for name, said in found["tensors"].items() if said != "same"} == {"voxel.density"}
    assert (len(found["views"]), 5 < found["psnr"] < 40) == (4, True)
    assert enerf("diff", asset, other, "--views", 0, "--json").object["psnr"] is None
    assert enerf("diff", asset, other, "--views", 0, "--quiet") == Result(6, "", "")
    other.write_bytes(asset.read_bytes()[:-1])
    assert enerf("diff", asset, other).code == 4


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_can_be_had_of_every_other(enerf: Enerf, asset: Path, tmp_path: Path, layout: str) -> None:
    first, second = tmp_path / "first.nerftree", tmp_path / "second.nerftree"
    made = enerf("convert", asset, first, "--layout", layout, "--json")
    assert made.code == 0, made.err
    about = describe(first)
    assert made.objects[-1]["written"][0]["layout"] == about["layout"]
    assert about["layout"] == {"small": "compact", "full32": "full"}.get(layout, layout)
    assert about["provenance"]["converted_from"]["layout"] == "sparse"
    assert about["provenance"]["tool"] == "a test"
    assert about["licence"] == "CC0-1.0"
    # Voxels of noise with holes: codes for all harmonics together keep least of it, and full bricks fill the holes.
    assert enerf("diff", asset, first, "--size", 64, "--views", 2, "--json").object["psnr"] > {"small": 22, "sparse": 60}.get(layout, 33)
    assert enerf("convert", first, second, "--layout", "sparse").code == 0
    assert layout.startswith("full") or describe(second)["voxels"] == describe(asset)["voxels"]
    assert enerf("diff", first, second, "--size", 64, "--views", 2, "--json").object["psnr"] > 60
    assert enerf("convert", first, second, "--force").code == 0  # as it is
    kept = {key: value for key, value in describe(second).items() if "bytes" not in key and key != "provenance"}
    assert kept == {key: about[key] for key in kept}


def test_resolution_and_degree(enerf: Enerf, asset: Path, tmp_path: Path) -> None:
    out = tmp_path / "less.nerftree"
    result = enerf("convert", asset, out, "--resolution", 10, "--sh-degree", 1, "--layout", "compact")
    assert result.code == 0, result.err
    about = describe(out)
    assert (about["resolution"], about["sh_degree"], about["layout"]) == ([12, 12, 12], 1, "compact")
    assert about["voxel_side"] == pytest.approx(2 * describe(asset)["voxel_side"])
    (tmp_path / "folder.nerftree").mkdir()
    (tmp_path / "odd.nerftree").write_bytes(b"no asset")
    for name, more in (
        ("more.nerftree", ("--sh-degree", 3)),
        ("more.nerftree", ("--resolution", 21)),
        ("a.ply", ()),
        ("none/a.nerftree", ()),
        ("folder.nerftree", ()),
    ):
        refused = enerf("convert", asset, tmp_path / name, *more)
        assert (refused.code, str(more[1] if more else name) in refused.err) == (2, True)
    assert enerf("convert", tmp_path / "none.nerftree", tmp_path / "more.nerftree").code == 2
    assert enerf("convert", tmp_path / "odd.nerftree", tmp_path / "more.nerftree").code == 4
    assert not (tmp_path / "more.nerftree").exists()


def test_what_a_layout_has_no_place_for_is_refused(enerf: Enerf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """20 million voxels of one value are a valid `compact` file, and no `packed` one, which is nearly nothing; here fewer voxels, and less than 200 MB."""
    monkeypatch.setattr("efficientnerf.asset.file.memory.FIXED_BYTES", 100_000)
    tree = random_tree(0, shape=(6, 6, 6), brick=4, degree=1, share=1.0)
    constant = replace(tree, density_values=np.ones_like(tree.density_values), harmonics=np.ones_like(tree.harmonics))
    save(constant, tmp_path / "a.nerftree", "compact")
    refused = enerf("convert", tmp_path / "a.nerftree", tmp_path / "b.nerftree", "--layout", "packed", "--json")
    assert refused.code == 2, refused.err
    assert refused.objects[-1]["kind"] == "UsageError"
    assert not (tmp_path / "b.nerftree").exists()


def test_security_and_format_state_the_memory_of_an_asset_alike() -> None:
    """In the numbers that are checked."""
    for name in ("SECURITY.md", "efficientnerf/asset/FORMAT.md"):
        text = (ROOT / name).read_text(encoding="utf-8")
        assert re.search(rf"{memory.MAX_RATIO} times.*{memory.MAX_PACKED_RATIO} times", text, re.DOTALL)
        assert f"{memory.FIXED_BYTES // 10**6} MB" in text or f"{memory.FIXED_BYTES:,}" in text


def test_inspect_tells_what_a_coded_asset_holds(enerf: Enerf, asset: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.nerftree"
    enerf("convert", asset, out, "--layout", "compact")
    found = enerf("inspect", out, "--json").object
    assert (found["layout"], found["bytes_per_voxel"], found["sh_groups"], found["licence"]) == ("compact", 12, [1] * 8, "CC0-1.0")
    assert sum(found["bytes_per_part"].values()) == out.stat().st_size == found["bytes"]
    data = out.read_bytes()
    out.write_bytes(data[: 8 + int.from_bytes(data[:8], "little")] + bytes(len(data) - 8 - int.from_bytes(data[:8], "little")))
    assert enerf("inspect", out, "--json").object["voxels"] == found["voxels"], "the tensors are not read"


GOLDEN = Path(__file__).parents[2] / "data" / "golden"


def test_a_whole_scene_is_inspected_verified_compared_and_converted(enerf: Enerf, tmp_path: Path) -> None:
    scene = tmp_path / "scene.nerftree"
    scene.write_bytes((GOLDEN / "nested-1.4.nerftree").read_bytes())
    assert "[-1.3, -0.4, -1.7] to [1.1, 2, 0.7]" in enerf("inspect", scene).out
    found = enerf("inspect", scene, "--json").object
    assert [cascade["voxel_side"] for cascade in found["cascades"]] == [0.1, 0.2, 0.4]
    assert found["environment"] == [6, 12]
    assert "format 1.4, nested-compact" in enerf("verify", scene).out
    # Without its map, which is all that differs.
    tree = load(scene)
    save(replace(tree, environment=tree.environment * 0), tmp_path / "dark.nerftree")  # type: ignore[operator]
    compared = enerf("diff", scene, tmp_path / "dark.nerftree", "--views", 0, "--json").object
    assert {name for name, said in compared["tensors"].items() if said != "same"} == {"environment"}
    for layout in LAYOUTS:
        out = tmp_path / f"{layout}.nerftree"
        made = enerf("convert", scene, out, "--layout", layout)
        assert made.code == 0, made.err
        about = describe(out)
        assert about["layout"] == "nested-" + {"small": "compact", "full32": "full"}.get(layout, layout)
        assert {key: about[key] for key in ("cascades", "environment", "region")} == {key: found[key] for key in ("cascades", "environment", "region")}
    assert enerf("convert", scene, tmp_path / "less.nerftree", "--resolution", 4, "--sh-degree", 0).code == 0
    about = describe(tmp_path / "less.nerftree")
    assert [cascade["resolution"] for cascade in about["cascades"]] == [[4, 4, 4]] * 3
    assert (about["brick"], about["environment"], about["sh_degree"]) == (1, [6, 12], 0)
    refused = enerf("convert", scene, tmp_path / "none.nerftree", "--resolution", 6)
    assert (refused.code, "12, 4" in refused.err) == (2, True)
