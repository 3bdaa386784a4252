"""docs/still_life_viewer.html, which the README links: whole, small, of the example, and drawn as `enerf render` draws its asset."""

from pathlib import Path

import pytest

from efficientnerf.asset.format import describe, load
from tests.stages.viewer.pages import carried, check_no_other_place, check_policy, facts

PAGE = Path(__file__).resolve().parents[3] / "docs" / "still_life_viewer.html"
@pytest.fixture(scope="module")
def text() -> str:
    return PAGE.read_text(encoding="utf-8")


@pytest.fixture
def asset(text: str, tmp_path: Path) -> Path:
    (tmp_path / "asset.nerftree").write_bytes(carried(text))
    return tmp_path / "asset.nerftree"


def test_it_may_run_its_own_script_alone_and_asks_for_nothing(text: str) -> None:
    check_policy(text)
    check_no_other_place(text)


def test_its_asset_verifies_and_says_how_it_was_made(text: str, asset: Path) -> None:
    about = describe(asset)
    assert facts(text)["bytes"] == asset.stat().st_size
    assert len(load(asset).density_values) == about["voxels"] > 10_000  # digests and rules are checked
    provenance = about["provenance"]
    assert provenance["tool"].startswith("efficientnerf ")
    assert provenance["training_views"] == 31
    assert provenance["settings"]["region"] == "foreground"
