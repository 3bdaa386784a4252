"""Every command with every kind of hostile argument: a documented exit code, one or two lines, no traceback, and no hang."""

import json
import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

import pytest

from efficientnerf.asset.format import save
from tests.efficientnerf.trees import random_tree
from tests.workflows.command import Enerf, Result

SECONDS = 10


def other_folder(path: Path) -> None:
    path.mkdir()
    (path / "notes.md").write_text("mine", encoding="utf-8")


def folder_of_pipes(path: Path) -> None:
    path.mkdir()
    for name in ("run.json", "transforms.json", "a.png", "asset.nerftree", "scene.json", "poses_bounds.npy"):
        os.mkfifo(path / name)


def below_a_file(path: Path) -> Path:
    path.write_text("mine", encoding="utf-8")
    return path / "below"


# What is made at a path; the argument is what is returned, or the path.
KINDS: dict[str, Callable[[Path], object]] = {
    "missing": lambda path: path,
    "missing_below": lambda path: path / "a/b",
    "pipe": os.mkfifo,
    "endless_device": lambda path: "/dev/zero",
    "link_to_a_device": lambda path: path.symlink_to("/dev/zero"),
    "link_to_itself": lambda path: path.symlink_to(path),
    "empty_folder": os.mkdir,
    "other_folder": other_folder,
    "folder_of_pipes": folder_of_pipes,
    "empty_file": Path.touch,
    "other_file": lambda path: path.write_bytes(b"\x93NUMPY\xff\0\n" * 50) and None,
    "below_a_file": below_a_file,
    "nul": lambda path: f"{path}\0x",
    "long_name": lambda path: path / ("x" * 4096),
    "long_path": lambda path: path.joinpath(*["y" * 200] * 40),
    "odd_name": lambda path: path.with_name(f"a\nb\x1b[31m\u202e\udcff{path.suffix}"),
}

# Where the argument goes; ASSET, SOURCE and NEW are what is sound. Next to it what a missing file, or an empty folder, means: nothing is wrong with it.
COMMANDS: dict[str, tuple[list[str], str, set[str]]] = {
    "run SOURCE": (["run", "X", "--out", "NEW"], "", {"other_folder", "folder_of_pipes"}),  # the toys take any folder
    "run --out": (["run", "SOURCE", "--out", "X"], "", {"missing", "missing_below", "empty_folder", "odd_name"}),
    "run --config": (["run", "SOURCE", "--out", "NEW", "--config", "X"], ".toml", {"empty_file"}),
    "stage": (["stage", "train", "X"], "", set()),
    "status": (["status", "X"], "", set()),
    "verify": (["verify", "X"], "", set()),
    "verify asset": (["verify", "X"], ".nerftree", set()),
    "report": (["report", "X"], "", set()),
    "measure": (["measure", "X", "0,0,0", "1,1,1"], "", set()),
    "orient": (["orient", "X", "0,0,0", "1,0,0", "0,1,0"], "", set()),
    "inspect": (["inspect", "X"], "", {"folder_of_pipes"}),
    "inspect asset": (["inspect", "X"], ".nerftree", {"folder_of_pipes"}),
    "inspect mesh": (["inspect", "X"], ".ply", {"folder_of_pipes"}),
    "inspect document": (["inspect", "X"], ".json", {"folder_of_pipes"}),
    "export RUN": (["export", "X", "--to", "NEW.ply"], ".nerftree", set()),
    "export RUN cameras": (["export", "X", "--to", "NEW.json"], "", set()),
    "export --to": (["export", "ASSET", "--to", "X"], ".ply", {"missing", "odd_name"}),
    "convert RUN": (["convert", "X", "NEW.nerftree"], ".nerftree", set()),
    "convert OUT": (["convert", "ASSET", "X"], ".nerftree", {"missing", "odd_name"}),
    "diff A": (["diff", "X", "ASSET", "--views", "0"], ".nerftree", set()),
    "diff B": (["diff", "ASSET", "X", "--views", "0"], ".nerftree", set()),
    "render RUN": (["render", "X", "--out", "NEW"], ".nerftree", set()),
    "render --out": (["render", "ASSET", "--frames", "1", "--width", "16", "--height", "16", "--out", "X"], "", {"missing", "missing_below", "empty_folder",
                     "other_folder", "folder_of_pipes", "odd_name"}),
    "render --path": (["render", "ASSET", "--out", "NEW", "--path", "X"], ".json", set()),
    "render --video": (["render", "ASSET", "--frames", "1", "--width", "16", "--height", "16", "--out", "NEW", "--video", "X"], ".mp4",
                       {"missing", "odd_name"}),
    "presets": (["presets", "X"], "", set()),
    "presets --preset": (["presets", "--preset", "X"], "", set()),
    "run --preset": (["run", "SOURCE", "--out", "NEW", "--preset", "X"], "", set()),
    "run --until": (["run", "SOURCE", "--out", "NEW", "--until", "X"], "", set()),
    "stage NAME": (["stage", "X", "NEW"], "", set()),
}  # fmt: skip


