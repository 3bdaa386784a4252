// The page: loads the asset, listens, and draws when something changed.

import { FormatError, readAsset } from "./asset.js";
import { Eye, uprightOf } from "./camera.js";
import { Controls } from "./controls.js";
import { element, facts, fromBase64, inflated } from "./payload.js";
import { Renderer, Unsupported } from "./renderer.js";
import { SplatRenderer, readSplats } from "./splats.js";

const breath = () => new Promise((resolve) => setTimeout(resolve, 0));
const BUDGET = 40; // milliseconds that a picture may take while the eye moves
const REST = 180; // milliseconds without a movement until the picture is made whole

function say(text, share) {
  if (document.body.classList.contains("stopped")) return;
  element("loading").hidden = false;
  element("status").textContent = text;
  element("bar").style.width = `${Math.round(100 * share)}%`;
}

function fail(text) {
  element("loading").hidden = false;
  element("loading").classList.add("failed");
  element("status").textContent = text;
  document.body.classList.add("stopped");
}

// The corners of the scene, in the world: those of the region or of the innermost grid; in normalised device coordinates around the orbit.
function boxOf(tree) {
  if (tree.ndc) {
    const { centre, radius } = tree.meta.orbit || { centre: tree.ndc.rows.slice(0, 3).map((row) => row[3]), radius: 4 * tree.ndc.near };
    return [centre.map((x) => x - radius), centre.map((x) => x + radius)];
  }
  if (tree.region) return [tree.region.low, tree.region.high];
  const { low, shape, voxel } = tree.grids[0];
  return [low, low.map((x, axis) => x + shape[axis] * tree.brick * voxel)];
}

class Viewer {
  constructor(tree, renderer, cameras) {
    this.tree = tree;
    this.renderer = renderer;
    this.canvas = renderer.canvas;
    this.box = boxOf(tree);
    this.eye = new Eye(tree.meta.orbit, cameras, this.box, uprightOf(tree.meta));
    this.options = { mode: 0, background: tree.background || [0, 0, 0], surroundings: tree.environment !== null, rough: false, range: [1, 2] };
    this.region = null;
    this.share = 0.5; // of the canvas' sides that is drawn while the eye moves
    this.rows = 64; // drawn at once while it rests
    this.spin = false;
    this.moved = performance.now();
    this.state = "dirty"; // then "moving", "refining", "done"
    this.fence = null;
    this.frames = [];
    this.drawn = () => {};
    new ResizeObserver(() => this.resize()).observe(this.canvas);
    this.resize();
    requestAnimationFrame((now) => this.tick(now));
  }

  resize() {
    const ratio = Math.min(globalThis.devicePixelRatio || 1, 2), { clientWidth: width, clientHeight: height } = this.canvas;
    const size = [Math.max(16, Math.round(width * ratio)), Math.max(16, Math.round(height * ratio))];
    if (this.canvas.width !== size[0] || this.canvas.height !== size[1]) [this.canvas.width, this.canvas.height] = size;
    this.touch();
  }

  // Something changed: draw again.
  touch(moving = true) {
    this.state = "dirty";
    if (moving) this.moved = performance.now();
  }

  settings(rough) {
    return { ...this.options, rough: rough || this.options.rough, range: this.range() };
  }

  // Depths between which colours tell: those of the scene, and some of what is behind it.
  range() {
    if (this.tree.ndc) return [this.tree.ndc.near, 12 * this.tree.ndc.near];
    const { eye } = this.eye.view(1, 1), [low, high] = this.box, middle = low.map((x, axis) => (x + high[axis]) / 2);
    const reach = Math.hypot(...middle.map((x, axis) => high[axis] - x)), distance = Math.hypot(...middle.map((x, axis) => x - eye[axis]));
    return [Math.max(distance - reach, 0.3 * distance, 1e-6), distance + (this.options.surroundings ? 4 : 1) * reach];
  }

  tick(now) {
    requestAnimationFrame((next) => this.tick(next));
    const { renderer, canvas } = this, { gl } = renderer;
    if (document.hidden || gl.isContextLost()) return;
    if (this.fence !== null) {
      if (gl.clientWaitSync(this.fence, 0, 0) === gl.TIMEOUT_EXPIRED) return;
      gl.deleteSync(this.fence);
      this.fence = null;
      this.finished(performance.now() - this.issued);
    }
    if (this.spin && now - this.moved > 0) {
      this.eye.turn((Math.min(now - (this.last || now), 100) / 1000) * -0.5, 0);
      this.touch();
    }
    this.last = now;
    if (this.state === "dirty") {
      const width = Math.max(16, Math.round(canvas.width * this.share)), height = Math.max(16, Math.round(canvas.height * this.share));
      renderer.begin(this.eye.view(width, height), this.settings(true), width, height);
      this.state = "moving";
      this.issue(height);
    } else if (this.state === "moving" && now - this.moved > REST) {
      renderer.begin(this.eye.view(canvas.width, canvas.height), this.settings(false), canvas.width, canvas.height);
      this.state = "refining";
      this.issue(this.rows);
    } else if (this.state === "refining") this.issue(this.rows);
  }

