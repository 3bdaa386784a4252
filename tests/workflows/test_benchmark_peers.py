"""benchmarks/peers: the data set that a peer reads, the pixels that count, and the row of one that is a tenth off."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from benchmarks.minutes import read_rows
from benchmarks.peers import __main__ as peers
from benchmarks.scenes.__main__ import write_scene
from benchmarks.scenes.catalogue import recipes

COUNTS = {"train": 3, "val": 1, "test": 2}
# Renders the test images on white, of the pixels asked for, each a tenth nearer to grey than it is.
PEER = """
import json, sys
from pathlib import Path
import numpy as np
from PIL import Image

data, out = map(Path, sys.argv[1:3])
given = dict(zip(sys.argv[3::2], sys.argv[4::2]))
stride = int(given["--stride"])
images = []
for frame in json.loads((data / "transforms_test.json").read_text())["frames"]:
    pixels = np.asarray(Image.open(data / (frame["file_path"] + ".png"))) / 255
    white = (pixels[..., :3] * pixels[..., 3:] + 1 - pixels[..., 3:])[(stride - 1) // 2 :: stride, (stride - 1) // 2 :: stride]
    images.append(np.where(white < 0.5, white + 0.1, white - 0.1))
np.save(out / "renders.npy", np.stack(images))
report = {"steps": 7, "rays_per_second": 1.5, "rendering_seconds": 2.0, "threads": int(given["--threads"]), "settings": sys.argv, "seconds": 60.0}
(out / "report.json").write_text(json.dumps(report | {"versions": {"nerfstudio": "9"}, "model_bytes": 2_000_000, "peak_mib": 3.0}))
"""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scenes")
    write_scene(recipes()["object"], folder / "object", COUNTS, 32, supersample=1)
    return folder / "object"


@pytest.mark.parametrize("stride", [1, 3])
def test_a_peer_that_is_a_tenth_off_has_twenty_decibels(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stride: int) -> None:
    (tmp_path / "peer.py").write_text(PEER)
    monkeypatch.setattr(peers, "SCRIPTS", {"nerfacto": tmp_path / "peer.py"})
    options = {"python": sys.executable, "work": tmp_path / "work", "sets": "object", "scenes": scene.parent, "stride": stride, "minutes": 1}
    options |= {"variants": "default,small", "threads": 1, "out": tmp_path / "out"}
    call = ["nerfacto", *(text for name, value in options.items() for text in (f"--{name}", str(value)))]
    peers.main(call)
    rows = read_rows(tmp_path / "out/peers.json")
    assert [row["options"] for row in rows] == ["", "small"]
    for row in rows:
        assert row["psnr"] == pytest.approx(20, abs=1e-9)
        assert (row["ssim"] is None) == (stride > 1)
        assert (row["views"], row["stride"], row["megabytes"], row["code"], row["minutes"]) == (2, stride, 2.0, "nerfacto 9", 1.0)
    assert ["model.num_nerf_samples_per_ray=24" in row["settings"] for row in rows] == [False, True]
    (tmp_path / "peer.py").write_text("raise SystemExit(3)")
    peers.main(call)  # measured before
    with pytest.raises(SystemExit, match="exit code 3"):
        peers.main([*call, "--again"])
    assert read_rows(tmp_path / "out/peers.json") == rows
