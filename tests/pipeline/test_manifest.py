from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pipeline import files
from pipeline.errors import CorruptArtifact
from pipeline.manifest import Manifest, Output, Request, artifact_digest, read_manifest, tool_versions

A, B, C = ("a" * 64, "b" * 64, "c" * 64)


def example() -> Manifest:
    request = Request("train", 2, {"rate": 0.5, "sizes": [1, 2]}, {"poses": A}, {"0.jpg": B, "gone.jpg": "absent"})
    outputs = {"field.bin": Output(A, 10), "log.jsonl": Output(B, 5, True)}
    return Manifest(request, outputs, 1.5, 1000, True, cpu_seconds=3.0, cores=4, facts={"schedule": [1, 2]})


def write(folder: Path, change: Callable[[dict[str, Any]], Any] = lambda value: None, *, checked: bool = True) -> None:
    """The example, changed, with a checksum that fits unless told otherwise."""
    value = json.loads(example().to_bytes())
    change(value)
    if checked:
        value.pop("checksum", None)
        value["checksum"] = hashlib.sha256(files.canonical_json(value)).hexdigest()
    (folder / "manifest.json").write_text(json.dumps(value))


def test_there_and_back(tmp_path: Path) -> None:
    made = example()
    (tmp_path / "manifest.json").write_bytes(made.to_bytes())
    assert read_manifest(tmp_path) == made
    assert made.size == 15
    assert made.cores_busy == 2.0


def test_a_manifest_from_before_processor_time_was_recorded_is_read(tmp_path: Path) -> None:
    write(tmp_path, lambda value: [value.pop(name) for name in ("cpu_seconds", "cores", "facts")])
    made = read_manifest(tmp_path)
    assert (made.cpu_seconds, made.cores, made.cores_busy, made.facts) == (0.0, 0, 0.0, {})
    assert (made.digest, made.request.digest) == (example().digest, example().request.digest)


def test_the_digest_sees_names_and_bytes_but_not_what_depends_on_the_clock() -> None:
    one = {"a": Output(A, 1), "log": Output(B, 1, True)}
    assert artifact_digest(one) == artifact_digest({"log": Output(C, 9, True), "a": Output(A, 1)})
    assert artifact_digest(one) != artifact_digest({"b": Output(A, 1)})
    assert artifact_digest(one) != artifact_digest({"a": Output(B, 1)})
    assert artifact_digest(one) != artifact_digest({"a": Output(A, 1), "log": Output(B, 1)})


def test_the_request_digest_sees_all_of_the_request() -> None:
    requests = [
        Request("train", 1, {"a": 1}, {}),
        Request("bake", 1, {"a": 1}, {}),
        Request("train", 2, {"a": 1}, {}),
        Request("train", 1, {"a": 2}, {}),
        Request("train", 1, {"a": 1}, {"poses": A}),
        Request("train", 1, {"a": 1}, {}, {"x": A}),
    ]
    assert len({request.digest for request in requests}) == len(requests)
    assert Request("t", 1, {"a": 1, "b": 2}, {}).digest == Request("t", 1, {"b": 2, "a": 1}, {}).digest


HOSTILE: dict[str, tuple[Callable[[dict[str, Any]], Any], str]] = {
    "absolute": (lambda v: v["outputs"].update({"/etc/passwd": v["outputs"]["field.bin"]}), "no name of a file"),
    "parent": (lambda v: v["outputs"].update({"../x": v["outputs"]["field.bin"]}), "no name of a file"),
    "itself": (lambda v: v["outputs"].update({"manifest.json": v["outputs"]["field.bin"]}), "no name of a file"),
    "negative size": (lambda v: v["outputs"]["field.bin"].update(size=-1), "Expected `int` >= 0"),
    "size text": (lambda v: v["outputs"]["field.bin"].update(size="10"), "got `str`"),
    "size bool": (lambda v: v["outputs"]["field.bin"].update(size=True), "got `bool`"),
    "short hash": (lambda v: v["outputs"]["field.bin"].update(sha256="abc"), "Expected `str` matching"),
    "other hash": (lambda v: v["outputs"]["field.bin"].update(sha256=C), "digests are not"),
    "no outputs": (lambda v: v.pop("outputs"), "outputs"),
    "outputs list": (lambda v: v.update(outputs=[]), "outputs"),
    "output number": (lambda v: v["outputs"].update({"field.bin": 5}), "Expected `object`"),
    "no request": (lambda v: v.pop("request"), "request"),
    "other request": (lambda v: v["request"].update(version=9), "digests are not"),
    "settings": (lambda v: v["request"].update(settings=[]), "settings"),
    "input": (lambda v: v["request"]["inputs"].update(poses="no"), "Expected `str` matching"),
    "source": (lambda v: v["request"].update(source=[]), "source"),
    "format": (lambda v: v.update(format="other"), "format 'other'"),
    "newer": (lambda v: v.update(format_version=2), "format version 2; this build reads 1"),
    "versions": (lambda v: v.update(versions={"a": 1}), "versions"),
    "huge number": (lambda v: v.update(seconds=10**400), "seconds"),
    "seconds": (lambda v: v.update(seconds="fast"), "seconds"),
}


@pytest.mark.parametrize("rule", HOSTILE)
def test_a_hostile_manifest_is_refused(tmp_path: Path, rule: str) -> None:
    change, message = HOSTILE[rule]
    write(tmp_path, change)
    with pytest.raises(CorruptArtifact, match=message) as caught:
        read_manifest(tmp_path)
    assert "\n" not in str(caught.value)
    assert caught.value.files == (f"{tmp_path.name}/manifest.json",)


def test_a_change_anywhere_is_noticed(tmp_path: Path) -> None:
    write(tmp_path)
    read_manifest(tmp_path)
    write(tmp_path, lambda value: value.update(seconds=2.0), checked=False)
    with pytest.raises(CorruptArtifact, match="checksum"):
        read_manifest(tmp_path)


def test_a_cut_manifest_is_refused_wherever_it_is_cut(tmp_path: Path) -> None:
    data = example().to_bytes()
    for end in range(0, len(data) - 1, 7):
        (tmp_path / "manifest.json").write_bytes(data[:end])
        with pytest.raises(CorruptArtifact):
            read_manifest(tmp_path)


def test_infinity_is_refused(tmp_path: Path) -> None:
    (tmp_path / "manifest.json").write_bytes(example().to_bytes().replace(b"1.5", b"1e999"))
    with pytest.raises(CorruptArtifact):
        read_manifest(tmp_path)


def test_a_missing_or_huge_manifest(tmp_path: Path) -> None:
    with pytest.raises(CorruptArtifact, match="is not there"):
        read_manifest(tmp_path)
    with open(tmp_path / "manifest.json", "wb") as file:
        file.truncate(65 * 2**20)
    with pytest.raises(CorruptArtifact, match="larger than"):
        read_manifest(tmp_path)


def test_versions_name_python_and_what_the_project_requires() -> None:
    versions = dict(tool_versions())
    assert {"python", "platform"} <= versions.keys()
    assert "filelock" in versions
