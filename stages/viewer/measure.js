// Places on the surface that were clicked at, the lengths between them, the ground through the first three, a box and its sides, and the commands that give the
// same.

import { projected, turned } from "./camera.js";
import { element } from "./payload.js";

const apart = (a, b) => Math.hypot(...a.map((x, axis) => x - b[axis]));
const quoted = (text) => (/^[\w.,/-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`);
const CORNERS = [0, 1, 2, 3, 4, 5, 6, 7], SIDES = [[0, 1], [1, 3], [3, 2], [2, 0], [4, 5], [5, 7], [7, 6], [6, 4], [0, 4], [1, 5], [2, 6], [3, 7]]; // by bits x, y, z

export class Measure {
  // viewer: whose picture is clicked at; page: its title, the run's name, and the box of its subject; cropped: what to call where `crop` has changed
  constructor(viewer, { title, box }, cropped) {
    const { scale = 1, rotation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]], translation = [0, 0, 0] } = Object(viewer.tree.meta.world_from_capture);
    Object.assign(this, { viewer, title, scale, rotation, translation, points: [], on: false, missed: false, crop: null });
    this.metric = viewer.tree.meta.metric === true;
    this.ground = Array.isArray(viewer.tree.meta.up) ? viewer.tree.meta.up : null;
    element("units").hidden = !this.metric;
    element("crop").hidden = Boolean(viewer.tree.ndc);
    element("box").value = (box || this.bounds()).flat().map((x) => Number(x.toPrecision(6))).join(" ");
    element("measure").addEventListener("click", () => this.show(!this.on));
    element("undo").addEventListener("click", () => this.keep(this.points.slice(0, -1)));
    element("clear").addEventListener("click", () => this.keep([]));
    element("units").addEventListener("change", () => this.keep(this.points));
    element("box").addEventListener("change", () => this.cut(this.crop !== null, cropped));
    element("crop").addEventListener("click", () => this.cut(this.crop === null, cropped));
    element("copy").addEventListener("click", () => {
      element("lengths").select();
      document.execCommand("copy"); // the newer way asks for leave where a page lies on a disk
    });
    this.show(false);
  }

  // Show what lies in the box alone, or all again.
  cut(on, cropped) {
    const box = this.box(), turn = [0, 1, 2].map((column) => [0, 1, 2].map((row) => this.rotation[row][column] / this.scale));
    const rows = turn.map((row) => [...row, -row.reduce((sum, x, axis) => sum + x * this.translation[axis], 0)]);
    this.crop = on && box ? { rows, low: box[0], high: box[1], radius: 0, fade: 0, bricks: null } : null;
    element("crop").setAttribute("aria-pressed", String(this.crop !== null));
    this.keep(this.points);
    cropped();
  }

  // The scene's corners, in the frame of exports.
  bounds() {
    const corners = CORNERS.map((n) => this.captured([0, 1, 2].map((axis) => this.viewer.box[(n >> axis) & 1][axis])));
    return [Math.min, Math.max].map((most) => [0, 1, 2].map((axis) => most(...corners.map((corner) => corner[axis]))));
  }

  // The two corners that were given, the least first; null where they are none.
  box() {
    const numbers = element("box").value.trim().split(/[\s,;]+/).map(Number), pairs = [0, 1, 2].map((axis) => [numbers[axis], numbers[axis + 3]]);
    if (numbers.length !== 6 || !pairs.every(([a, b]) => Number.isFinite(a) && Number.isFinite(b) && a !== b)) return null;
    return [Math.min, Math.max].map((most) => pairs.map((pair) => most(...pair)));
  }

  show(on) {
    this.on = on;
    element("measure").setAttribute("aria-pressed", String(this.on));
    element("measured").hidden = !this.on;
    this.keep(this.points);
  }

  keep(points, missed = false) {
    Object.assign(this, { points, missed });
    element("lengths").value = this.text();
    this.viewer.touch();
  }

  // x, y: in pixels of the canvas
  click(x, y) {
    const { viewer } = this, { canvas } = viewer, view = viewer.eye.view(canvas.width, canvas.height), { rotation, eye, lens } = view, depth = viewer.depth(view, x, y);
    if (!(depth > 0 && depth < 1e29)) return this.keep(this.points, true);
    const ray = [((x - lens[2]) / lens[0]) * depth, ((y - lens[3]) / lens[1]) * depth, depth];
    this.keep([...this.points, eye.map((value, row) => value + rotation[row][0] * ray[0] + rotation[row][1] * ray[1] + rotation[row][2] * ray[2])]);
  }

  // Of a point of the world: in the frame of exports.
  captured(point) {
    const from = point.map((x, axis) => x - this.translation[axis]);
    return [0, 1, 2].map((column) => (this.rotation[0][column] * from[0] + this.rotation[1][column] * from[1] + this.rotation[2][column] * from[2]) / this.scale);
  }

  // Of a point in the frame of exports: in the world.
  placed(point) {
    return this.rotation.map((row, axis) => this.scale * row.reduce((sum, x, column) => sum + x * point[column], 0) + this.translation[axis]);
  }

  length(world) {
    const { value, selectedOptions: [chosen] } = element("units");
    return `${Number(((this.metric ? Number(value) : 1) * (world / this.scale)).toPrecision(5))}${this.metric ? ` ${chosen.textContent}` : ""}`;
  }

  // Lines about the box, and the command that exports what is in it.
  boxed() {
    const box = this.box();
    if (!box) return ["The box: expected six numbers, x y z of one corner and of the opposite one."];
    const corners = box.map((corner) => corner.map((x) => Number(x.toPrecision(9))).join(" ")), sides = box[0].map((x, axis) => this.length(this.scale * (box[1][axis] - x)));
    return [`box: ${sides.join(" × ")}`, `enerf export ${quoted(this.title)} --crop ${corners.join(" ")} --to box.glb`];
  }

  // Lines about the plane through the first three places, and the command that makes it the ground; none where they are in a row, or nearly.
  grounded() {
    const [first, ...rest] = this.points.map((point) => this.captured(point)), ways = rest.map((point) => point.map((x, axis) => x - first[axis]));
    if (ways.length < 2) return [];
    const [a, b] = ways, normal = [0, 1, 2].map((axis) => a[(axis + 1) % 3] * b[(axis + 2) % 3] - a[(axis + 2) % 3] * b[(axis + 1) % 3]), area = Math.hypot(...normal);
    if (!(area > 0.05 * Math.max(Math.hypot(...a), Math.hypot(...b), apart(a, b)) ** 2)) return [];
    const from = this.placed([0, 0, 0]), raised = turned(this.viewer.eye.upright, this.placed(normal).map((x, axis) => x - from[axis]))[2], sign = raised < 0 ? -1 : 1;
    const heights = ways.slice(2).map((way, n) => `${n + 4}: ${this.length((this.scale * sign * way.reduce((sum, x, axis) => sum + x * normal[axis], 0)) / area)}`);
    return [...(heights.length ? [`over the plane of 1, 2 and 3: ${heights.join(", ")}`] : []), `enerf orient ${quoted(this.title)} ${this.places().slice(0, 3).join(" ")}`];
  }

  // As commands take them.
  places() {
    return this.points.map((point) => this.captured(point).map((x) => Number(x.toPrecision(9))).join(","));
  }

  text() {
    const { points } = this, legs = points.slice(1).map((point, n) => apart(points[n], point));
    if (this.missed) return "There is no surface. Click at another place.";
    if (!legs.length) return [points.length ? "Click at the next place." : "Click at places on the surface.", ...this.boxed()].join("\n");
    const upright = points.map((point) => turned(this.viewer.eye.upright, point));
    const extent = [0, 1, 2].map((axis) => Math.max(...upright.map((point) => point[axis])) - Math.min(...upright.map((point) => point[axis])));
    return [
      ...legs.map((leg, n) => `${n + 1} to ${n + 2}: ${this.length(leg)}`),
      ...(legs.length > 1 ? [`in all: ${this.length(legs.reduce((a, b) => a + b, 0))}`] : []),
      `height of ${points.length} over 1: ${this.length(upright.at(-1)[2] - upright[0][2])}`,
      `upright box round them: ${extent.map((side) => this.length(side)).join(" × ")}`,
      this.ground
        ? `over the ground: ${points.map((point, n) => `${n + 1}: ${this.length(this.scale * this.captured(point).reduce((sum, x, axis) => sum + x * this.ground[axis], 0))}`).join(", ")}`
        : "The ground is not set: pick three places on it, or enerf orient RUN --plane.",
      ...this.grounded(),
      ...this.boxed(),
      ...(this.metric ? [] : ["The unit is not known: enerf measure RUN --known-length A B LENGTH."]),
      `enerf measure ${quoted(this.title)} ${this.places().join(" ")}`,
    ].join("\n");
  }

  draw(context) {
    if (!this.on) return;
    const { canvas } = this.viewer, view = this.viewer.eye.view(canvas.width, canvas.height), width = canvas.width / canvas.clientWidth;
    const seen = this.points.map((point) => projected(view, point)), box = this.box();
    if (box) {
      const corners = CORNERS.map((n) => projected(view, this.placed([0, 1, 2].map((axis) => box[(n >> axis) & 1][axis]))));
      context.lineWidth = width;
      context.strokeStyle = "#7cc7ff";
      context.beginPath();
      for (const [a, b] of SIDES.map((side) => side.map((n) => corners[n]))) {
        if (!a || !b) continue;
        context.moveTo(a[0], a[1]);
        context.lineTo(b[0], b[1]);
      }
      context.stroke();
    }
    context.font = `${13 * width}px system-ui, sans-serif`;
    seen.forEach((at, n) => {
      if (!at) return;
      for (const [colour, line] of [["rgba(0,0,0,.6)", 4], ["#ffd166", 2]]) {
        context.strokeStyle = colour;
        context.lineWidth = line * width;
        context.beginPath();
        if (n && seen[n - 1]) {
          context.moveTo(seen[n - 1][0], seen[n - 1][1]);
          context.lineTo(at[0], at[1]);
        }
        context.moveTo(at[0] + 5 * width, at[1]);
        context.arc(at[0], at[1], 5 * width, 0, 7);
        context.stroke();
      }
      const label = n ? `${n + 1}  ${this.length(apart(this.points[n - 1], this.points[n]))}` : "1";
      context.lineWidth = 3 * width;
      context.strokeStyle = "rgba(0,0,0,.7)";
      context.fillStyle = "#fff";
      context.strokeText(label, at[0] + 9 * width, at[1] - 7 * width);
      context.fillText(label, at[0] + 9 * width, at[1] - 7 * width);
    });
  }
}
