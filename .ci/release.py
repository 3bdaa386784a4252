"""Build a release and try it as strangers install it; `make release`. Nothing is uploaded before `make publish`.

    python .ci/release.py [--pythons 3.11,3.12,3.13,3.14] [--quick | --publish]

In dist/: the sdist, the wheel, `contents.txt` (each file of both) and `licences.txt` (what a plain install brings: version, licence, size).
Then, in an empty environment for each Python that this machine has, and with `uv tool install` and `pipx`: the wheel is installed, `enerf --version`
answers, and the sample becomes an asset with the preset `tiny`. --quick leaves out all that installs. --publish uploads what is in
dist/, if the version of pyproject.toml is that of CHANGELOG.md, CITATION.cff and the tag. Needs build, twine, uv and pipx.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tarfile
import time
import tomllib
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DIST, WORK = ROOT / "dist", ROOT / "build" / "release"
PYTHONS = "3.11,3.12,3.13,3.14"
BIN = "Scripts" if os.name == "nt" else "bin"
TORCH = "torch==2.13.0"  # as constraints.txt has it
LICENCES = """
import json
from importlib.metadata import distributions
rows = []
for each in distributions():
    meta = each.metadata
    known = [c.rpartition(" :: ")[2] for c in meta.get_all("Classifier") or () if c.startswith("License ::")]
    text = meta["License-Expression"] or ", ".join(known) or (meta["License"] or "").partition("\\n")[0]
    size = sum(f.stat().st_size for f in map(each.locate_file, each.files or ()) if f.is_file())
    rows.append((meta["Name"], each.version, text, size))
print(json.dumps(sorted(rows, key=lambda row: row[0].lower())))
"""


def call(*command: object, **environment: str) -> str:
    """Standard output of a program in an empty folder, none of this checkout's modules in its path. Ends this one where that one fails."""
    away = WORK / "away"
    away.mkdir(parents=True, exist_ok=True)
    inherited = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV", "PIP_CONSTRAINT", "UV_CONSTRAINT")}
    done = subprocess.run([str(part) for part in command], cwd=away, env=inherited | environment, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"release: {' '.join(map(str, command))} ended with {done.returncode}:\n{done.stdout[-4000:]}{done.stderr[-4000:]}")
    return done.stdout


def megabytes(folder: Path) -> float:
    return sum(path.lstat().st_size for path in folder.rglob("*") if not path.is_dir()) / 1e6


def stated_version() -> str:
    version: str = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    return version


def disagreements(version: str) -> list[str]:
    """What CHANGELOG.md and CITATION.cff say that differs from the version of pyproject.toml."""
    changes, citation = ((ROOT / name).read_text(encoding="utf-8") for name in ("CHANGELOG.md", "CITATION.cff"))
    dated = re.search(rf"^## \[{re.escape(version)}\] - (\d{{4}}-\d\d-\d\d)$", changes, re.MULTILINE)
    cited = dict(re.findall(r"^(version|date-released): (\S+)$", citation, re.MULTILINE))
    found = [] if dated else [f"CHANGELOG.md has no dated section [{version}]"]
    if cited.get("version") != version:
        found.append(f"CITATION.cff has the version {cited.get('version')}")
    if dated and cited.get("date-released") != dated[1]:
        found.append(f"CITATION.cff has the date {cited.get('date-released')}, CHANGELOG.md {dated[1]}")
    return found


def obstacles(version: str) -> list[str]:
    """Why a version cannot be published now: disagreements, and changes that no version has yet."""
    newest = re.split(r"^## ", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), flags=re.MULTILINE)[1]
    unreleased = newest.startswith("[Unreleased]") and "".join(newest.splitlines()[1:]).strip()
    return [*disagreements(version), *(["CHANGELOG.md has unreleased changes"] if unreleased else [])]


def publish() -> None:
    """Upload; asks for a token unless TWINE_PASSWORD has it."""
    version = stated_version()
    files = [*DIST.glob(f"efficientnerf-{version}*.whl"), *DIST.glob(f"efficientnerf-{version}.tar.gz")]
    reasons = obstacles(version)
    if f"v{version}" not in call("git", "-C", ROOT, "tag", "--points-at", "HEAD").split():
        reasons.append(f"this commit has no tag v{version}")
    if len(files) != 2:
        reasons.append(f"dist/ has no build of {version}; run make release")
    if reasons:
        sys.exit(f"release: {version} is not published: {'; '.join(reasons)}.")
    subprocess.run([sys.executable, "-m", "twine", "upload", *files], check=True)


