// Mouse, touch, keyboard, buttons; the captured cameras drawn over the picture; the photograph beside the rendering.

import { projected } from "./camera.js";
import { Measure } from "./measure.js";
import { element } from "./payload.js";

const MODES = ["colour", "depth", "normals", "colour without view dependence"];

// Of what and how the asset was made, as far as it says so.
function madeBy(provenance) {
  const { tool, training_views: views, iterations, settings } = Object(provenance), said = (x) => String(x).slice(0, 200);
  const parts = [];
  if (typeof tool === "string") parts.push(`Made by ${said(tool)}`);
  if (typeof views === "number") parts.push(`of ${said(views)} photographs`);
  if (typeof iterations === "number") parts.push(`in ${said(iterations)} steps`);
  const set = Object.entries(Object(settings)).slice(0, 20).filter(([, x]) => typeof x === "string" || typeof x === "number");
  if (set.length) parts.push(`with ${set.map(([name, x]) => `${said(name)} ${said(x)}`).join(", ")}`);
  return parts.length ? `${parts.join(" ")}.` : "";
}

export class Controls {
  constructor(viewer, page) {
    this.viewer = viewer;
    this.page = page;
    this.eye = viewer.eye;
    this.canvas = viewer.canvas;
    this.pointers = new Map();
    this.frusta = false;
    this.measure = new Measure(viewer, page, () => this.region());
    viewer.drawn = (whole, milliseconds) => this.drawn(whole, milliseconds);
    this.pointing();
    this.keys();
    this.buttons();
  }

  changed() {
    this.viewer.touch();
    this.photograph();
  }

