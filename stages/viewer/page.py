"""A page that shows an asset, or its Gaussians, in a browser: one file, which needs nothing but WebGL2 and sends no request.

The page holds the asset's own bytes in the layout `compact`, compressed, and checks them as `enerf verify` does before it draws; or those of an SPZ file.
Its scripts are the modules next to this one.
"""

import base64
import functools
import hashlib
import json
import re
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
from markupsafe import Markup

from efficientnerf.asset.captured import captured_of
from efficientnerf.asset.format import FormatError, contents, load, serialize
from efficientnerf.asset.tree import NerfTree
from efficientnerf.geometry.cameras import Camera, Similarity
from pipeline.files import write_atomically
from pipeline.text import printable
from stages.formats.exporters.glb import gltf_from_capture
from stages.formats.exporters.splats.spz import MAGIC
from stages.formats.exporters.writing import source_frame
from stages.framing.true_frame import TrueFrame
from stages.viewer.html import json_for_html, policy_hash

FOLDER = Path(__file__).parent
MODULES = (
    "sha256", "asset", "payload", "volume", "shader", "renderer", "camera", "measure", "controls", "splats", "main",
)  # each after those that it imports  # fmt: skip
NAME = "viewer.html"
Box = list[list[float]] | None
LARGEST_SPZ = 2**29  # bytes, of millions of Gaussians
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
    asset: bytes, *, cameras: Sequence[Camera] = (), photographs: Mapping[str, bytes] | None = None, title: str = "scene", box: Box = None
) -> bytes:
    """The page of the bytes of an asset in the layout `compact`, which the page checks.

    cameras      captured cameras, training frame, to jump to; none: those of the asset's captured path
    photographs  WebP of the image of a camera, by the camera's name; as a pinhole camera of the same lens takes it
    box          corners of the subject in the frame of exports; None: what the page takes for the scene
    """
    packer = zlib.compressobj(1, zlib.DEFLATED, -15, 9)
    packed = packer.compress(asset) + packer.flush()
    return _page(packed, len(asset), _cameras(cameras, photographs) or _captured_path(asset), title, box=box)


def splats_page(
    spz: bytes, metadata: Mapping[str, Any], *, cameras: Sequence[Camera] = (), photographs: Mapping[str, bytes] | None = None, title: str = "scene",
    asset: str | None = None, true: TrueFrame | None = None, box: Box = None,
) -> bytes:  # fmt: skip
    """The page of Gaussians in the bytes of an SPZ file of ours.

    metadata     of the asset that they were made of
    cameras ...  as of `viewer_page`
    asset        the name of a page next to it that shows the asset
    true         the frame of the places that are shown; the file is in the capture's

    Raises FormatError.
    """
    frame = source_frame(metadata)
    world_from_spz = frame.world_from_capture.matrix() @ Similarity(1.0, gltf_from_capture(frame.up).T, np.zeros(3)).matrix()
    try:
        stream = zlib.decompressobj(31)
        content = stream.decompress(spz, LARGEST_SPZ)
    except zlib.error as error:
        raise FormatError(f"{title}: its Gaussians are damaged: {error}") from None
    if not stream.eof or content[:4] != MAGIC:
        raise FormatError(f"{title}: its Gaussians are no whole SPZ file")
    changed = {} if true is None else true.metadata(metadata)
    about = {key: value for key, value in metadata.items() if key != "captured_path"} | changed
    facts = {"sha256": hashlib.sha256(content).hexdigest(), "frame": world_from_spz[:3].tolist(), "meta": about}
    return _page(spz[10:-8], len(content), _cameras(cameras, photographs), title, splats=facts, asset=asset, box=box)  # the stream in the gzip


def _page(packed: bytes, size: int, cameras: list[dict[str, Any]], title: str, **more: Any) -> bytes:
    """The page of a deflate stream of so many bytes."""
    title = printable(title, 200)
    facts = {"title": title, "bytes": size, "cameras": cameras, **more}
    script, style = script_text(), (FOLDER / "viewer.css").read_text(encoding="utf-8")
    head = _template().render(title=title, policy=Markup(policy()), style=Markup(style), facts=Markup(json_for_html(facts)))
    parts = [head.encode("utf-8"), b"\n"]
    for begin in range(0, len(packed), PART):
        parts += [b'<script type="text/plain" data-part>', base64.b64encode(packed[begin : begin + PART]), b"</script>\n"]
    return b"".join([*parts, b"<script>", script.encode("utf-8"), b"</script>\n</body>\n</html>\n"])


def policy() -> str:
    """The page's Content-Security-Policy: its own script and style, a worker that it makes, and pictures that it holds."""
    script, style = policy_hash(script_text()), policy_hash((FOLDER / "viewer.css").read_text(encoding="utf-8"))
    allowed = f"script-src 'sha256-{script}'; worker-src blob:; style-src 'sha256-{style}'; img-src data: blob:"
    return f"default-src 'none'; {allowed}; base-uri 'none'; form-action 'none'"


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
    return '"use strict";\n(() => {\n' + "\n".join(texts) + "})();\n"


def _cameras(cameras: Sequence[Camera], photographs: Mapping[str, bytes] | None) -> list[dict[str, Any]]:
    return [_camera(camera, (photographs or {}).get(camera.name)) for camera in cameras]


def _camera(camera: Camera, photograph: bytes | None) -> dict[str, Any]:
    lens = camera.intrinsics
    return {
        "name": printable(camera.name, 200),
        "rotation": camera.world_from_camera[:3, :3].tolist(),
        "eye": camera.centre.tolist(),
        "width": camera.width,
        "height": camera.height,
        **{key: float(lens[key]) for key in ("fx", "fy", "cx", "cy")},
        "photograph": None if photograph is None else "data:image/webp;base64," + base64.b64encode(photograph).decode("ascii"),
    }


def _captured_path(asset: bytes) -> list[dict[str, Any]]:
    """The cameras of the asset's captured path, as far as it is one: FORMAT.md states no rule for it that a reader checks."""
    try:
        header = json.loads(asset[8 : 8 + int.from_bytes(asset[:8], "little")])
        found = captured_of(json.loads(header["__metadata__"]["nerftree"]))
    except (KeyError, TypeError, ValueError):
        return []
    if found is None:
        return []
    size, params = (int(found.width), int(found.height)), (found.focal, found.width / 2, found.height / 2)
    return [_camera(Camera(f"camera {n}", *size, "SIMPLE_PINHOLE", params, pose), None) for n, pose in enumerate(found.poses, 1)]
