"""The viewer as a file: one page, without requests, which names cannot break out of."""

from pathlib import Path

import numpy as np
import pytest

from efficientnerf.asset.format import FormatError, load, save, serialize
from stages.viewer.page import viewer_page, write_viewer
from tests.efficientnerf.trees import random_tree
from tests.stages.viewer.pages import carried, check_policy, facts


def text_of(page: bytes) -> str:
    return page.decode("utf-8")


@pytest.fixture(scope="module")
def asset() -> bytes:
    return serialize(random_tree(3, background=(1.0, 1.0, 1.0)), "compact")


def test_a_page_carries_the_asset_byte_by_byte(asset: bytes, tmp_path: Path) -> None:
    path = tmp_path / "a.nerftree"
    path.write_bytes(asset)
    size = write_viewer(path, tmp_path / "viewer.html")
    page = (tmp_path / "viewer.html").read_bytes()
    assert len(page) == size
    assert carried(text_of(page)) == asset
    assert facts(text_of(page))["bytes"] == len(asset)
    assert "<title>a</title>" in text_of(page)


@pytest.mark.parametrize("layout", ["sparse", "full", "packed"])
def test_other_layouts_become_compact(layout: str, tmp_path: Path) -> None:
    tree = random_tree(4, shape=(2, 2, 2), share=0.6)  # of fewer voxels than a palette has entries: each keeps its values
    save(tree, tmp_path / "a.nerftree", layout)
    write_viewer(tmp_path / "a.nerftree", tmp_path / "viewer.html")
    (tmp_path / "b.nerftree").write_bytes(carried(text_of((tmp_path / "viewer.html").read_bytes())))
    again, before = load(tmp_path / "b.nerftree"), load(tmp_path / "a.nerftree")
    assert np.array_equal(again.brick_index, before.brick_index)
    assert np.abs(again.sh - before.sh).max() < 2e-3


def test_no_page_is_made_of_a_damaged_asset(asset: bytes, tmp_path: Path) -> None:
    damaged = bytearray(asset)
    damaged[-3] ^= 1
    (tmp_path / "a.nerftree").write_bytes(bytes(damaged))
    with pytest.raises(FormatError, match="SHA-256"):
        write_viewer(tmp_path / "a.nerftree", tmp_path / "viewer.html")
    assert [each.name for each in tmp_path.iterdir()] == ["a.nerftree"]


def test_the_policy_allows_the_pages_own_script_and_style_alone(asset: bytes) -> None:
    check_policy(text_of(viewer_page(asset)))
