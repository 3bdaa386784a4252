"""`enerf doctor` and `enerf cache`."""

import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import click

from efficientnerf.backends import kernel_cache
from pipeline.errors import PipelineError
from pipeline.executors.cores import cores
from pipeline.executors.memory import available_now, usable_memory
from pipeline.manifest import DISTRIBUTION, requirements, version_of
from pipeline.text import printable
from workflows.cli.device import cuda_device_count, torch_has_cuda
from workflows.cli.options import common_options, json_option
from workflows.cli.output import closing, listing, write_json
from workflows.cli.progress import size

EXTRAS = {  # of pyproject.toml
    "usd": "export to USDZ and USDC",
    "raw": "cameras' raw pictures",
    "las": "export to LAS and LAZ",
    "rembg": "masks by a network of yours",
    "lpips": "LPIPS in metrics",
    "fleet": "fleets on several machines",
}
INSTRUCTIONS = ("avx512f", "avx2", "fma", "avx512_bf16", "asimd", "sve", "bf16")  # that speed depends on, as Linux names them
FAILED = 3  # exit code


class SelfTestFailed(PipelineError):
    """The self-test ended with an error."""

    exit_code = FAILED


@click.command()
@click.option("--seconds", type=click.IntRange(0), default=30, show_default=True, help="Most time for the self-test; 0 leaves it out.")
@json_option
@common_options
def doctor(seconds: int, as_json: bool) -> None:
    """Show what is installed, the machine, caches and optional parts, and test it on a small scene: what a bug report needs.

    The exit code is 3 if the self-test fails.
    """
    packages = {name: version_of(name) for name, extra in requirements() if not extra}
    found = {**_machine(), "packages": packages, "caches": caches(), "optional": _optional()}
    found["self_test"] = _self_test(seconds)
    if as_json:
        write_json(found | {"exit_code": FAILED if found["self_test"]["state"] == "failed" else 0}, indent=1)
    else:
        _list(found)
    if found["self_test"]["state"] == "failed":
        raise SelfTestFailed(f"the self-test failed: {found['self_test']['reason']}")


@click.command()
@click.option("--clear", is_flag=True, help="Remove what is kept. It is made again when it is needed.")
@json_option
@common_options
def cache(clear: bool, as_json: bool) -> None:
    """Show where compiled kernels and features of photographs are kept, and their sizes."""
    found = caches()
    if clear:
        for each in found:
            for place in _kept(Path(each["path"])):
                shutil.rmtree(place, ignore_errors=True)
    if as_json:
        write_json({"caches": caches(), "freed": sum(each["bytes"] for each in found) - sum(each["bytes"] for each in caches())}, indent=1)
    elif clear:
        closing(f"{size(sum(each['bytes'] for each in found))} removed")
    else:
        listing(*map(_cache_line, found))


def caches() -> list[dict[str, Any]]:
    """What is kept, where, and how many bytes; folders that do not exist are left out. The key that signs pages stays: without it they lose their signature."""
    places = [("compiled kernels", root) for root in kernel_cache.roots()] + [("features", kernel_cache.cache_folder() / "features")]
    return [{"what": what, "path": str(root), "bytes": sum(map(_bytes_below, _kept(root)))} for what, root in places if root.is_dir()]


def _kept(root: Path) -> list[Path]:
    """The folders of keys, which alone are this program's for certain: the user chooses the folder above."""
    return [place for place in root.glob("*") if re.fullmatch(r"[0-9a-f]{16}", place.name) and place.is_dir() and not place.is_symlink()]


def _bytes_below(folder: Path) -> int:
    return sum((Path(above) / name).lstat().st_size for above, _, names in os.walk(folder) for name in names)