@pytest.fixture(autouse=True)
def patience() -> Iterator[None]:
    """A test that hangs fails."""

    def over(number: int, frame: FrameType | None) -> None:
        raise AssertionError(f"nothing within {SECONDS} s")

    former = signal.signal(signal.SIGALRM, over)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, former)


@pytest.fixture(scope="module")
def asset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("asset") / "asset.nerftree"
    save(random_tree(3, shape=(3, 3, 3), brick=4, degree=0, sigma=60.0), path)
    return path


def called(enerf: Enerf, arguments: list[str]) -> Result:
    signal.alarm(SECONDS)
    result = enerf(*arguments)
    signal.alarm(0)
    shown = result.err + ("" if "--json" in arguments else result.out)
    assert "Traceback" not in shown
    for character in "\x1b\u202e\udcff":
        assert character not in shown
    return result


def check_failure(result: Result, codes: set[int], *, as_json: bool) -> None:
    assert result.code in codes, result
    lines = [line for line in result.err.splitlines() if line.startswith("enerf: ")]
    assert len(lines) == 1, result.err
    assert "internal error" not in lines[0]
    assert len(lines[0]) < 4200
    if as_json:
        last = result.objects[-1]
        assert (last["ok"], last["exit_code"]) == (False, result.code)


@pytest.mark.parametrize("command", COMMANDS)
def test_hostile_paths(enerf: Enerf, toys: Path, tmp_path: Path, asset: Path, command: str) -> None:
    arguments, suffix, sound = COMMANDS[command]
    for number, (name, make) in enumerate(KINDS.items()):
        place = tmp_path / str(number)
        place.mkdir()
        path = str(make(place / f"x{suffix}") or place / f"x{suffix}")
        named = {"X": path, "ASSET": str(asset), "SOURCE": str(toys), **{f"NEW{end}": str(place / f"new{end}") for end in ("", ".ply", ".json", ".nerftree")}}
        as_json = bool(number % 2)
        given = [named.get(argument, argument) for argument in arguments] + ["--json"] * as_json
        result = called(enerf, given)
        if result.code == 0 and name in sound:
            continue
        check_failure(result, {2, 4}, as_json=as_json)


DEEP = "[" * 3000 + "]" * 3000
VALUES = {
    "400 digits": "9" * 400, "minus": "-" + "9" * 400, "hexadecimal": "0x" + "f" * 9000, "not a number": "nan", "large float": "1e999", "deep list": DEEP,
    "deep table": "{a=" * 500 + "1" + "}" * 500, "dots": "{" + ".".join("a" for _ in range(30_000)) + "=1}", "escapes": "\x1b[31m\u202e\n\udcff",
    "nothing": "", "list": "[1, [2, [3]]]", "date": "1979-05-27", "broken": '"', "long": "x" * 100_000, "nul": "\0",
}  # fmt: skip


@pytest.mark.parametrize("name", VALUES)
def test_hostile_values(enerf: Enerf, toys: Path, tmp_path: Path, name: str) -> None:
    value = VALUES[name]
    for number, arguments in enumerate(
        (
            ["--set", f"train.iterations={value}"], ["--set", f"train.rate={value}"], ["--set", f"train.fail={value}!"], ["--set", value or "="],
            ["--set", f"train.{value or '='}=1"], ["--seed", value], ["--budget", value], ["--device", value], ["--as", value or "?"],
            ["--preset", value or "?"], ["--until", value or "?"], ["--from", value or "?"], ["--memory", value or "?"],
        )
    ):  # fmt: skip
        as_json = bool(number % 2)
        result = called(enerf, ["run", str(toys), "--out", str(tmp_path / "run"), *arguments, *["--json"] * as_json])
        check_failure(result, {2}, as_json=as_json)
        assert not (tmp_path / "run").exists()


