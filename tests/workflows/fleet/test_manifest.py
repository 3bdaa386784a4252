"""Manifests of fleets: what they say, all their mistakes at once, and what hostile ones cannot do."""

from __future__ import annotations

import itertools
import tomllib
from pathlib import Path

import pytest

from pipeline.errors import BadInput, Mistakes, PipelineError, UsageError
from pipeline.fleet.state import Scene, check_scenes
from tests.workflows.command import Enerf
from workflows.asset import WORKFLOW
from workflows.fleet.checked import Choice, Text
from workflows.fleet.lines import lines_of
from workflows.fleet.manifest import MAX_BYTES, read_manifest


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with scenes a, b and c (a video) in shoots/."""
    for name in ("a", "b"):
        (tmp_path / "here" / "shoots" / name).mkdir(parents=True)
        (tmp_path / "here" / "shoots" / name / "1.jpg").write_bytes(b"x")
    (tmp_path / "here" / "shoots" / "c.mp4").write_bytes(b"x")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    return tmp_path / "here"


def read(*given: object, over: Choice | None = None, roots: tuple[Path, ...] = ()) -> list[Scene]:
    scenes = read_manifest([str(each) for each in given], WORKFLOW, Path("fleet"), over=over, roots=roots)
    check_scenes(scenes)
    return scenes


def written(text: str, name: str = "fleet.toml") -> str:
    Path(name).write_text(text, encoding="utf-8")
    return name


def details(text: str, name: str = "fleet.toml") -> tuple[str, ...]:
    with pytest.raises(Mistakes) as caught:
        read(written(text, name))
    return caught.value.details or (str(caught.value).removeprefix(f"{name}: "),)


TOML = """
preset = "tiny"
seed = 5
train.iterations = 100  # for all

[scenes.chair]
source = "shoots/a"
bake.max_mib = 8

[scenes.table-2]
sources = [
  "shoots/b",
  "shoots/c.mp4",
]
preset = "preview"
as = "photographs"
budget = "10m"
[scenes.table-2.train]
iterations = 200
"""


def test_toml(place: Path) -> None:
    chair, table = read(written(TOML))
    assert (chair.name, chair.sources, chair.preset, chair.seed) == ("chair", (str(place / "shoots/a"),), "tiny", 5)
    assert chair.settings == {"train": {"iterations": 100}, "bake": {"max_mib": 8.0}}
    assert (table.preset, table.seed, table.sources) == ("preview", 5, (str(place / "shoots/b"), str(place / "shoots/c.mp4")))
    assert table.settings["train"]["iterations"] == 200
    assert table.settings["poses"] == {"format": "photographs"}
    assert table.settings["train"]["time_budget"] + table.settings["bake"]["time_budget"] == pytest.approx(600)


@pytest.mark.parametrize("separator", [",", ";", "\t"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_csv_says_the_same(place: Path, separator: str, mark: str) -> None:
    rows = [
        ("name", "source", "source", "preset", "seed", "train.iterations", "bake.max_mib", "as", "budget"),
        ("chair", "shoots/a", "", "tiny", "5", "100", "8", "", ""),
        ("", "", "", "", "", "", "", "", ""),
        ("table-2", "shoots/b", "shoots/c.mp4", "preview", "5", "200", "", "photographs", "10m"),
    ]
    assert read(written(mark + "\r\n".join(map(separator.join, rows)), "fleet.csv")) == read(written(TOML))


def test_the_command_line_is_over_the_manifest(place: Path) -> None:
    given = {"train": {"iterations": Text("7")}, "poses": {"allow_outside": Text("true")}}
    chair, table = read(written(TOML), over=Choice(given, preset="high", seed=9))
    assert chair.settings["poses"]["allow_outside"] is True
    for scene in (chair, table):
        assert (scene.preset, scene.seed, scene.settings["train"]["iterations"]) == ("high", 9, 7)
    assert chair.settings["bake"] == {"max_mib": 8.0}


def test_a_folder_of_folders_and_videos(place: Path) -> None:
    (place / "shoots" / ".git").mkdir()
    (place / "shoots" / "notes.txt").write_text("no scene")
    (place / "shoots" / "with space").mkdir()
    assert [(scene.name, Path(scene.sources[0]).name) for scene in read("shoots")] == [("a", "a"), ("b", "b"), ("c", "c.mp4"), ("with_space", "with space")]


def test_the_fleet_and_runs_in_the_folder_are_no_scenes(place: Path) -> None:
    (place / "shoots" / "out").mkdir()
    (place / "shoots" / "run").mkdir()
    (place / "shoots" / "run" / "run.json").write_text("{}")
    assert [scene.name for scene in read_manifest(["shoots"], WORKFLOW, place / "shoots" / "out")] == ["a", "b", "c"]


def test_globs_and_what_a_shell_makes_of_them(place: Path) -> None:
    assert [scene.name for scene in read("shoots/*/")] == ["a", "b"] == [scene.name for scene in read("shoots/a/", "shoots/b/")]
    assert [scene.name for scene in read("shoots/*")] == ["a", "b", "c"]
    for name in "ab":
        (place / "shoots" / name / "photos").mkdir()
    assert [scene.name for scene in read("shoots/*/photos/")] == ["a", "b"] == [scene.name for scene in read("shoots/a/photos", "shoots/b/photos")]
    assert [scene.name for scene in read("*/?")] == ["shoots-a", "shoots-b"]
    with pytest.raises(BadInput, match="fits nothing"):
        read("*/nothing*")


def test_one_scene_is_no_folder_of_scenes(place: Path) -> None:
    with pytest.raises(BadInput, match=r"is one scene \(photographs\)"):
        read("shoots/a")
    with pytest.raises(BadInput, match="One video is one scene"):
        read("shoots/c.mp4")
    with pytest.raises(BadInput, match="no such file"):
        read("nowhere")
    (place / "empty").mkdir()
    with pytest.raises(UsageError, match="holds no scenes"):
        read("empty")


def test_all_mistakes_at_once_with_their_lines(place: Path) -> None:
    text = """preset = "tinny"
