"""Manifests of fleets: what they say, all their mistakes at once, and what hostile ones cannot do."""

from pathlib import Path

import pytest

from pipeline.errors import Mistakes, PipelineError, UsageError
from pipeline.fleet.state import Scene, check_scenes
from tests.workflows.command import Enerf
from workflows.asset import WORKFLOW
from workflows.fleet.checked import Choice, Text
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
    assert sum(table.settings[stage]["time_budget"] for stage in ("train", "bake", "splats")) == pytest.approx(600)


@pytest.mark.parametrize(("separator", "mark"), [(",", ""), (";", "\ufeff"), ("\t", "")])
def test_csv_says_the_same(place: Path, separator: str, mark: str) -> None:
    rows = [
        ("name", "source", "source", "preset", "seed", "train.iterations", "bake.max_mib", "as", "budget"),
        ("chair", "shoots/a", "", "tiny", "5", "100", "8", "", ""),
        ("", "", "", "", "", "", "", "", ""),
        ("table-2", "shoots/b", "shoots/c.mp4", "preview", "5", "200", "", "photographs", "10m"),
    ]
    assert read(written(mark + "\r\n".join(map(separator.join, rows)), "fleet.csv")) == read(written(TOML))


def test_a_folder_of_folders_and_videos(place: Path) -> None:
    """The fleet itself and runs in the folder are no scenes."""
    for name in (".git", "with space", "out", "run"):
        (place / "shoots" / name).mkdir()
    (place / "shoots" / "notes.txt").write_text("no scene")
    (place / "shoots" / "run" / "run.json").write_text("{}")
    scenes = read_manifest(["shoots"], WORKFLOW, place / "shoots" / "out")
    assert [(scene.name, Path(scene.sources[0]).name) for scene in scenes] == [("a", "a"), ("b", "b"), ("c", "c.mp4"), ("with_space", "with space")]


def test_globs_and_what_a_shell_makes_of_them(place: Path) -> None:
    assert [scene.name for scene in read("shoots/*/")] == ["a", "b"] == [scene.name for scene in read("shoots/a/", "shoots/b/")]
    assert [scene.name for scene in read("shoots/*")] == ["a", "b", "c"]
    for name in "ab":
        (place / "shoots" / name / "photos").mkdir()
    assert [scene.name for scene in read("shoots/*/photos/")] == ["a", "b"] == [scene.name for scene in read("shoots/a/photos", "shoots/b/photos")]
    assert [scene.name for scene in read("*/?")] == ["shoots-a", "shoots-b"]


def test_all_mistakes_at_once_with_their_scenes(place: Path) -> None:
    """Of a CSV with their lines, too."""
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
    for scene, named in (
        ("", "preset"), ("", "train"), ("a", "shoots/nothing"), ("a", "train.iterations"), ("b", "source"), ("b", "bake.max_mib"), ("A", "name"), ("", "../up"),
        ("../up", "colour"), ("d", "source"), ("d", "seed"), ("d", "budget"),
    ):  # fmt: skip
        where = f"scene {scene}: " if scene else ""
        assert any(each.startswith(where) and named in each for each in found), (where, named, found)
    assert len(found) == 12
    found = details("name,source,train.iterations,colour\na,shoots/a,many,\nb,nowhere,,\nc,shoots/a,1,,5\n", "fleet.csv")
    assert [each.partition(":")[0] for each in found] == ["line 1", "line 2, scene a", "line 3, scene b", "line 4"]


@pytest.mark.parametrize("seed", ["-1", str(2**31), "9" * 400, "true", "'1'"])
def test_a_seed_that_no_run_takes_is_a_mistake_of_the_manifest(seed: str, enerf: Enerf, place: Path) -> None:
    """Nothing is run, and nothing of the fleet is written."""
    text = f"seed = 1\n[scenes.a]\nsource = 'shoots/a'\nseed = {seed}\n[scenes.b]\nsource = 'shoots/b'\n"
    (found,) = details(text)
    assert found.startswith("scene a: seed")
    calls = [[written(text)], [written(f"name,source,seed\na,shoots/a,{seed}\n", "fleet.csv")], *([["shoots", "--seed", seed]] if seed[-1].isdigit() else [])]
    for call in calls:
        assert enerf("fleet", *call, "--out", "fleet").code == 2
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