def _machine() -> dict[str, Any]:
    cpuinfo = Path("/proc/cpuinfo")
    text = cpuinfo.read_text(encoding="utf-8", errors="replace") if cpuinfo.is_file() else ""
    lines = dict(re.findall(r"^(model name|flags|Features)\s*: (.*)$", text, re.MULTILINE))
    limit, devices = usable_memory(), cuda_device_count()
    return {
        "enerf": version_of(DISTRIBUTION),
        "python": platform.python_version(),
        "system": platform.platform(),
        "processor": lines.get("model name") or platform.processor() or platform.machine(),
        "instructions": [name for name in INSTRUCTIONS if name in f"{lines.get('flags', '')} {lines.get('Features', '')}".split()],
        "cores": cores(),
        "memory": None if limit is None else limit.bytes,
        "memory_limit_of": None if limit is None else limit.whose,
        "memory_available": available_now(),
        "disk_free": shutil.disk_usage(Path.cwd()).free,
        "cuda_devices": devices,
        "device": "cuda" if devices and torch_has_cuda() else "cpu",
        "environment": {name: value for name, value in sorted(os.environ.items()) if re.match(r"ENERF_|OMP_|NUMBA_|CUDA_VISIBLE", name)},
    }


def _optional() -> list[dict[str, Any]]:
    needed = {extra: [name for name, of in requirements() if of == extra] for extra in EXTRAS}
    return [
        {"extra": extra, "for": purpose, "installed": all(map(version_of, needed[extra])), "get": f"pip install 'efficientnerf[{extra}]'"}
        for extra, purpose in EXTRAS.items()
    ]


def _self_test(seconds: int) -> dict[str, Any]:
    """Cameras, training and baking of a small made scene in a process of its own: whether it passed, or why not."""
    if not seconds:
        return {"state": "left out", "seconds": 0.0, "reason": "--seconds 0"}
    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="efficientnerf-", ignore_cleanup_errors=True) as folder:
        command = [sys.executable, "-m", "workflows.inspection.self_test", folder]
        try:
            done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, text=True, errors="replace", timeout=seconds, check=False)
        except subprocess.TimeoutExpired:
            compiled = kernel_cache.are_compiled()
            why = "the machine is slow or busy" if compiled else "kernels are not compiled yet, which takes minutes once"
            return {"state": "not finished", "seconds": float(seconds), "reason": f"{why}; --seconds 600 waits"}
    took = round(time.monotonic() - began, 1)
    if done.returncode == 0:
        return {"state": "passed", "seconds": took, "reason": ""}
    return {"state": "failed", "seconds": took, "reason": printable((done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1], 500)}


def _cache_line(each: dict[str, Any]) -> str:
    return f"{each['what']:<18}{size(each['bytes']):>8}  {_without_home(each['path'])}"


def _without_home(path: str) -> str:
    """Bug reports are public, and home folders have people's names."""
    home = os.path.expanduser("~")
    return f"~{path.removeprefix(home)}" if path.startswith(home + os.sep) else path


def _list(found: dict[str, Any]) -> None:
    memory = "no limit known" if found["memory"] is None else f"{size(found['memory'])} by {found['memory_limit_of']}"
    available = "" if found["memory_available"] is None else f", {size(found['memory_available'])} available"
    listing(
        f"enerf {found['enerf']}, Python {found['python']}, {found['system']}",
        f"{found['processor']} ({' '.join(found['instructions'])}), {found['cores']} cores; {found['cuda_devices']} CUDA devices",
        f"memory {memory}{available}; {size(found['disk_free'])} free here; computes on {found['device']}",
        *(f"{name}={_without_home(value)}" for name, value in found["environment"].items()),
        ", ".join(f"{name} {found or 'MISSING'}" for name, found in found["packages"].items()),
        *map(_cache_line, found["caches"]),
        *(f"{each['for']:<30}{'yes' if each['installed'] else 'no: ' + each['get']}" for each in found["optional"]),
    )
    test = found["self_test"]
    listing(f"self-test: {test['state']}, {test['seconds']:.0f} s{'. ' if test['reason'] else ''}{test['reason']}")
