// Follows a run: asks the server what has come of it, and shows that. All text goes in as text.
"use strict";

const EVERY = 2000; // milliseconds
const TITLES = { train: "Training of the field", bake: "Training of the asset" };
const at = (id) => document.getElementById(id);
const panels = new Map(); // stage -> its elements
let shownAsset = null;

function seconds(value) {
  if (value === null || value === undefined) return "";
  if (value < 60) return `${value < 10 ? value.toFixed(1) : Math.round(value)} s`;
  const whole = Math.round(value), minutes = Math.floor(whole / 60);
  return minutes < 60 ? `${minutes} min ${whole % 60} s` : `${Math.floor(minutes / 60)} h ${minutes % 60} min`;
}

function element(name, text, className) {
  const made = document.createElement(name);
  made.textContent = text;
  if (className) made.className = className;
  return made;
}

function drawn(name, attributes, text = "") {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.textContent = text;
  return made;
}

function steps(low, high, count) { // round numbers between two
  const raw = (high - low) / count, power = 10 ** Math.floor(Math.log10(raw));
  const size = [1, 2, 5, 10].map((factor) => factor * power).find((each) => each >= raw);
  const found = [];
  for (let value = Math.ceil(low / size) * size; value <= high + size * 1e-6; value += size) found.push(Number(value.toPrecision(12)));
  return found;
}

function drawCurve(svg, training, preview) {
  svg.replaceChildren();
  const all = [...training, ...preview];
  if (!all.length) return;
  const values = all.map((point) => point[1]).sort((a, b) => a - b);
  let low = values[Math.floor(values.length * 0.02)], high = values[values.length - 1]; // what a curve begins with may be far below
  if (high - low < 1) { low -= 0.5; high += 0.5; }
  const end = Math.max(...all.map((point) => point[0]), 1), left = 44, right = 454, top = 12, bottom = 228;
  const x = (step) => left + (right - left) * step / end;
  const y = (value) => bottom - (bottom - top) * (Math.max(value, low) - low) / (high - low);
  for (const value of steps(low, high, 5)) {
    svg.append(drawn("line", { x1: left, x2: right, y1: y(value), y2: y(value) }), drawn("text", { x: left - 6, y: y(value) + 4, "text-anchor": "end" }, String(value)));
  }
  for (const step of steps(0, end, 5)) svg.append(drawn("text", { x: x(step), y: bottom + 18, "text-anchor": "middle" }, String(step)));
  const line = (points) => points.map((point) => `${x(point[0]).toFixed(1)},${y(point[1]).toFixed(1)}`).join(" ");
  if (training.length) svg.append(drawn("polyline", { class: "first", points: line(training) }));
  if (preview.length) svg.append(drawn("polyline", { class: "second", points: line(preview) }));
  for (const point of preview) svg.append(drawn("circle", { class: "second", r: 3, cx: x(point[0]), cy: y(point[1]) }));
  svg.setAttribute("aria-label", `PSNR up to step ${end}`);
}

function panel(stage) {
  if (panels.has(stage)) return panels.get(stage);
  const made = at("training").content.firstElementChild.cloneNode(true);
  const find = (query) => made.querySelector(query);
  const parts = { section: made, title: find("h2"), now: find(".now"), curve: find("svg"), legend: find(".curve figcaption"), figure: find(".preview"),
    image: find("img"), label: find("label span"), slider: find("input"), caption: find(".preview figcaption"), names: [], follows: true };
  parts.title.textContent = TITLES[stage] || stage;
  parts.caption.textContent = "A view that is held back: the photograph left, the render right";
  parts.slider.addEventListener("input", () => {
    parts.follows = Number(parts.slider.value) === parts.names.length - 1;
    showPreview(stage, parts);
  });
  at("trained").append(made);
  panels.set(stage, parts);
  return parts;
}

function showPreview(stage, parts) {
  const name = parts.names[Number(parts.slider.value)];
  if (!name) return;
  const source = `/previews/${stage}/${name}`;
  if (parts.image.getAttribute("src") !== source) parts.image.src = source;
  parts.label.textContent = `step ${parseInt(name.slice(8), 10)}`;
  parts.image.alt = parts.label.textContent;
}

function showTraining(stage, found) {
  if (!found.previews.length && found.step === null) return;
  const parts = panel(stage);
  const last = (points) => (points.length ? `${points[points.length - 1][1].toFixed(2)} dB` : null);
  const now = [found.live ? "now" : "done", found.step === null ? null : `step ${found.step}`, seconds(found.seconds) || null,
    last(found.psnr) && `training ${last(found.psnr)}`, last(found.preview_psnr) && `preview ${last(found.preview_psnr)}`];
  parts.now.textContent = now.filter(Boolean).join("  ·  ");
  parts.legend.textContent = "PSNR in dB over steps: training rays (line), previews (dots)";
  drawCurve(parts.curve, found.psnr, found.preview_psnr);
  parts.names = found.previews;
  parts.figure.hidden = !found.previews.length;
  parts.slider.max = String(Math.max(found.previews.length - 1, 0));
  if (parts.follows) parts.slider.value = parts.slider.max;
  showPreview(stage, parts);
}

function show(state) {
  const trouble = at("trouble");
  trouble.hidden = !state.error;
  trouble.textContent = state.error || "";
  if (!state.stages) return;
  document.title = state.name;
  at("name").textContent = state.name;
  at("facts").textContent = [`from ${state.source}`, state.preset && `preset ${state.preset}`].filter(Boolean).join(", ");
  at("writer").textContent = state.written_by ? `Being written by ${state.written_by}` : "";
  at("stages").replaceChildren(...state.stages.map((stage) => {
    const item = element("li", stage.name, stage.state);
    const making = state.written_by && stage.state === "partial";
    item.append(element("span", [making ? "being made" : stage.state, seconds(stage.seconds)].filter(Boolean).join(" · ")));
    item.title = (making ? "" : stage.reason) || stage.note || "";
    return item;
  }));
  for (const [stage, found] of Object.entries(state.training)) showTraining(stage, found);
  if (state.asset && shownAsset === null) showAsset(state.asset);
  at("again").hidden = !state.asset || state.asset === shownAsset;
  at("again").onclick = () => showAsset(state.asset);
}

function showAsset(identity) {
  shownAsset = identity;
  at("asset").hidden = false;
  at("again").hidden = true;
  at("viewer").src = "/viewer.html";
}

async function follow() {
  try {
    const answer = await fetch("/status.json", { cache: "no-store", signal: AbortSignal.timeout(30000) });
    if (!answer.ok) throw new Error(String(answer.status));
    show(await answer.json());
  } catch {
    at("trouble").hidden = false;
    at("trouble").textContent = "The server does not answer; it may have been ended.";
  }
  setTimeout(follow, document.hidden ? 5 * EVERY : EVERY);
}

follow();