  pointing() {
    const { canvas, eye, pointers } = this;
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      pointers.set(event.pointerId, { x: event.clientX, y: event.clientY, from: [event.clientX, event.clientY] });
      this.spin(false);
    });
    canvas.addEventListener("pointermove", (event) => {
      const before = pointers.get(event.pointerId);
      if (!before) return;
      const x = event.clientX - before.x, y = event.clientY - before.y, height = canvas.clientHeight;
      if (x === 0 && y === 0) return;
      const others = [...pointers].filter(([id]) => id !== event.pointerId).map(([, each]) => each);
      if (others.length) {
        const [other] = others, was = Math.hypot(before.x - other.x, before.y - other.y), now = Math.hypot(event.clientX - other.x, event.clientY - other.y);
        if (was > 0 && now > 0) eye.approach(was / now);
        eye.pan(x / 2 / height, y / 2 / height);
      } else if (event.buttons & 6 || event.shiftKey || event.ctrlKey) eye.pan(x / height, y / height);
      else if (Math.hypot(event.clientX - before.from[0], event.clientY - before.from[1]) > 3 || before.dragged) {
        before.dragged = true;
        eye.turn((x / height) * 4, (y / height) * 4);
      } else return;
      Object.assign(before, { x: event.clientX, y: event.clientY, dragged: true });
      this.changed();
    });
    const up = (event) => {
      const pointer = pointers.get(event.pointerId);
      pointers.delete(event.pointerId);
      if (pointer && !pointer.dragged && event.type === "pointerup") this.click(event);
    };
    canvas.addEventListener("pointerup", up);
    canvas.addEventListener("pointercancel", up);
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      eye.approach(Math.exp(Math.max(-200, Math.min(200, event.deltaY * (event.deltaMode ? 30 : 1))) * 0.0015));
      this.changed();
    }, { passive: false });
    canvas.addEventListener("dblclick", () => { if (!this.measure.on) this.reset(); });
  }

  keys() {
    const actions = {
      ArrowLeft: () => this.eye.turn(-0.1, 0), ArrowRight: () => this.eye.turn(0.1, 0), ArrowUp: () => this.eye.turn(0, 0.08), ArrowDown: () => this.eye.turn(0, -0.08),
      "+": () => this.eye.approach(0.9), "=": () => this.eye.approach(0.9), "-": () => this.eye.approach(1 / 0.9),
      a: () => this.eye.pan(0.05, 0), d: () => this.eye.pan(-0.05, 0), w: () => this.eye.pan(0, 0.05), s: () => this.eye.pan(0, -0.05),
      ",": () => this.step(-1), ".": () => this.step(1), " ": () => this.spin(!this.viewer.spin), r: () => this.reset(), c: () => this.showFrusta(!this.frusta),
      p: () => this.save(), m: () => this.measure.show(!this.measure.on), "?": () => this.help(),
      1: () => this.mode(0), 2: () => this.mode(1), 3: () => this.mode(2), 4: () => this.mode(3),
    };
    document.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey || /^(SELECT|INPUT|TEXTAREA)$/.test(event.target.tagName)) return;
      if (event.key === " " && event.target.tagName === "BUTTON") return;
      const action = Object.hasOwn(actions, event.key) ? actions[event.key] : null;
      if (!action || element("help").open) return;
      event.preventDefault();
      action();
      this.changed();
    });
  }

  buttons() {
    const { viewer, page } = this, on = (id, kind, action) => element(id).addEventListener(kind, () => { action(); this.changed(); });
    on("mode", "change", () => this.mode(Number(element("mode").value)));
    on("background", "change", () => this.background(element("background").value));
    on("colour", "input", () => this.background("own"));
    on("spin", "click", () => this.spin(!viewer.spin));
    on("home", "click", () => this.reset());
    on("save", "click", () => this.save());
    on("frusta", "click", () => this.showFrusta(!this.frusta));
    on("previous", "click", () => this.step(-1));
    on("next", "click", () => this.step(1));
    on("blend", "input", () => {});
    element("subject").addEventListener("change", () => this.region());
    element("about").addEventListener("click", () => this.help());
    element("subject").hidden = !viewer.tree.region;
    Object.assign(element("other"), { hidden: !page.asset, href: page.asset || "" });
    element("cameras").hidden = page.cameras.length === 0;
    element("scenes").hidden = viewer.tree.environment === null && viewer.tree.background === null;
    this.background(element("scenes").hidden ? "black" : "scene");
    const { tree } = viewer, megabytes = (page.bytes / 1e6).toFixed(page.bytes < 1e7 ? 1 : 0);
    element("facts-line").textContent = `${tree.count.toLocaleString("en")} ${tree.splats ? "Gaussians" : "voxels"}, ${megabytes} MB`;
    element("made").textContent = `${element("facts-line").textContent}, harmonics of degree ${tree.degree}. ${madeBy(tree.meta.provenance)}`;
    new MutationObserver(() => this.photograph()).observe(this.canvas, { attributes: true, attributeFilter: ["width", "height"] });
  }

  // What lies in the box, in the subject's region, or all.
  async region() {
    const { viewer } = this, wanted = this.measure.crop || (element("subject").value === "subject" ? viewer.tree.region : null);
    await viewer.show(wanted);
    this.background(wanted && element("background").value === "scene" ? "white" : element("background").value);
    this.changed();
  }

  mode(mode) {
    this.viewer.options.mode = mode;
    element("mode").value = String(mode);
    this.canvas.setAttribute("aria-label", `The scene: ${MODES[mode]}`);
  }

  background(name) {
    const { options, tree } = this.viewer, known = { black: [0, 0, 0], white: [1, 1, 1], grey: [0.5, 0.5, 0.5] };
    const own = /^#([0-9a-f]{2})([0-9a-f]{2})([0-9a-f]{2})$/i.exec(element("colour").value).slice(1).map((x) => parseInt(x, 16) / 255);
    element("background").value = name;
    element("colour").hidden = name !== "own";
    options.surroundings = name === "scene" && tree.environment !== null;
    options.background = known[name] || (name === "scene" && tree.background) || (name === "own" ? own : [0, 0, 0]);
  }

  spin(on) {
    this.viewer.spin = on;
    element("spin").setAttribute("aria-pressed", String(on));
    if (on) this.eye.release();
  }

  reset() {
    this.eye.reset();
    this.changed();
  }

  step(by) {
    const count = this.page.cameras.length;
    if (!count) return;
    this.jump((((this.eye.index ?? (by > 0 ? -1 : 0)) + by) % count + count) % count);
  }

  jump(index) {
    this.spin(false);
    this.eye.jump(index);
    this.changed();
  }

  showFrusta(on) {
    this.frusta = on;
    element("frusta").setAttribute("aria-pressed", String(on));
  }

  // Corners of a camera's image plane, a little before it.
  corners({ rotation, eye, width, height, fx, fy, cx, cy }) {
    const length = 0.06 * this.eye.home.radius;
    return [[0, 0], [width, 0], [width, height], [0, height]].map(([x, y]) => {
      const ray = [(x - cx) / fx, (y - cy) / fy, 1];
      return eye.map((value, axis) => value + length * (rotation[axis][0] * ray[0] + rotation[axis][1] * ray[1] + rotation[axis][2] * ray[2]));
    });
  }

  drawFrusta() {
    const over = element("over"), { width, height } = this.canvas, context = over.getContext("2d");
    if (over.width !== width || over.height !== height) Object.assign(over, { width, height });
    context.clearRect(0, 0, width, height);
    this.marks = [];
    if (!this.frusta) return;
    const view = this.eye.view(width, height);
    context.lineWidth = 1.2 * (width / this.canvas.clientWidth);
    this.page.cameras.forEach((camera, index) => {
      if (this.eye.held === camera) return;
      const tip = projected(view, camera.eye), corners = this.corners(camera).map((point) => projected(view, point));
      if (!tip || corners.some((corner) => corner === null)) return;
      this.marks.push([tip[0], tip[1], index]);
      for (const colour of ["rgba(0,0,0,.55)", index === this.eye.index ? "#ffd166" : "#7cc7ff"]) {
        context.strokeStyle = colour;
        context.beginPath();
        corners.forEach((corner, n) => {
          const next = corners[(n + 1) % 4];
          context.moveTo(tip[0], tip[1]);
          context.lineTo(corner[0], corner[1]);
          context.lineTo(next[0], next[1]);
        });
        context.stroke();
        context.lineWidth /= 1.6;
      }
      context.lineWidth *= 1.6 * 1.6;
    });
  }

  click(event) {
    const box = this.canvas.getBoundingClientRect(), ratio = this.canvas.width / box.width;
    const x = (event.clientX - box.left) * ratio, y = (event.clientY - box.top) * ratio;
    if (this.measure.on && event.button === 0) this.measure.click(x, y);
    if (this.measure.on || !this.frusta || !this.marks) return;
    const near = this.marks.map(([a, b, index]) => [Math.hypot(a - x, b - y), index]).sort((a, b) => a[0] - b[0])[0];
    if (near && near[0] < 22 * ratio) this.jump(near[1]);
  }

  // The photograph of the captured camera that the eye is at, over the left part of its place in the picture.
  photograph() {
    const image = element("photograph"), { held } = this.eye, there = held !== null && Boolean(held.photograph);
    image.hidden = !there;
    element("comparison").hidden = !there;
    element("camera").textContent = held ? held.name : "";
    if (!there) return;
    if (image.src !== held.photograph) image.src = held.photograph;
    image.alt = `Photograph ${held.name}`;
    const { left, top, scale } = this.eye.frame(this.canvas.clientWidth, this.canvas.clientHeight), share = Number(element("blend").value);
    Object.assign(image.style, { left: `${left}px`, top: `${top}px`, width: `${held.width * scale}px`, height: `${held.height * scale}px`, clipPath: `inset(0 ${100 - share}% 0 0)` });
  }

  drawn(whole, milliseconds) {
    this.drawFrusta();
    this.measure.draw(element("over").getContext("2d"));
    const { frames } = this.viewer, [width, height] = [this.viewer.renderer.target.width, this.viewer.renderer.target.height];
    element("rate").textContent = whole ? `${width} × ${height}` : `${frames.length} frames/s, ${width} × ${height}, ${milliseconds.toFixed(0)} ms`;
  }

  save() {
    const { viewer, canvas } = this, { width, height } = canvas, out = document.createElement("canvas");
    Object.assign(out, { width, height });
    out.getContext("2d").putImageData(new ImageData(new Uint8ClampedArray(viewer.still(width, height).buffer), width, height), 0, 0);
    out.toBlob((blob) => {
      const link = document.createElement("a");
      link.href = URL.createObjectURL(blob);
      link.download = `${this.page.title.replace(/[^\p{L}\p{N}._-]+/gu, "_").slice(0, 80) || "scene"}.png`;
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 10000);
    });
  }

  help() {
    element("help").showModal();
  }
}
