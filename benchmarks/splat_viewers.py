"""What public viewers draw of a run's 3D Gaussians, beside the project's rasteriser: in headless Chromium, a picture each.

    python -m benchmarks.splat_viewers RUN --npm FOLDER [--view 0] [--width 480] [--shots FOLDER] [--out FILE.json]

--npm: a folder in which `npm install three @sparkjsdev/spark playcanvas` has run. The camera is one of the scene's test views (else of all) without its
lens's distortion and with its centre in the middle, the background black. Each viewer reads the file in the frame that the file is in, so that a wrong axis,
a wrong order of harmonics or a wrong scale shows; dB are those of its picture against the rasteriser's, which draws the Gaussians of the PLY.
"""

from __future__ import annotations

import argparse
import functools
import http.server
import json
import math
import tempfile
import threading
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.viewer import decibels
from efficientnerf.asset.format import load
from efficientnerf.geometry.cameras import Camera, Similarity
from efficientnerf.splats.rendering import render
from stages.artifacts import PosesOutputs, SplatsOutputs
from stages.formats.exporters import SPLAT_EXPORTERS
from stages.formats.exporters.glb import gltf_from_capture
from stages.formats.exporters.splats.ply import read_splats
from stages.formats.exporters.writing import source_frame
from stages.io import scene
from stages.io.pictures import opened, rgb_and_alpha
from tests.stages.viewer import browser
from workflows.cli.target import asset_of

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # of a camera: x right, y up, looking along -z
WAIT = 600_000  # milliseconds, on a machine that may be busy
HEAD = """<!doctype html><meta charset=utf-8><style>body{margin:0;background:#000}canvas{display:block}</style>
<script type=importmap>{"imports":{"three":"/npm/three/build/%(three)s.js","three/webgpu":"/npm/three/build/three.webgpu.js",
"three/tsl":"/npm/three/build/three.tsl.js","three/addons/":"/npm/three/examples/jsm/","playcanvas":"/npm/playcanvas/build/playcanvas.mjs",
"@sparkjsdev/spark":"/npm/@sparkjsdev/spark/dist/spark.module.js"}}</script><body><script>
for (const kind of ["error", "unhandledrejection"]) addEventListener(kind, (e) => { window.done = "failed: " + (e.message || e.reason); });
</script><script type=module>
const [width, height, fov, matrix, url] = [%(width)d, %(height)d, %(fov).9f, %(matrix)s, "/%(file)s"];
const frames = async (draw, count) => { for (let n = 0; n < count; n++) { await new Promise(requestAnimationFrame); await draw(); } };
"""
THREE = """
const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(fov, width / height, 0.01, 1000);
camera.matrixAutoUpdate = false;
camera.matrix.set(...matrix);
camera.matrixWorldNeedsUpdate = true;
renderer.setSize(width, height);
document.body.append(renderer.domElement);
"""
PAGES = {
    "playcanvas": """
import * as pc from "playcanvas";
const canvas = document.body.appendChild(document.createElement("canvas"));
const app = new pc.Application(canvas, { graphicsDeviceOptions: { antialias: false } });
app.setCanvasFillMode(pc.FILLMODE_NONE, width, height);
app.setCanvasResolution(pc.RESOLUTION_FIXED, width, height);
app.start();
const asset = new pc.Asset("splats", url.endsWith(".glb") ? "container" : "gsplat", { url });
app.assets.add(asset);
await new Promise((done, failed) => { asset.once("load", done); asset.once("error", (e) => failed(new Error(e))); app.assets.load(asset); });
let entity = new pc.Entity();
if (asset.type === "container") entity = asset.resource.instantiateRenderEntity();
else entity.addComponent("gsplat", { asset });
app.root.addChild(entity);
const camera = new pc.Entity(), at = new pc.Mat4();
const columns = [0, 1, 2, 3].flatMap((c) => [0, 1, 2, 3].map((r) => matrix[4 * r + c]));
at.set(columns);
camera.addComponent("camera", { clearColor: new pc.Color(0, 0, 0), fov, nearClip: 0.01, farClip: 1000 });
camera.setPosition(at.getTranslation());
camera.setRotation(new pc.Quat().setFromMat4(at));
app.root.addChild(camera);
await frames(() => null, 40);
window.done = pc.version;
""",
    "spark": """
import * as THREE from "three";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
const renderer = new THREE.WebGLRenderer({ preserveDrawingBuffer: true });
""" + THREE + """
scene.add(new SparkRenderer({ renderer }));
const splats = new SplatMesh({ url });
await splats.initialized;
scene.add(splats);
await frames(() => renderer.render(scene, camera), 12);
window.done = "with three.js " + THREE.REVISION;
""",
    "three": """
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { GLTFGaussianSplatLoaderExtension } from "three/addons/loaders/GLTFGaussianSplatLoaderExtension.js";
const renderer = new THREE.WebGPURenderer({ forceWebGL: true });
await renderer.init();
renderer.outputColorSpace = THREE.LinearSRGBColorSpace;  // it heeds no colorSpace of the extension, and would encode sRGB again
""" + THREE + """
const loader = new GLTFLoader();
loader.register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
scene.add((await loader.loadAsync(url)).scene);
await frames(() => renderer.render(scene, camera), 10);
window.done = THREE.REVISION;
""",
}  # fmt: skip
CASES = [("playcanvas", "glb"), ("playcanvas", "ply"), ("spark", "ply"), ("spark", "spz"), ("three", "glb")]


