import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pipeline import files
from pipeline.errors import CorruptArtifact
from pipeline.manifest import Manifest, Output, Request, read_manifest

A, B, C = ("a" * 64, "b" * 64, "c" * 64)


def example() -> Manifest:
    request = Request("train", 2, {"rate": 0.5, "sizes": [1, 2]}, {"poses": A}, {"0.jpg": B, "gone.jpg": "absent"})
    outputs = {"field.bin": Output(A, 10), "log.jsonl": Output(B, 5, True)}
    return Manifest(request, outputs, 1.5, 1000, True, cpu_seconds=3.0, cores=4, facts={"schedule": [1, 2]})


def write(folder: Path, change: Callable[[dict[str, Any]], Any], *, checked: bool = True) -> None:
    """The example, changed, with a checksum that fits unless told otherwise."""
    value = json.loads(example().to_bytes())
    change(value)
    if checked:
        value.pop("checksum", None)
        value["checksum"] = hashlib.sha256(files.canonical_json(value)).hexdigest()
    (folder / "manifest.json").write_text(json.dumps(value))


HOSTILE: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "absolute": (lambda v: v["outputs"].update({"/etc/passwd": v["outputs"]["field.bin"]}), "passwd"),
    "parent": (lambda v: v["outputs"].update({"../x": v["outputs"]["field.bin"]}), "../x"),
    "itself": (lambda v: v["outputs"].update({"manifest.json": v["outputs"]["field.bin"]}), "manifest.json"),
    "negative size": (lambda v: v["outputs"]["field.bin"].update(size=-1), "size"),
    "size bool": (lambda v: v["outputs"]["field.bin"].update(size=True), "size"),
    "short hash": (lambda v: v["outputs"]["field.bin"].update(sha256="abc"), "sha256"),
    "other hash": (lambda v: v["outputs"]["field.bin"].update(sha256=C), "digests"),
    "no outputs": (lambda v: v.pop("outputs"), "outputs"),
    "output number": (lambda v: v["outputs"].update({"field.bin": 5}), "outputs"),
    "no request": (lambda v: v.pop("request"), "request"),
    "other request": (lambda v: v["request"].update(version=9), "digests"),
    "settings": (lambda v: v["request"].update(settings=[]), "settings"),
    "input": (lambda v: v["request"]["inputs"].update(poses="no"), "inputs"),
    "source": (lambda v: v["request"].update(source=[]), "source"),
    "format": (lambda v: v.update(format="other"), "format"),
    "newer": (lambda v: v.update(format_version=2), "this build reads 1"),
    "versions": (lambda v: v.update(versions={"a": 1}), "versions"),
    "huge number": (lambda v: v.update(seconds=10**400), "seconds"),
}


@pytest.mark.parametrize("rule", HOSTILE)
def test_a_hostile_manifest_is_refused(tmp_path: Path, rule: str) -> None:
    change, field = HOSTILE[rule]
    write(tmp_path, change)
    with pytest.raises(CorruptArtifact) as caught:
        read_manifest(tmp_path)
    assert field in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.files == (f"{tmp_path.name}/manifest.json",)


def test_a_manifest_that_is_altered_cut_huge_or_gone_is_refused(tmp_path: Path) -> None:
    def refused() -> None:
        with pytest.raises(CorruptArtifact):
            read_manifest(tmp_path)

    refused()
    write(tmp_path, lambda value: value.update(seconds=2.0), checked=False)
    refused()
    data = example().to_bytes()
    for damaged in (data.replace(b"1.5", b"1e999"), *(data[:end] for end in range(0, len(data) - 1, 31))):
        (tmp_path / "manifest.json").write_bytes(damaged)
        refused()
    with open(tmp_path / "manifest.json", "wb") as file:
        file.truncate(65 * 2**20)
    refused()