trian.iterations = 5
[scenes.a]
source = "shoots/nothing"
train.iterations = "many"
[scenes.b]
bake.max_mb = 8
[scenes.A]
source = "shoots/a"
[scenes."../up"]
source = "shoots/a"
colour = "red"
[scenes.d]
sources = ["shoots/a", "shoots/a/../a"]
seed = 1.5
budget = "soon"
"""
    found = details(text)
    for line, scene, words in (
        (1, "", "no such preset"),
        (2, "", "Nearest: train"),
        (4, "a", "does not exist"),
        (5, "a", "train.iterations: found 'many'"),
        (6, "b", "found 0 sources"),
        (7, "b", "Nearest: bake.max_mib"),
        (8, "A", "expected another: it names a folder"),
        (10, "", "found the name '../up'"),
        (12, "../up", "found 'colour'"),
        (14, "d", "a source twice"),
        (15, "d", "expected a whole number"),
        (16, "d", "expected a time"),
    ):
        where = f"line {line}, scene {scene}: " if scene else f"line {line}: "
        assert any(each.startswith(where) and words in each for each in found), (where, words, found)
    assert len(found) == 12


def test_mistakes_of_a_csv(place: Path) -> None:
    found = details("name,source,train.iterations,colour\na,shoots/a,many,\nb,nowhere,,\nc,shoots/a,1,,5\n", "fleet.csv")
    assert [each.partition(":")[0] for each in found] == ["line 1", "line 2, scene a", "line 3, scene b", "line 4"]
    assert "name and source" in details("scene,path\na,b\n", "fleet.csv")[0]


@pytest.mark.parametrize("seed", ["-1", str(2**31), str(2**63), "9" * 400, "true", "'1'"])
def test_a_seed_that_no_run_takes_is_a_mistake_of_the_manifest(seed: str, enerf: Enerf, place: Path) -> None:
    """Nothing is run, and nothing of the fleet is written."""
    text = f"seed = 1\n[scenes.a]\nsource = 'shoots/a'\nseed = {seed}\n[scenes.b]\nsource = 'shoots/b'\n"
    (found,) = details(text)
    assert found.startswith("line 4, scene a: seed")
    assert enerf("fleet", written(text), "--out", "fleet").code == 2
    assert enerf("fleet", written(f"name,source,seed\na,shoots/a,{seed}\n", "fleet.csv"), "--out", "fleet").code == 2
    if seed.lstrip("-").isdigit():
        assert enerf("fleet", "shoots", "--out", "fleet", "--seed", seed).code == 2
    assert not Path("fleet").exists()


@pytest.mark.parametrize(
    ("settings", "options"),
    [
        ("train.field = 'nerf'", ()),
        ("train.near_plane = 2.0\ntrain.far_plane = 1.0", ()),
        ("train.near_plane = 2.0\ntrain.far_plane = 4.0", ("--set", "poses.space=contracted")),
        ("", ("--sweep", "train.field=hash,nerf")),
    ],
)
def test_settings_that_no_stage_can_work_with_are_mistakes_of_the_manifest(settings: str, options: tuple[str, ...], enerf: Enerf, place: Path) -> None:
    manifest = written(f"[scenes.a]\nsource = 'shoots/a'\n{settings}\n")
    told = enerf("fleet", manifest, "--out", "fleet", *options)
    assert told.code == 2
    assert "scene a" in told.err
    assert not Path("fleet").exists()


def test_mistakes_are_told_by_the_command_line(enerf: Enerf, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A line each, and in the JSON object."""

    def wrong(*_: object) -> None:
        raise Mistakes("fleet.toml: 2 mistakes; nothing was run:", ("line 1: one\x1b", "line 2: two"))

    monkeypatch.setattr("workflows.cli.presets.preset_names", wrong)
    told = enerf("presets", "--json")
    assert told.code == 2
    assert told.err == "enerf: fleet.toml: 2 mistakes; nothing was run:\n  line 1: one\\x1b\n  line 2: two\n"
    assert told.object["details"] == ["line 1: one\\x1b", "line 2: two"]


