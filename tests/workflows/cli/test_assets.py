"""verify, diff and convert with bare asset files."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from efficientnerf.asset.file import memory
from efficientnerf.asset.format import WRITERS, describe, load, save
from tests.efficientnerf.trees import random_tree
from tests.workflows.command import Result
from workflows.cli.assets import LAYOUTS

Enerf = Callable[..., Result]
ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def asset(tmp_path: Path) -> Path:
    path = tmp_path / "asset.nerftree"
    save(random_tree(3, shape=(5, 5, 5), brick=4, degree=2, sigma=60.0, metadata={"licence": "CC0-1.0", "provenance": {"tool": "a test"}}), path)
    return path


def test_the_layouts_are_those_there_are() -> None:
    assert tuple(WRITERS) == LAYOUTS


def test_a_bare_asset_is_verified(enerf: Enerf, asset: Path) -> None:
    result = enerf("verify", asset)
    assert result.code == 0, result.err
    assert "format 1.0, sparse" in result.out
    assert "all as written" in result.out
    assert enerf("verify", asset, "--json").object["damaged"] == []
    assert enerf("verify", asset, "--quiet") == Result(0, "", "")
    data = asset.read_bytes()
    asset.write_bytes(data[:-100] + bytes([data[-100] ^ 1]) + data[-99:])
    broken = enerf("verify", asset, "--json")
    assert broken.code == 4
    assert broken.objects[-1]["damaged"] == [str(asset)]
    assert "the file is damaged" in broken.err
    asset.write_bytes(data[:-1])
    assert "cut short" in enerf("verify", asset).err
    assert enerf("verify", asset.with_name("none.nerftree")).code == 2


def test_equal_assets_are_equal(enerf: Enerf, asset: Path, tmp_path: Path) -> None:
    (tmp_path / "b.nerftree").write_bytes(asset.read_bytes())
    result = enerf("diff", asset, tmp_path / "b.nerftree", "--views", 2, "--size", 32)
    assert (result.code, result.out) == (0, "equal\n")
    found = enerf("diff", asset, tmp_path / "b.nerftree", "--views", 2, "--json").object
    assert found["equal"]
    assert found["psnr"] == 100.0
    assert set(found["tensors"].values()) == {"same"}


def test_what_differs_is_said(enerf: Enerf, asset: Path, tmp_path: Path) -> None:
    tree = load(asset)
    other = tree.with_values(tree.density_values * 2, tree.sh).with_metadata(licence="MIT")
    save(other, tmp_path / "b.nerftree")
    result = enerf("diff", asset, tmp_path / "b.nerftree", "--size", 48)
    assert result.code == 6
    assert 'licence                  "CC0-1.0" -> "MIT"' in result.out
    assert "voxel.density            other values" in result.out
    assert "voxel.sh" not in result.out
    found = enerf("diff", asset, tmp_path / "b.nerftree", "--size", 48, "--json").object
    assert found["exit_code"] == 6
    assert not found["equal"]
    assert found["metadata"] == {"licence": ["CC0-1.0", "MIT"]}
    assert {name for name, said in found["tensors"].items() if said != "same"} == {"voxel.density"}
    assert len(found["views"]) == 4
    assert 5 < found["psnr"] < 40
    assert enerf("diff", asset, tmp_path / "b.nerftree", "--views", 0, "--json").object["psnr"] is None
    assert enerf("diff", asset, tmp_path / "b.nerftree", "--views", 0, "--quiet") == Result(6, "", "")
    (tmp_path / "b.nerftree").write_bytes(asset.read_bytes()[:-1])
    assert enerf("diff", asset, tmp_path / "b.nerftree").code == 4


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
    for option, value, said in (("--sh-degree", 3, "degree 3 from an asset of degree 2"), ("--resolution", 21, "resolution 21 from an asset of 20")):
        refused = enerf("convert", asset, tmp_path / "more.nerftree", option, value)
        assert refused.code == 2
        assert said in refused.err
    assert not (tmp_path / "more.nerftree").exists()


def test_what_convert_refuses(enerf: Enerf, asset: Path, tmp_path: Path) -> None:
    (tmp_path / "folder.nerftree").mkdir()
    for out, said in (("a.ply", "expected .nerftree"), ("none/a.nerftree", "does not exist"), ("folder.nerftree", "is a folder")):
        refused = enerf("convert", asset, tmp_path / out)
        assert refused.code == 2
        assert said in refused.err
    assert enerf("convert", tmp_path / "none.nerftree", tmp_path / "a.nerftree").code == 2
    asset.write_bytes(b"no asset")
    assert enerf("convert", asset, tmp_path / "a.nerftree").code == 4


def test_what_a_layout_has_no_place_for_is_refused(enerf: Enerf, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """20 million voxels of one value are a valid `compact` file, and no `packed` one, which is nearly nothing; here fewer voxels, and less than 200 MB."""
    monkeypatch.setattr("efficientnerf.asset.file.memory.BESIDES", 100_000)
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
        assert re.search(rf"{memory.TIMES} times.*{memory.PACKED_TIMES} times", text, re.DOTALL)
        assert f"{memory.BESIDES // 10**6} MB" in text or f"{memory.BESIDES:,}" in text


def test_inspect_tells_what_a_coded_asset_holds(enerf: Enerf, asset: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.nerftree"
    enerf("convert", asset, out, "--layout", "compact")
    found = enerf("inspect", out, "--json").object
    assert found["layout"] == "compact"
    assert found["bytes_per_voxel"] == 12
    assert sum(found["bytes_per_part"].values()) == out.stat().st_size == found["bytes"]
    assert found["sh_groups"] == [1] * 8
    assert found["licence"] == "CC0-1.0"
    data = out.read_bytes()
    out.write_bytes(data[: 8 + int.from_bytes(data[:8], "little")] + bytes(len(data) - 8 - int.from_bytes(data[:8], "little")))
    words = enerf("inspect", out)  # the tensors are not read
    assert words.code == 0
    assert "sh degree" in words.out
    assert json.loads(enerf("inspect", out, "--json").out)["voxels"] == found["voxels"]


GOLDEN = Path(__file__).parents[2] / "data" / "golden"


def test_a_whole_scene_is_inspected_verified_compared_and_converted(enerf: Enerf, tmp_path: Path) -> None:
    scene = tmp_path / "scene.nerftree"
    scene.write_bytes((GOLDEN / "nested-1.4.nerftree").read_bytes())
    words = enerf("inspect", scene).out
    assert "3, each with voxels twice as large as the one before" in words
    assert "1: voxels of 0.2, [12, 12, 12] of them, from [-1.3, -0.4, -1.7] to [1.1, 2, 0.7]" in words
    assert "a map of 12 x 6 colours, beyond all voxels" in words
    assert "from [-0.7, 0.2, -1.1] to [0.2, 1.1, -0.2], radius of its upright edges 0.2, fading over 0.1, some of the bricks in it" in words
    found = enerf("inspect", scene, "--json").object
    assert [cascade["voxel_side"] for cascade in found["cascades"]] == [0.1, 0.2, 0.4]
    assert found["environment"] == [6, 12]
    assert "format 1.4, nested-compact" in enerf("verify", scene).out
    # Without its map, which is all that differs.
    tree = load(scene)
    save(replace(tree, environment=tree.environment * 0), tmp_path / "dark.nerftree")  # type: ignore[operator]
    compared = enerf("diff", scene, tmp_path / "dark.nerftree", "--views", 0, "--json").object
    assert not compared["equal"]
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
    assert refused.code == 2
    assert "resolution 6 from cascades of 12 voxels in bricks of 3; expected one of 12, 4" in refused.err