  issue(rows) {
    const { gl } = this.renderer;
    this.complete = this.renderer.band(rows);
    this.kind = this.renderer.target.height === this.canvas.height && this.state === "refining" ? "band" : "whole";
    this.issued = performance.now();
    this.fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    gl.flush();
  }

  finished(milliseconds) {
    if (this.kind === "band") {
      this.rows = Math.min(4096, Math.max(4, Math.round(this.rows * Math.min(2, Math.max(0.25, 60 / milliseconds)))));
      if (!this.complete || this.state !== "refining") return;
      this.state = "done";
    } else {
      const wanted = this.share * Math.sqrt(BUDGET / milliseconds);
      this.share = Math.min(1, Math.max(0.15, 0.7 * this.share + 0.3 * wanted));
      this.frames.push(performance.now());
      this.frames = this.frames.filter((time) => time > performance.now() - 1000);
    }
    this.renderer.present();
    this.drawn(this.kind === "band", milliseconds);
  }

  // Draws at once, in full quality; RGBA bytes from the upper row.
  still(width, height) {
    if (this.fence !== null) this.renderer.gl.deleteSync(this.fence);
    this.fence = null;
    this.renderer.begin(this.fixed || this.eye.view(width, height), this.settings(false), width, height);
    while (!this.renderer.band(64));
    const out = this.renderer.pixels();
    this.touch();
    return out;
  }

  depth(view, x, y) {
    if (this.fence !== null) this.renderer.gl.deleteSync(this.fence);
    this.fence = null;
    this.touch();
    return this.renderer.depth(view, x, y, this.settings(false));
  }

  // What lies in a region alone; null: all.
  async show(region) {
    if (region === this.region) return;
    this.region = region;
    say(region === null ? "All of the scene …" : region === this.tree.region ? "The subject …" : "What lies in the box …", 0.9);
    await breath();
    await breath();
    this.renderer.load(this.tree, region);
    element("loading").hidden = true;
    this.touch();
  }
}

async function start() {
  const began = performance.now(), page = facts();
  if (typeof DecompressionStream === "undefined") throw new Unsupported("This browser is too old to unpack the scene (it has no DecompressionStream). Try a recent one.");
  const renderer = new (page.splats ? SplatRenderer : Renderer)(element("scene"));
  let last = performance.now();
  const step = (text, from, to) => async (share) => {
    say(text, from + (to - from) * share);
    if (performance.now() - last < 60) return;
    await breath();
    last = performance.now();
  };
  const bytes = await inflated(page.bytes, step("Unpacking …", 0, 0.5));
  const unpacked = performance.now();
  const tree = await (page.splats ? readSplats(bytes, page.splats) : readAsset(bytes, step("Checking …", 0.5, 0.7)));
  const checked = performance.now();
  await step("Textures …", 0.75, 0.75)(1);
  await breath();
  const graphics = renderer.load(tree, null), viewer = new Viewer(tree, renderer, page.cameras);
  const controls = new Controls(viewer, page);
  element("loading").hidden = true;
  document.body.classList.add("ready");
  const times = { unpacking: unpacked - began, checking: checked - unpacked, textures: performance.now() - checked };
  return { viewer, controls, tree, times, seconds: (performance.now() - began) / 1000, graphics };
}

document.body.classList.add("begun");
globalThis.enerf = {
  ready: start().catch((error) => {
    const known = error instanceof FormatError || error instanceof Unsupported;
    fail(error instanceof FormatError ? `The asset in this page is refused: ${error.message}.` : error.message);
    if (!known) console.error(error);
    throw error;
  }),
  // For scripts. A pose is three rows of [right, down, forward, place]; lens: fx, fy, cx, cy in pixels.
  async setCamera(pose, lens) {
    const { viewer } = await this.ready;
    viewer.fixed = { rotation: pose.map((row) => row.slice(0, 3)), eye: pose.map((row) => row[3]), lens };
  },
  async setOptions(options) {
    Object.assign((await this.ready).viewer.options, options);
  },
  // What is wrong with an asset's bytes, in base64; null: nothing.
  async check(text) {
    try {
      await readAsset(fromBase64(text));
      return null;
    } catch (error) {
      if (error instanceof FormatError) return error.message;
      throw error;
    }
  },
  async render(width, height) {
    return (await this.ready).viewer.still(width, height);
  },
};
globalThis.enerf.ready.catch(() => {});