def test_sources_stay_in_the_manifests_folder(place: Path) -> None:
    (place / "link").symlink_to(place.parent / "elsewhere")
    for source in ("../elsewhere", str(place.parent / "elsewhere"), "link", "/"):
        (found,) = details(f"[scenes.a]\nsource = '{source}'\n")
        assert "leads out of" in found
        assert "--root" in found
    text = written("[scenes.a]\nsource = '../elsewhere'\n[scenes.b]\nsource = 'link'\n")
    assert len(read(text, roots=(place.parent / "elsewhere",))) == 2
    (place / "shoots" / "away").symlink_to(place.parent / "elsewhere")
    with pytest.raises(Mistakes, match="leads out of"):
        read("shoots")
    assert len(read("shoots/a", place.parent / "elsewhere")) == 2, "the operator named both"


@pytest.mark.parametrize("setting", ["allow_outside = true", *(f"{name} = '/net.onnx'" for name in ("mask_model", "features_model", "matcher_model"))])
def test_a_manifest_leads_nowhere_else(place: Path, setting: str) -> None:
    (found,) = details(f"[scenes.a]\nsource = 'shoots/a'\nposes.{setting}\n")
    assert f"on the command line alone (--set poses.{setting.split()[0]}=VALUE)" in found


def test_a_network_is_found_from_every_folder(place: Path) -> None:
    scene = written("[scenes.a]\nsource = 'shoots/a'\n")
    with pytest.raises(UsageError, match="absolute path"):
        read(scene, over=Choice({"poses": {"mask_model": Text("net.onnx")}}))
    (found,) = read(scene, over=Choice({"poses": {"mask_model": Text("/net.onnx")}}))
    assert found.settings["poses"]["mask_model"] == "/net.onnx"


def test_what_was_begun_may_have_lost_its_source(place: Path) -> None:
    text = written("[scenes.a]\nsource = 'shoots/gone'\n")
    with pytest.raises(Mistakes):
        read(text)
    (place / "fleet" / "a").mkdir(parents=True)
    (place / "fleet" / "a" / "run.json").write_text("{}")
    assert [scene.name for scene in read(text)] == ["a"]