def test_sources_stay_in_the_manifests_folder(place: Path) -> None:
    (place / "link").symlink_to(place.parent / "elsewhere")
    for source in ("../elsewhere", str(place.parent / "elsewhere"), "link", "/"):
        (found,) = details(f"[scenes.a]\nsource = '{source}'\n")
        assert "--root" in found
    text = written("[scenes.a]\nsource = '../elsewhere'\n[scenes.b]\nsource = 'link'\n")
    assert len(read(text, roots=(place.parent / "elsewhere",))) == 2
    (place / "shoots" / "away").symlink_to(place.parent / "elsewhere")
    with pytest.raises(Mistakes, match="away"):
        read("shoots")
    assert len(read("shoots/a", place.parent / "elsewhere")) == 2, "the operator named both"
    text = written("[scenes.a]\nsource = 'shoots/gone'\n")
    with pytest.raises(Mistakes):
        read(text)
    (place / "fleet" / "a").mkdir(parents=True)
    (place / "fleet" / "a" / "run.json").write_text("{}")
    assert [scene.name for scene in read(text)] == ["a"], "what was begun may have lost its source"


@pytest.mark.parametrize("setting", ["allow_outside = true", *(f"{name} = '/net.onnx'" for name in ("mask_model", "features_model", "matcher_model"))])
def test_a_manifest_leads_nowhere_else(place: Path, setting: str) -> None:
    (found,) = details(f"[scenes.a]\nsource = 'shoots/a'\nposes.{setting}\n")
    assert f"--set poses.{setting.split()[0]}=VALUE" in found
    if "mask_model" in setting:  # on the command line, by a path that every folder finds
        scene = written("[scenes.a]\nsource = 'shoots/a'\n")
        with pytest.raises(UsageError):
            read(scene, over=Choice({"poses": {"mask_model": Text("net.onnx")}}))
        assert read(scene, over=Choice({"poses": {"mask_model": Text("/net.onnx")}}))[0].settings["poses"]["mask_model"] == "/net.onnx"


ONE = b"[scenes.a]\nsource = 'shoots/a'\n"
HOSTILE = [
    b"",
    b"\xff\xfe",
    b"scenes = 5",
    b"[scenes]\na = 5",
    b"[scenes.a]\nsource = 5",
    b"[scenes.a]\nsource = []",
    b"[scenes.a]\nsources = [['x']]",
    b'[scenes.a]\nsource = "x\\u0000"',
    b"[scenes.a]\nsource = '" + b"x" * 10_000 + b"'",
    b"[scenes.'" + b"x" * 10_000 + b"']\nsource = 'shoots/a'",
    b"[scenes.'con/../..']\nsource = 'shoots/a'",
    b"[scenes.'index.html']\nsource = 'shoots/a'",
    b"[scenes.'a b']\nsource = 'shoots/a'",
    ONE + b"seed = " + b"9" * 5000,
    *(ONE + key + b" = 0x" + b"f" * 6000 for key in (b"seed", b"preset", b"train.iterations")),  # Python writes out no number so long
    b"[scenes]\na = 0x" + b"f" * 6000,
    ONE + b"train = []",
    ONE + b"x = " + b"[" * 5000,
    ONE + b"[scenes.a]",
    b"a." * 100_000 + b"b = 1",
    b"# " + b"x" * (MAX_BYTES + 1),
    b"[[scenes]]\nname = 'a'",
    b"\n".join(b"[scenes.s%d]\nsource = 'nowhere'" % n for n in range(2000)),
    b"x = '''\n" + b"\n" * 100_000 + b"'''\n[scenes.a]\nsource = 5",
]
TABLES = [b"", b"\0", b"scene,path\na,b\n", b"name,source\n" + b'"' * 9, b"name" + b",x" * 100_000, b"name,source\n" + b"x" * 200_000]


@pytest.mark.parametrize(("name", "data"), [*(("fleet.toml", data) for data in HOSTILE), *(("fleet.csv", data) for data in TABLES)], ids=range(32))
def test_hostile_manifests_are_refused_in_words(place: Path, name: str, data: bytes) -> None:
    Path(name).write_bytes(data)
    with pytest.raises(PipelineError) as caught:
        read(name)
    assert caught.value.exit_code == 2
    assert len(str(caught.value)) < 2000
    assert all(len(each) < 2000 for each in getattr(caught.value, "details", ()))
    assert len(getattr(caught.value, "details", ())) <= 51