def build() -> Path:
    """The wheel; it and the sdist files checked and listed."""
    shutil.rmtree(DIST, ignore_errors=True)
    shutil.rmtree(ROOT / "build" / "lib", ignore_errors=True)  # files that are gone since an earlier build would be packed
    call(sys.executable, "-m", "build", "--outdir", DIST, ROOT)
    (sdist,), (wheel,) = DIST.glob("*.tar.gz"), DIST.glob("*.whl")
    call(sys.executable, "-m", "twine", "check", "--strict", sdist, wheel)
    with tarfile.open(sdist) as archive:
        held = [(member.size, member.name) for member in archive.getmembers() if member.isfile()]
    held += [(member.file_size, f"{wheel.name}/{member.filename}") for member in zipfile.ZipFile(wheel).infolist()]
    (DIST / "contents.txt").write_text("".join(f"{size:9d}  {name}\n" for size, name in held), encoding="utf-8")
    print(f"{wheel.name} {wheel.stat().st_size / 1e6:.2f} MB, {sdist.name} {sdist.stat().st_size / 1e6:.2f} MB, {len(held)} files")
    return wheel


def tiny(enerf: Path, out: Path) -> None:
    """What a stranger does first: no kernel is compiled yet."""
    version = call(enerf, "--version").split()[-1]
    began = time.monotonic()
    for folder in (out, WORK / "cache"):
        shutil.rmtree(folder, ignore_errors=True)
    call(enerf, "run", ROOT / "examples" / "still_life", "--preset", "tiny", "--out", out, ENERF_CACHE_DIR=str(WORK / "cache"))
    size = (out / "bake" / "asset.nerftree").stat().st_size / 1e6
    print(f"    enerf {version}: the sample in {(time.monotonic() - began) / 60:.1f} min, an asset of {size:.2f} MB", flush=True)


def in_environment(python: str, wheel: Path) -> None:
    """Install into an empty environment, and list what came with it."""
    place = WORK / python
    call("uv", "venv", "--clear", "--quiet", "--python", python, place)
    began = time.monotonic()
    call("uv", "pip", "install", "--quiet", "--link-mode", "copy", "--python", place, "--constraint", WORK / "constraints.txt", wheel)
    minutes = (time.monotonic() - began) / 60
    print(f"{python}: {megabytes(place):.0f} MB installed in {minutes:.1f} min", flush=True)
    rows = json.loads(call(place / BIN / "python", "-c", LICENCES))
    (DIST / "licences.txt").write_text("".join(f"{name} {version}: {text or 'UNKNOWN'} ({size / 1e6:.1f} MB)\n" for name, version, text, size in rows))
    tiny(place / BIN / "enerf", WORK / f"run-{python}")
    shutil.rmtree(place)


def as_tool(wheel: Path) -> None:
    """By the two installers of programs; the environments are this script's own."""
    home, constraints = WORK / "tools", WORK / "constraints.txt"
    shutil.rmtree(home, ignore_errors=True)
    for name, command in {
        "uv tool install": ["uv", "tool", "install", "--quiet", "--python", sys.executable, "--constraint", constraints, wheel],
        "pipx install": [sys.executable, "-m", "pipx", "install", "--quiet", "--python", sys.executable, f"--pip-args=-c {constraints}", wheel],
    }.items():
        began = time.monotonic()
        call(*command, UV_TOOL_DIR=str(home / "uv"), UV_TOOL_BIN_DIR=str(home / "bin"), PIPX_HOME=str(home / "pipx"), PIPX_BIN_DIR=str(home / "bin"))
        print(f"{name}: {call(home / 'bin' / 'enerf', '--version').strip()} after {(time.monotonic() - began) / 60:.1f} min", flush=True)
        shutil.rmtree(home)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--pythons", default=PYTHONS)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--publish", action="store_true")
    chosen = parser.parse_args()
    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    WORK.mkdir(parents=True, exist_ok=True)
    (WORK / "constraints.txt").write_text(f"{TORCH}\n")
    if chosen.publish:
        publish()
        return
    wheel, version = build(), stated_version()
    if not chosen.quick:
        wanted = chosen.pythons.split(",")
        there = [each for each in wanted if subprocess.run(["uv", "python", "find", each], capture_output=True, check=False).returncode == 0]
        for python in there:
            in_environment(python, wheel)
        if absent := sorted({*wanted} - {*there}):
            print(f"not tried: Python {', '.join(absent)}, which this machine does not have")
        as_tool(wheel)
    if reasons := obstacles(version):
        print(f"{version} is not ready to be published: {'; '.join(reasons)}.")
    else:
        print(f"ready: git tag v{version} && git push origin v{version} && make publish")


if __name__ == "__main__":
    main()