def camera_of(run: Path, number: int, width: int) -> Camera:
    """That of a test view, in the training frame."""
    found = scene.load(PosesOutputs.of_run(run).folder)
    camera = ([view for view in found.views if view.split == "test"] or list(found.views))[number].camera
    height, lens = round(camera.height * width / camera.width), camera.intrinsics["fy"] * width / camera.width
    return Camera(camera.name, width, height, "PINHOLE", (lens, lens, width / 2, height / 2), camera.world_from_camera)


def seen(chromium: Any, address: str, camera: Camera, shot: Path) -> tuple[np.ndarray, str, list[str]]:
    """(H, W, 3) uint8 of a page, also as the file `shot` (PNG); what it says of itself, lines of errors on its console."""
    page = chromium.new_page(viewport={"width": camera.width, "height": camera.height})
    console: list[str] = []
    page.on("console", lambda each: console.append(each.text) if each.type == "error" else None)
    page.on("pageerror", lambda error: console.append(str(error)))
    page.goto(address)
    page.wait_for_function("window.done", timeout=WAIT)
    page.screenshot(path=shot, timeout=WAIT)
    about = page.evaluate("String(window.done)")
    page.close()
    with opened(shot, ("PNG",)) as image:
        return rgb_and_alpha(image)[0], about, console


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *_: Any) -> None:
        return


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("--npm", type=Path, required=True)
    parser.add_argument("--view", type=int, default=0)
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--cases", nargs="*", default=["-".join(each) for each in CASES])
    parser.add_argument("--shots", type=Path)
    parser.add_argument("--out", type=Path)
    given = parser.parse_args()
    frame = source_frame(load(asset_of(given.run)).metadata)
    camera = frame.world_from_capture.inverse().camera(camera_of(given.run, given.view, given.width))
    gaussians = read_splats(SplatsOutputs.of_run(given.run).ply)
    own = np.clip(render(gaussians, camera, (0.0, 0.0, 0.0)).colour, 0, 1)
    if given.shots:
        given.shots.mkdir(parents=True, exist_ok=True)
        Image.fromarray((own * 255 + 0.5).astype(np.uint8)).save(given.shots / "own.png")
    rows = []
    with tempfile.TemporaryDirectory() as folder, browser.chromium() as chromium:
        (Path(folder) / "npm").symlink_to((given.npm / "node_modules").resolve())
        server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=folder))
        threading.Thread(target=server.serve_forever, daemon=True).start()
        for case in given.cases:
            viewer, kind = case.split("-")
            file = Path(folder) / f"splats.{kind}"
            if not file.exists():
                SPLAT_EXPORTERS[f".{kind}"].write(gaussians, file, frame)
            turn = np.eye(3) if kind == "ply" else gltf_from_capture(frame.up)
            matrix = Similarity(1.0, turn, np.zeros(3)).pose(camera.world_from_camera) @ OPENGL
            facts = {"width": camera.width, "height": camera.height, "matrix": matrix.ravel().tolist(), "file": file.name}
            facts |= {"three": "three.webgpu" if viewer == "three" else "three.module"}
            facts |= {"fov": math.degrees(2 * math.atan(camera.height / 2 / camera.intrinsics["fy"]))}
            (Path(folder) / f"{case}.html").write_text(HEAD % facts + PAGES[viewer] + "</script>", encoding="utf-8")
            shot = (given.shots or Path(folder)) / f"{case}.png"
            picture, about, console = seen(chromium, f"http://127.0.0.1:{server.server_port}/{case}.html", camera, shot)
            facts = {"viewer": viewer, "version": about, "file": kind, "bytes": file.stat().st_size}
            rows.append({**facts, "psnr": round(decibels(picture, own), 1), "console": console})
            print(json.dumps(rows[-1]), flush=True)
        server.shutdown()
    if given.out:
        found = {"gaussians": len(gaussians), "size": [camera.width, camera.height], "pictures": rows}
        given.out.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