CONFIGS: dict[str, str | bytes] = {
    "400 digits": f"[train]\niterations = {'9' * 400}", "5000 digits": f"seed = {'9' * 5000}", "a large seed": f"seed = {2**64}",
    "hexadecimal": f"seed = 0x{'f' * 9000}", "not a number": "[train]\nrate = nan", "infinite": "[train]\nrate = -inf", "deep": f"a = {DEEP}",
    "deep setting": f"[train]\nrate = {'[' * 100}{']' * 100}", "a list": "train = [1]", "tables": "[[train]]\nrate = 1",
    "a list as preset": "preset = []", "a table as device": "[device]", "an unknown device": 'device = "tpu"', "a flag as seed": "seed = true",
    "dots": ".".join("a" for _ in range(30_000)) + " = 1", "large": "#" * 70_000 + "\n", "binary": "\0\1\2",
    "a key with escapes": '[train]\n"\\u001b[31m\\n" = 1', "a stage with escapes": '["\\u001b[31m\\n"]\na = 1', "a surrogate": 'a = "\\ud800"',
    "deeper tables": "train = " + "{a = " * 5000 + "1" + "}" * 5000, "no text": b"\xff\xfe", "much that is no text": b"\xc3" * 70_000,
}  # fmt: skip


@pytest.mark.parametrize("name", CONFIGS)
def test_hostile_configurations(enerf: Enerf, toys: Path, tmp_path: Path, name: str) -> None:
    path, content = tmp_path / "odd.toml", CONFIGS[name]
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    result = called(enerf, ["run", str(toys), "--out", str(tmp_path / "run"), "--config", str(path), "--json"])
    check_failure(result, {2}, as_json=True)
    assert not (tmp_path / "run").exists()


METADATA = {
    "names of facts": {"bytes": "many", "voxels": [], "cameras": [{}], "warnings": 3, "format_version": {}, "layout": "x", "resolution": None},
    "escapes": {"licence": "\x1b[31m\u202e\n", "\x1b]0;x\x07": 1},
    "large numbers": {"many": 10**400, "more": [-(10**300)], "sixty-four bits": 2**64},
    "deep": {"deep": json.loads("[" * 60 + "]" * 60)},
    "surrogates": {"licence": "\ud800"},
}


@pytest.mark.parametrize("name", METADATA)
def test_metadata_of_a_stranger_are_described(enerf: Enerf, tmp_path: Path, asset: Path, name: str) -> None:
    path, other = tmp_path / "odd.nerftree", tmp_path / "other.nerftree"
    data = asset.read_bytes()
    length = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + length])
    text = header["__metadata__"]
    key = next(key for key, value in text.items() if '"format"' in value)
    text[key] = json.dumps({**METADATA[name], **json.loads(text[key])})
    written = json.dumps(header).encode("ascii")
    written += b" " * (-len(written) % 8)
    path.write_bytes(len(written).to_bytes(8, "little") + written + data[8 + length :])
    for arguments in (["inspect", str(path)], ["inspect", str(path), "--json"], ["verify", str(path)], ["verify", str(path), "--json"],
                      ["diff", str(path), str(asset), "--views", "0"], ["convert", str(path), str(other), "--force"], ["inspect", str(other)]):  # fmt: skip
        result = called(enerf, arguments)
        if result.code not in (0, 6):
            check_failure(result, {2, 4}, as_json="--json" in arguments)
        elif "--json" in arguments:
            assert result.out.isascii()
            json.loads(result.out.splitlines()[-1] if arguments[0] == "verify" else result.out)


def test_pipes_among_photographs_are_not_waited_for(tmp_path: Path) -> None:
    from stages.sfm.images import prepare_images

    names = ["a.png", "b.png"]
    for name in (*names, "mask.png"):
        os.mkfifo(tmp_path / name)
    (tmp_path / "work").mkdir()
    signal.alarm(SECONDS)
    images, rejected = prepare_images(
        {name: tmp_path / name for name in names}, max_side=64, features=100, seed=0, masks={"a.png": tmp_path / "mask.png"}, work=tmp_path / "work",
        progress=lambda *_: None, safe_point=lambda: None, warn=lambda *_, **__: None,
    )  # fmt: skip
    assert images == []
    assert [name for name, _ in rejected] == names
