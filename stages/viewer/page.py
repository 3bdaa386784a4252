"""A page that shows an asset in a browser: one file, which needs nothing but WebGL2 and sends no request.

The page holds the asset's own bytes in the layout `compact`, compressed, and checks them as `enerf verify` does before it draws. Its scripts are the
modules next to this one.
"""

from __future__ import annotations

import base64
import functools
import json
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from efficientnerf.asset.format import contents, load, serialize
from efficientnerf.asset.tree import NerfTree
from efficientnerf.geometry.cameras import Camera
from pipeline.files import write_atomically
from pipeline.text import printable
from stages.viewer.html import json_for_html, policy_hash

FOLDER = Path(__file__).parent
MODULES = ("sha256", "asset", "payload", "volume", "shader", "renderer", "camera", "controls", "main")  # each after those that it imports
NAME = "viewer.html"
PART = 3 * 2**18  # bytes of compressed data in an element of the page; a multiple of 3


def write_viewer(asset: Path, target: Path) -> int:
    """Write the page of an asset file, whole or not at all; returns its bytes. Raises FormatError for a file that is no asset."""
    page = viewer_page(compact_bytes(asset), title=asset.stem)
    write_atomically(target, page)
    return len(page)


def compact_bytes(asset: Path) -> bytes:
    """The asset's file in the layout `compact`, checked. Raises FormatError."""
    tree: NerfTree = load(asset)
    if contents(asset)[0]["layout"].endswith("compact"):
        return asset.read_bytes()
    return serialize(tree, "compact")


def viewer_page(
    asset: bytes, *, cameras: Sequence[Camera] = (), photographs: Mapping[str, bytes] | None = None, title: str = "scene"
) -> bytes:
    """The page of the bytes of an asset in the layout `compact`, which the page checks.

    cameras      captured cameras, training frame, to jump to; none: those of the asset's captured path
    photographs  JPEG of the image of a camera, by the camera's name; as a pinhole camera of the same lens takes it
    """
    title = printable(title, 200)
    entries = [_camera(camera, (photographs or {}).get(camera.name)) for camera in cameras] or _captured_path(asset)
    facts = {"title": title, "bytes": len(asset), "cameras": entries, "home": None}
    script, style = script_text(), (FOLDER / "viewer.css").read_text(encoding="utf-8")
    head = _template().render(title=title, policy=Markup(policy()), style=Markup(style), facts=Markup(json_for_html(facts)))
    parts = [head.encode("utf-8"), b"\n"]
    for part in _parts(asset):
        parts += [b'<script type="text/plain" data-part>', part, b"</script>\n"]
    return b"".join([*parts, b"<script>", script.encode("utf-8"), b"</script>\n</body>\n</html>\n"])


def policy() -> str:
    """The page's Content-Security-Policy: its own script and style, and pictures that it holds."""
    script, style = policy_hash(script_text()), policy_hash((FOLDER / "viewer.css").read_text(encoding="utf-8"))
    return f"default-src 'none'; script-src 'sha256-{script}'; style-src 'sha256-{style}'; img-src data: blob:; base-uri 'none'; form-action 'none'"


@functools.cache
def _template() -> jinja2.Template:
    return jinja2.Environment(loader=jinja2.FileSystemLoader(FOLDER), autoescape=True, undefined=jinja2.StrictUndefined).get_template("viewer.html.j2")


def script_text() -> str:
    """The modules as one script: imports and exports among themselves are names in one function."""
    texts = []
    for name in MODULES:
        text = (FOLDER / f"{name}.js").read_text(encoding="utf-8")
        text = re.sub(r'^import \{[^}]*\} from "\./\w+\.js";\n', "", text, flags=re.MULTILINE)
        texts.append(f"// {name}.js\n" + re.sub(r"^export (?=(?:async function|function|class|const) )", "", text, flags=re.MULTILINE))
    joined = "\n".join(texts).replace('const element = (id) => document.getElementById(id);\n', "")
    return '"use strict";\n(() => {\nconst element = (id) => document.getElementById(id);\n' + joined + "})();\n"


def _parts(asset: bytes) -> Iterator[bytes]:
    """The asset's bytes, compressed, in base64."""
    packer = zlib.compressobj(1, zlib.DEFLATED, -15, 9)
    packed = packer.compress(asset) + packer.flush()
    for begin in range(0, len(packed), PART):
        yield base64.b64encode(packed[begin : begin + PART])


def _camera(camera: Camera, photograph: bytes | None) -> dict[str, Any]:
    lens = camera.intrinsics
    return {
        "name": printable(camera.name, 200),
        "rotation": camera.world_from_camera[:3, :3].tolist(),
        "eye": camera.centre.tolist(),
        "width": camera.width,
        "height": camera.height,
        **{key: float(lens[key]) for key in ("fx", "fy", "cx", "cy")},
        "photograph": None if photograph is None else "data:image/jpeg;base64," + base64.b64encode(photograph).decode("ascii"),
    }


def _captured_path(asset: bytes) -> list[dict[str, Any]]:
    """The cameras of the asset's captured path, as far as it is one: FORMAT.md states no rule for it that a reader checks."""
    try:
        header = json.loads(asset[8 : 8 + int.from_bytes(asset[:8], "little")])
        found = json.loads(header["__metadata__"]["nerftree"])["captured_path"]
        width, height, focal = int(found["width"]), int(found["height"]), float(found["focal"])
        poses = [np.vstack([np.asarray(pose, np.float64).reshape(3, 4), (0, 0, 0, 1)]) for pose in found["poses"][:64]]
    except (KeyError, TypeError, ValueError):
        return []
    if not (0 < width < 2**16 and 0 < height < 2**16 and 0 < focal < 1e9 and all(np.isfinite(pose).all() for pose in poses)):
        return []
    params = (focal, width / 2, height / 2)
    return [_camera(Camera(f"camera {n}", width, height, "SIMPLE_PINHOLE", params, pose), None) for n, pose in enumerate(poses, 1)]