HOSTILE = [
    b"",
    b"\xff\xfe",
    b"scenes = 5",
    b"[scenes]\na = 5",
    b"[scenes.a]\nsource = 5",
    b"[scenes.a]\nsource = []",
    b"[scenes.a]\nsources = [['x']]",
    b"[scenes.a]\nsource = 'x\\u0000'",
    b'[scenes.a]\nsource = "x\\u0000"',
    b"[scenes.a]\nsource = '" + b"x" * 10_000 + b"'",
    b"[scenes.'" + b"x" * 10_000 + b"']\nsource = 'shoots/a'",
    b"[scenes.'con/../..']\nsource = 'shoots/a'",
    b"[scenes.'index.html']\nsource = 'shoots/a'",
    b"[scenes.'a b']\nsource = 'shoots/a'",
    b"[scenes.a]\nsource = 'shoots/a'\nseed = " + b"9" * 5000,
    b"[scenes.a]\nsource = 'shoots/a'\ntrain.iterations = " + b"9" * 30,
    b"[scenes.a]\nsource = 'shoots/a'\ntrain = 5",
    b"[scenes.a]\nsource = 'shoots/a'\ntrain = []",
    b"[scenes.a]\nsource = 'shoots/a'\nx = " + b"[" * 5000,
    b"a." * 100_000 + b"b = 1",
    b"# " + b"x" * (MAX_BYTES + 1),
    b"[[scenes]]\nname = 'a'",
    b"[scenes.a]\nsource = 'shoots/a'\n[scenes.a]",
    b"\n".join(b"[scenes.s%d]\nsource = 'nowhere'" % n for n in range(2000)),
    b"x = '''\n" + b"\n" * 100_000 + b"'''\n[scenes.a]\nsource = 5",
]


@pytest.mark.parametrize("data", HOSTILE, ids=range(len(HOSTILE)))
def test_hostile_manifests_are_refused_in_words(place: Path, data: bytes) -> None:
    Path("fleet.toml").write_bytes(data)
    with pytest.raises(PipelineError) as caught:
        read("fleet.toml")
    assert caught.value.exit_code == 2
    assert len(str(caught.value)) < 2000
    assert all(len(each) < 2000 for each in getattr(caught.value, "details", ()))
    assert len(getattr(caught.value, "details", ())) <= 51


@pytest.mark.parametrize("data", [b"", b"\0", b"name,source\n" + b'"' * 9, b"name" + b",x" * 100_000, b"name,source\n" + b"x" * 200_000])
def test_hostile_tables_are_refused_in_words(place: Path, data: bytes) -> None:
    Path("fleet.csv").write_bytes(data)
    with pytest.raises(PipelineError) as caught:
        read("fleet.csv")
    assert caught.value.exit_code == 2


def test_a_pipe_is_no_manifest(place: Path) -> None:
    import os

    os.mkfifo("fleet.toml")
    with pytest.raises(UsageError, match="cannot be read"):
        read("fleet.toml")


def test_lines_are_where_keys_are_added() -> None:
    """Against another way: a key is in the first prefix of lines that is a document and has it."""
    text = TOML + 'x = """\n[no]\ny = 5\n"""\n"q.r" = {a = 1, b = {c = [\n1]}}\n'
    lines = text.splitlines()
    for path, line in lines_of(text).items():
        for end in itertools.count(line):
            try:
                with_it = tomllib.loads("\n".join(lines[:end]))
                break
            except tomllib.TOMLDecodeError:
                continue
        without = tomllib.loads("\n".join(lines[: line - 1]))
        assert _has(with_it, path), path
        assert not _has(without, path), path


def _has(value: object, path: tuple[str, ...]) -> bool:
    for name in path:
        if not isinstance(value, dict) or name not in value:
            return False
        value = value[name]
    return True


def test_absolute_sources_need_no_working_folder(place: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    shoots = place / "shoots"
    assert [scene.name for scene in read_manifest([str(shoots)], WORKFLOW, tmp_path / "fleet")] == ["a", "b", "c"]
    assert [scene.name for scene in read_manifest([str(shoots / "a"), str(shoots / "b")], WORKFLOW, tmp_path / "fleet")] == ["a", "b"]
    with pytest.raises(FileNotFoundError):
        read_manifest(["shoots/a", "shoots/b"], WORKFLOW, tmp_path / "fleet")
