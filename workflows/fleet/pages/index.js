"use strict";
// The scenes of a fleet as a table that is sorted and filtered here. All text goes in as text.
(() => {
const fleet = JSON.parse(document.getElementById("data").textContent);
const at = (id) => document.getElementById(id);
const STATES = ["running", "failed", "quarantined", "waiting", "done"];
const GRADES = ["failed", "poor", "usable", "good"];
const RELOAD = 15000; // milliseconds, while the fleet goes on

function element(name, text, className) {
  const made = document.createElement(name);
  if (text !== undefined && text !== null) made.textContent = text;
  if (className) made.className = className;
  return made;
}
function duration(value) {
  if (value === null || value === undefined) return "";
  if (value < 59.5) return `${value < 10 ? value.toFixed(1) : Math.round(value)} s`;
  const minutes = Math.floor(Math.round(value) / 60);
  return minutes < 60 ? `${minutes} min ${Math.round(value) % 60} s` : `${Math.floor(minutes / 60)} h ${String(minutes % 60).padStart(2, "0")} min`;
}
const megabytes = (value) => (value ? (value / 1e6).toFixed(value < 1e6 ? 2 : 1) : "");
const fixed = (digits) => (value) => (value === null || value === undefined ? "" : value.toFixed(digits));
const shown = (value) => (typeof value === "string" ? value : JSON.stringify(value));
const rank = (list) => (word) => (word ? list.indexOf(word) : null);

// title, sort key, cell text, class
const columns = [
  { key: "name", title: "scene", of: (s) => s.name },
  { key: "state", title: "state", of: (s) => rank(STATES)(s.state), text: (s) => s.state },
  ...fleet.sweep.map((setting) => ({ key: setting, title: setting, of: (s) => (s.sweep ? s.sweep[setting] : null), text: (s) => (s.sweep && setting in s.sweep ? shown(s.sweep[setting]) : ""), kind: "n" })),
  { key: "result", title: "result", of: (s) => rank(GRADES)(s.result), text: (s) => s.result || "", kind: "word", why: (s) => s.result_summary },
  { key: "psnr", title: "PSNR / dB", of: (s) => s.psnr, text: (s) => fixed(2)(s.psnr), kind: "n", down: true },
  { key: "ssim", title: "SSIM", of: (s) => s.ssim, text: (s) => fixed(3)(s.ssim), kind: "n", down: true },
  { key: "seconds", title: "time", of: (s) => s.seconds || null, text: (s) => (s.seconds ? duration(s.seconds) : ""), kind: "n", down: true },
  { key: "bytes", title: "MB", of: (s) => s.bytes || null, text: (s) => megabytes(s.bytes), kind: "n", down: true },
  { key: "cameras", title: "cameras", of: (s) => rank(GRADES)(s.grade), text: (s) => s.grade || "", kind: "word", why: (s) => s.summary },
  { key: "warnings", title: "warnings", of: (s) => s.warnings.length || null, text: (s) => s.warnings.length || "", kind: "n", down: true },
];

const wanted = { sort: "", down: false, filter: "", states: new Set(), open: new Set() };
function readAddress() {
  const found = new URLSearchParams(location.hash.slice(1));
  const sort = found.get("sort") || "";
  wanted.down = sort.startsWith("-");
  wanted.sort = columns.some((column) => column.key === sort.replace(/^-/, "")) ? sort.replace(/^-/, "") : "";
  wanted.filter = found.get("filter") || "";
  wanted.states = new Set((found.get("states") || "").split(",").filter((word) => STATES.includes(word)));
  wanted.open = new Set(found.getAll("open"));
  at("follow").checked = found.get("follow") !== "0";
}
function writeAddress() {
  const made = new URLSearchParams();
  if (wanted.sort) made.set("sort", (wanted.down ? "-" : "") + wanted.sort);
  if (wanted.filter) made.set("filter", wanted.filter);
  if (wanted.states.size) made.set("states", [...wanted.states].join(","));
  for (const name of wanted.open) made.append("open", name);
  if (!at("follow").checked) made.set("follow", "0");
  history.replaceState(null, "", `#${made}`);
}

function thumbnail(scene) {
  const cell = element("td", null, "thumb"), frame = element("div");
  cell.append(frame);
  if (scene.picture) {
    const image = element("img");
    Object.assign(image, { loading: "lazy", decoding: "async", width: 96, height: 72, alt: "", src: scene.picture });
    frame.append(image);
  }
  if (scene.video) {
    frame.addEventListener("pointerenter", (event) => event.pointerType !== "touch" && play(scene, frame));
    frame.addEventListener("pointerleave", (event) => event.pointerType !== "touch" && stop(frame));
    frame.addEventListener("click", () => (frame.querySelector("video") ? stop(frame) : play(scene, frame))); // a tap
  }
  return cell;
}
function play(scene, frame) {
  document.querySelectorAll("video").forEach((other) => other.remove()); // one at a time
  const video = element("video");
  Object.assign(video, { preload: "none", muted: true, loop: true, playsInline: true, src: scene.video });
  frame.append(video);
  video.play().catch(() => video.remove());
}
const stop = (frame) => frame.querySelector("video")?.remove();

function nameCell(scene) {
  const cell = element("td", null, "scene");
  if (scene.report) {
    const link = element("a", scene.name);
    link.href = scene.report;
    cell.append(link);
  } else cell.append(element("span", scene.name));
  if (scene.reason) cell.append(element("small", scene.reason, "bad"));
  else if (scene.stage) cell.append(element("small", scene.stage + (scene.worker ? ` on ${scene.worker}` : "")));
  return cell;
}

function row(scene) {
  const made = element("tr");
  made.append(thumbnail(scene), nameCell(scene));
  for (const column of columns.slice(1)) {
    const cell = element("td", column.key === "state" ? null : column.text(scene), column.kind || "word");
    cell.dataset.label = column.key === "state" || column.why ? "" : column.title;
    if (column.key === "state") cell.append(element("span", scene.state, `state ${scene.state}`));
    if (column.why && column.text(scene)) { cell.classList.add(GRADES.includes(column.text(scene)) ? column.text(scene) : "bad"); cell.title = column.why(scene); }
    made.append(cell);
  }
  const cell = element("td"), button = element("button", "…", "more");
  button.type = "button";
  button.setAttribute("aria-label", `Details of ${scene.name}`);
  button.setAttribute("aria-expanded", "false");
  button.addEventListener("click", () => toggle(scene));
  cell.append(button);
  made.append(cell);
  made.scene = scene;
  return made;
}

function entry(list, title, value) {
  if (!value) return;
  const item = element("dd");
  item.append(value instanceof Node ? value : document.createTextNode(value));
  list.append(element("dt", title), item);
}
function detailsRow(scene) {
  const made = element("tr", null, "details"), cell = element("td"), list = element("dl");
  cell.colSpan = columns.length + 2;
  entry(list, "reason", scene.reason);
  if (scene.lines.length) entry(list, "last lines", element("pre", scene.lines.join("\n")));
  entry(list, "result", scene.result_summary);
  entry(list, "cameras", scene.summary);
  for (const text of scene.warnings) entry(list, "warning", text);
  entry(list, "sources", scene.sources.join(", "));
  entry(list, "settings", scene.settings);
  const stages = scene.stages.map(([name, state, seconds]) => `${name} ${state === "done" ? duration(seconds) : state}`).join(", ");
  entry(list, "stages", stages);
  if (scene.attempts) entry(list, "failed attempts", String(scene.attempts));
  cell.append(list);
  made.append(cell);
  return made;
}
function toggle(scene, open = !scene.details) {
  if (open) {
    scene.details = detailsRow(scene);
    scene.row.after(scene.details);
    wanted.open.add(scene.name);
  } else {
    scene.details?.remove();
    scene.details = null;
    wanted.open.delete(scene.name);
  }
  scene.row.querySelector(".more").setAttribute("aria-expanded", String(open));
  writeAddress();
}

const words = (scene) => [scene.name, scene.state, scene.stage, scene.reason, scene.grade, scene.summary, scene.result, scene.result_summary, scene.settings, scene.worker, ...scene.warnings].filter(Boolean).join("\n").toLowerCase();
let visible = fleet.scenes;
function apply() {
  const terms = wanted.filter.toLowerCase().split(/\s+/).filter(Boolean);
  visible = fleet.scenes.filter((scene) => {
    const fits = (!wanted.states.size || wanted.states.has(scene.state)) && terms.every((term) => (scene.words ??= words(scene)).includes(term));
    scene.row.hidden = !fits;
    if (scene.details) scene.details.hidden = !fits;
    return fits;
  });
  at("count").textContent = visible.length === fleet.scenes.length ? `${visible.length} scenes` : `${visible.length} of ${fleet.scenes.length} scenes`;
  for (const button of at("states").children) button.setAttribute("aria-pressed", String(wanted.states.has(button.dataset.state)));
}
function compare(a, b) {
  if (a === null || a === undefined || b === null || b === undefined) return 0;
  return typeof a === "number" && typeof b === "number" ? a - b : String(a).localeCompare(String(b), undefined, { numeric: true });
}
function sort() {
  const column = columns.find((each) => each.key === wanted.sort);
  const missing = (value) => (value === null || value === undefined ? 1 : 0);
  const order = fleet.scenes.map((scene, place) => ({ scene, place, value: column ? column.of(scene) : place }));
  const sign = wanted.down ? -1 : 1;
  order.sort((a, b) => missing(a.value) - missing(b.value) || sign * compare(a.value, b.value) || a.place - b.place);
  const ordered = document.createDocumentFragment();
  for (const { scene } of order) {
    ordered.append(scene.row);
    if (scene.details) ordered.append(scene.details);
  }
  at("rows").replaceChildren(ordered);
  for (const cell of at("head").children) {
    if (!cell.dataset.key) continue;
    cell.setAttribute("aria-sort", cell.dataset.key !== wanted.sort ? "none" : wanted.down ? "descending" : "ascending");
  }
  at("order").value = wanted.sort;
}
function sortBy(column) {
  if (wanted.sort === column.key) wanted.down = !wanted.down;
  else [wanted.sort, wanted.down] = [column.key, Boolean(column.down)];
  sort();
  writeAddress();
}

function makeHead() {
  at("head").append(element("th"));
  at("order").append(new Option("in the manifest's order", ""));
  for (const column of columns) {
    const cell = element("th", null, column.kind === "n" ? "n" : ""), button = element("button", column.title);
    cell.scope = "col";
    cell.dataset.key = column.key;
    button.type = "button";
    button.addEventListener("click", () => sortBy(column));
    cell.append(button);
    at("head").append(cell);
    at("order").append(new Option(`by ${column.title}`, column.key));
  }
  at("head").append(element("th"));
  at("order").hidden = false;
  at("order").addEventListener("change", () => { [wanted.sort, wanted.down] = [at("order").value, Boolean(columns.find((each) => each.key === at("order").value)?.down)]; sort(); writeAddress(); });
}
function makeStates() {
  for (const state of STATES) {
    const count = fleet.totals[state];
    if (!count) continue;
    const part = element("i", null, state);
    part.style.width = `${(100 * count) / fleet.scenes.length}%`;
    at("share").append(part);
    const button = element("button", `${count} ${state}`);
    button.type = "button";
    button.dataset.state = state;
    button.addEventListener("click", () => {
      wanted.states.has(state) ? wanted.states.delete(state) : wanted.states.add(state);
      apply();
      writeAddress();
    });
    at("states").append(button);
  }
}
function makeFigures() {
  const mean = (values) => (values.length ? values.reduce((a, b) => a + b, 0) / values.length : null);
  const measured = fleet.scenes.map((scene) => scene.psnr).filter((value) => value !== null);
  const figures = [
    ["done", `${fleet.totals.done} of ${fleet.scenes.length}`],
    ["failed or quarantined", String(fleet.totals.failed + fleet.totals.quarantined)],
    ["end, forecast", fleet.running && fleet.forecast !== null ? `in ${duration(fleet.forecast)}` : ""],
    ["time of all stages", fleet.seconds ? duration(fleet.seconds) : ""],
    ["mean PSNR", measured.length ? `${mean(measured).toFixed(2)} dB of ${measured.length}` : ""],
    ["assets", fleet.bytes ? (fleet.bytes < 1e9 ? `${megabytes(fleet.bytes)} MB` : `${(fleet.bytes / 1e9).toFixed(1)} GB`) : ""],
  ];
  for (const [title, value] of figures) {
    if (!value) continue;
    const box = element("div");
    box.append(element("dt", title), element("dd", value));
    at("figures").append(box);
  }
  const time = (text) => { const date = new Date(text); return isNaN(date) ? text : date.toLocaleString(); };
  at("now").textContent = `${fleet.state}; ${fleet.executor}, ${fleet.slots} at a time; begun ${time(fleet.started)}, as of ${time(fleet.updated)}${fleet.note ? `; ${fleet.note}` : ""}`;
}

at("filter").addEventListener("input", () => { wanted.filter = at("filter").value; apply(); writeAddress(); });
at("follow").addEventListener("change", writeAddress);

readAddress();
at("filter").value = wanted.filter;
makeHead();
makeStates();
makeFigures();
for (const scene of fleet.scenes) scene.row = row(scene);
sort();
apply();
for (const scene of fleet.scenes) if (wanted.open.has(scene.name)) toggle(scene, true);
at("follow-label").hidden = !fleet.running;
if (fleet.running) setInterval(() => {
  const busy = document.querySelector("video") || document.activeElement === at("filter") || !getSelection().isCollapsed;
  if (at("follow").checked && !document.hidden && !busy) location.reload();
}, RELOAD);
})();
