// Places on the surface that were clicked at, the lengths between them, and the command that measures the same.

import { projected, turned } from "./camera.js";

const element = (id) => document.getElementById(id);
const apart = (a, b) => Math.hypot(...a.map((x, axis) => x - b[axis]));
const quoted = (text) => (/^[\w.,/-]+$/.test(text) ? text : `'${text.replaceAll("'", "'\\''")}'`);

export class Measure {
  // viewer: whose picture is clicked at; title: the run's name
  constructor(viewer, title) {
    const { scale = 1, rotation = [[1, 0, 0], [0, 1, 0], [0, 0, 1]], translation = [0, 0, 0] } = Object(viewer.tree.meta.world_from_capture);
    Object.assign(this, { viewer, title, scale, rotation, translation, points: [], on: false, missed: false });
    this.unit = viewer.tree.meta.metric === true ? " m" : "";
    element("measure").addEventListener("click", () => this.show(!this.on));
    element("undo").addEventListener("click", () => this.keep(this.points.slice(0, -1)));
    element("clear").addEventListener("click", () => this.keep([]));
    element("copy").addEventListener("click", () => {
      element("lengths").select();
      document.execCommand("copy"); // the newer way asks for leave where a page lies on a disk
    });
    this.show(false);
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

  length(world) {
    return `${Number((world / this.scale).toPrecision(5))}${this.unit}`;
  }

  text() {
    const { points } = this, legs = points.slice(1).map((point, n) => apart(points[n], point));
    if (this.missed) return "There is no surface. Click at another place.";
    if (!legs.length) return points.length ? "Click at the next place." : "Click at places on the surface.";
    const upright = points.map((point) => turned(this.viewer.eye.upright, point));
    const extent = [0, 1, 2].map((axis) => Math.max(...upright.map((point) => point[axis])) - Math.min(...upright.map((point) => point[axis])));
    return [
      ...legs.map((leg, n) => `${n + 1} to ${n + 2}: ${this.length(leg)}`),
      ...(legs.length > 1 ? [`in all: ${this.length(legs.reduce((a, b) => a + b, 0))}`] : []),
      `height of ${points.length} over 1: ${this.length(upright.at(-1)[2] - upright[0][2])}`,
      `upright box round them: ${extent.map((side) => this.length(side)).join(" × ")}`,
      ...(this.unit ? [] : ["The unit is not known: enerf measure RUN --known-length A B LENGTH."]),
      `enerf measure ${quoted(this.title)} ${points.map((point) => this.captured(point).map((x) => Number(x.toPrecision(9))).join(",")).join(" ")}`,
    ].join("\n");
  }

  draw(context) {
    if (!this.on) return;
    const { canvas } = this.viewer, view = this.viewer.eye.view(canvas.width, canvas.height), width = canvas.width / canvas.clientWidth;
    const seen = this.points.map((point) => projected(view, point));
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
