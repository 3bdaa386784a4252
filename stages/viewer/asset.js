// A NerfTree file (FORMAT.md) of the layout `compact`, read without trusting it: what `enerf verify` refuses is refused here.

import { sha256 } from "./sha256.js";

export class FormatError extends Error {}

const SIZES = { U8: 1, U16: 2, U64: 8, F16: 2, F32: 4 };
const FARTHEST = 2 ** 40;
const isObject = (x) => typeof x === "object" && x !== null && !Array.isArray(x);

function refuse(text) {
  throw new FormatError(text);
}

const shown = (x) => String(x === undefined ? "missing" : JSON.stringify(x)).slice(0, 60);

// JSON as FORMAT.md wants it: finite numbers, no key twice.
function strictJson(text, what) {
  let value;
  try {
    value = JSON.parse(text);
  } catch {
    refuse(`${what} is not JSON`);
  }
  const open = [];
  for (const [token, string, sign] of text.matchAll(/("(?:[^"\\]|\\.)*")(\s*:)?|[{}[\]]/g)) {
    if (token === "{" || token === "[") open.push(token === "{" ? new Set() : null);
    else if (token === "}" || token === "]") open.pop();
    else if (sign !== undefined) {
      const keys = open[open.length - 1], key = JSON.parse(string);
      if (keys.has(key)) refuse(`${what} names the key ${shown(key)} twice`);
      keys.add(key);
    }
  }
  const rest = [value];
  while (rest.length) {
    const each = rest.pop();
    if (typeof each === "number" && !Number.isFinite(each)) refuse(`${what} holds a number that is not finite`);
    if (typeof each === "object" && each !== null) for (const inner of Object.values(each)) rest.push(inner);
  }
  if (!isObject(value)) refuse(`${what} is not a JSON object`);
  return value;
}

function number(meta, key, low, high, whole = false) {
  const x = meta[key];
  if (typeof x !== "number" || !(x >= low && x <= high) || (whole && !Number.isInteger(x))) {
    refuse(`metadata '${key}' is ${shown(x)}; expected a ${whole ? "whole " : ""}number from ${low} to ${high}`);
  }
  return x;
}

function numbers(meta, key, count, low, high) {
  const x = meta[key];
  if (!(Array.isArray(x) && x.length === count && x.every((n) => typeof n === "number" && n >= low && n <= high))) {
    refuse(`metadata '${key}' is ${shown(x)}; expected ${count} numbers from ${low} to ${high}`);
  }
  return x;
}

function cellsOf(meta) {
  const shape = numbers(meta, "shape", 3, 1, 65536);
  if (!shape.every(Number.isInteger) || shape[0] * shape[1] * shape[2] > 2 ** 30) refuse(`shape ${shown(shape)}; expected at most 2^30 cells`);
  return shape;
}

function containerOf(bytes) {
  if (bytes.length < 8) refuse(`${bytes.length} bytes; a NerfTree begins with an 8-byte header length`);
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.length), length = Number(view.getBigUint64(0, true));
  if (length > 2 ** 24 || 8 + length > bytes.length) refuse(`header of ${length} bytes in a file of ${bytes.length}; the file is cut short or is no NerfTree`);
  const raw = bytes.subarray(8, 8 + length);
  let marks = 0, text;
  for (const byte of raw) if (byte === 0x2c || byte === 0x5b || byte === 0x7b) marks++;
  if (marks > 2 ** 20) refuse("the header has more commas, brackets and braces than any NerfTree needs");
  try {
    text = new TextDecoder("utf-8", { fatal: true, ignoreBOM: true }).decode(raw);
  } catch {
    refuse("header is not UTF-8");
  }
  const header = strictJson(text, "header"), outside = header.__metadata__;
  if (!isObject(outside) || typeof outside.nerftree !== "string") refuse("a safetensors file without 'nerftree' metadata; not a NerfTree");
  const tensors = new Map(), start = 8 + length;
  for (const [name, entry] of Object.entries(header)) {
    if (name === "__metadata__") continue;
    const where = `tensor '${name.slice(0, 60)}'`, keys = isObject(entry) ? Object.keys(entry).sort().join() : "";
    if (keys !== "data_offsets,dtype,shape") refuse(`${where}: expected dtype, shape and data_offsets`);
    const { dtype, shape, data_offsets: offsets } = entry;
    const counts = (x) => Array.isArray(x) && x.length <= 8 && x.every((n) => Number.isInteger(n) && n >= 0 && n < 2 ** 48);
    if (!counts(shape)) refuse(`${where}: shape ${shown(shape)} is not a list of counts`);
    if (!counts(offsets) || offsets.length !== 2 || offsets[0] > offsets[1]) refuse(`${where}: data_offsets ${shown(offsets)} are not a range`);
    if (start + offsets[1] > bytes.length) refuse(`${where}: ends beyond the end of the file; the file is cut short`);
    if (Object.hasOwn(SIZES, dtype) && shape.reduce((a, b) => a * b, 1) * SIZES[dtype] !== offsets[1] - offsets[0]) {
      refuse(`${where}: ${dtype} of shape ${shown(shape)} does not fill its ${offsets[1] - offsets[0]} bytes`);
    }
    tensors.set(name, { dtype, shape, begin: offsets[0], end: offsets[1], bytes: bytes.subarray(start + offsets[0], start + offsets[1]) });
  }
  let at = 0;
  for (const [name, each] of [...tensors].sort(([, a], [, b]) => a.begin - b.begin || a.end - b.end)) {
    if (each.begin !== at) refuse(`tensor '${name.slice(0, 60)}' begins at ${each.begin}, expected ${at}; tensors must lie end to end`);
    at = each.end;
  }
  if (start + at !== bytes.length) refuse(`${bytes.length - start - at} bytes after the last tensor; the file was appended to`);
  return { tensors, meta: strictJson(outside.nerftree, "metadata") };
}

function rotationOf(rows, what) {
  if (!(Array.isArray(rows) && rows.length === 3)) refuse(`metadata '${what}' is ${shown(rows)}; expected three rows`);
  for (const row of rows) numbers({ [what]: row }, what, 3, -2, 2);
  const [a, b, c] = rows, dot = (x, y) => x[0] * y[0] + x[1] * y[1] + x[2] * y[2];
  const cross = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const near = (x, y) => Math.abs(x - y) <= 2e-4;
  if (![a, b, c].every((x) => near(dot(x, x), 1)) || !near(dot(a, b), 0) || !near(dot(a, c), 0) || !near(dot(b, c), 0) || dot(cross, c) < 0) {
    refuse(`metadata '${what}' is not a rotation`);
  }
}

function checkNesting(grids, brick) {
  for (let n = 1; n < grids.length; n++) {
    const inner = grids[n - 1], outer = grids[n];
    for (let axis = 0; axis < 3; axis++) {
      const side = outer.voxel * brick, low = (inner.low[axis] - outer.low[axis]) / side;
      const high = low + (inner.shape[axis] * brick * inner.voxel) / side;
      if (Math.max(Math.abs(low - Math.round(low)), Math.abs(high - Math.round(high))) > 1e-3) {
        refuse(`the box of cascade ${n - 1} does not lie on faces of the coarse cells of cascade ${n}`);
      }
      if (Math.round(low) < 0 || Math.round(high) > outer.shape[axis]) refuse(`cascade ${n} does not enclose cascade ${n - 1}`);
    }
  }
}

function checkFrame(meta, unit) {
  for (const key of ["world_from_capture", "orbit"]) {
    if (key in meta && !isObject(meta[key])) refuse(`metadata '${key}' is ${shown(meta[key])}; expected an object`);
  }
  if ("metric" in meta && typeof meta.metric !== "boolean") refuse(`metadata 'metric' is ${shown(meta.metric)}; expected true or false`);
  if (meta.world_from_capture) {
    number(meta.world_from_capture, "scale", 1e-30, 1e30);
    numbers(meta.world_from_capture, "translation", 3, -1e30, 1e30);
    rotationOf(meta.world_from_capture.rotation, "rotation");
  }
  if (meta.orbit) {
    const far = FARTHEST * unit;
    numbers(meta.orbit, "centre", 3, -far, far);
    number(meta.orbit, "radius", 1e-30, far);
    number(meta.orbit, "elevation", -90, 90);
    number(meta.orbit, "heading", -360, 360);
    if (typeof meta.orbit.forward_facing !== "boolean") refuse(`metadata 'forward_facing' is ${shown(meta.orbit.forward_facing)}; expected true or false`);
  }
}

function checkSpiral(spiral, unit) {
  if (!isObject(spiral)) refuse(`metadata 'spiral' is ${shown(spiral)}; expected an object`);
  const far = FARTHEST * unit;
  if ("radii" in spiral) numbers(spiral, "radii", 3, 0, far);
  for (const key of ["focus", "far"]) if (key in spiral) number(spiral, key, unit / FARTHEST, far);
  if ("tangents" in spiral) numbers(spiral, "tangents", 2, 1e-6, 1e6);
}

function ndcOf(meta) {
  const found = meta.ndc;
  if (!isObject(found)) refuse(`metadata 'ndc' is ${shown(found)}; expected an object`);
  for (const key of ["focal", "width", "height", "near"]) number(found, key, 1e-30, 1e30);
  const rows = found.world_from_camera;
  if (!(Array.isArray(rows) && rows.length === 4)) refuse(`metadata 'world_from_camera' is ${shown(rows)}; expected four rows`);
  for (const row of rows) numbers({ world_from_camera: row }, "world_from_camera", 4, -1e30, 1e30);
  rotationOf(rows.slice(0, 3).map((row) => row.slice(0, 3)), "world_from_camera");
  if (rows[3].join() !== "0,0,0,1") refuse("the reference camera's pose is no rigid motion");
  const slopes = [(2 * found.focal) / found.width, (2 * found.focal) / found.height];
  if (!slopes.every((x) => x >= 1e-6 && x <= 1e6)) refuse(`metadata 'ndc': 2 f / w and 2 f / h are ${shown(slopes)}`);
  if (!rows.slice(0, 3).every((row) => Math.abs(row[3]) <= FARTHEST * found.near)) refuse("the reference camera is too far from the world's origin");
  return { rows, slopes, near: found.near };
}

function regionOf(meta, minor) {
  if (minor < 4 || !("region" in meta)) return null;
  const found = meta.region;
  if (!isObject(found)) refuse(`metadata 'region' is ${shown(found)}; expected an object`);
  const far = FARTHEST * meta.voxel, { bounds } = found;
  if (!(Array.isArray(bounds) && bounds.length === 2)) refuse(`metadata 'region': 'bounds' is ${shown(bounds)}; expected two corners`);
  for (const corner of bounds) numbers({ bounds: corner }, "bounds", 3, -far, far);
  if (!bounds[0].every((x, axis) => x < bounds[1][axis])) refuse("metadata 'region': expected the least corner, then the greatest");
  number(found, "corner_radius", 0, far);
  number(found, "fade", 0, far);
  if (typeof found.bricks !== "boolean") refuse(`metadata 'region': 'bricks' is ${shown(found.bricks)}; expected true or false`);
  return { low: bounds[0], high: bounds[1], radius: found.corner_radius, fade: found.fade, named: found.bricks, bricks: null };
}

// What the metadata say, checked; tensors are not looked at. `compact`: whether the asset is of this layout, and is to be read.
export function structureOf(meta, compact = true) {
  if (meta.format !== "nerftree") refuse(`metadata 'format' is ${shown(meta.format)}; expected nerftree`);
  const version = /^([0-9]{1,5})\.([0-9]{1,5})$/.exec(String(meta.format_version));
  if (!version) refuse(`format version ${shown(meta.format_version)}; expected MAJOR.MINOR`);
  if (Number(version[1]) !== 1) refuse(`format version ${meta.format_version}; this page reads 1.x`);
  const layout = /^(nearest-)?(ndc-|nested-)?(sparse|compact|packed|full)$/.exec(String(meta.layout));
  if (!layout) refuse(`layout ${shown(meta.layout)}; this page reads compact`);
  const nearest = layout[1] !== undefined, nested = layout[2] === "nested-", minor = Number(version[2]);
  if (meta.sh_convention !== "real-orthonormal-plenoctree" || meta.colour_space !== "srgb-sigmoid") {
    refuse(`harmonics ${shown(meta.sh_convention)} in ${shown(meta.colour_space)}; expected real-orthonormal-plenoctree in srgb-sigmoid`);
  }
  const shape = cellsOf(meta), brick = number(meta, "brick", 1, 16, true), degree = number(meta, "sh_degree", 0, 4, true);
  const voxel = number(meta, "voxel", 1e-30, 1e30), far = FARTHEST * voxel;
  const grids = [{ shape, voxel, low: numbers(meta, "bounds_min", 3, -far, far) }];
  if (!("background" in meta)) refuse("metadata 'background' is missing; expected three numbers or null");
  const background = meta.background === null ? null : numbers(meta, "background", 3, 0, 1);
  const lookup = "lookup" in meta ? meta.lookup : nearest ? undefined : "trilinear";
  if (lookup !== (nearest ? "nearest" : "trilinear")) refuse(`metadata 'lookup' is ${shown(lookup)}; expected ${nearest ? "nearest" : "trilinear"}`);
  const step = "step_size" in meta ? number(meta, "step_size", 0.25, 1) : 0.5;
  let rows = 0;
  if (nested) {
    const found = meta.cascades;
    if (!(Array.isArray(found) && found.length < 16 && found.every(isObject))) refuse(`metadata 'cascades' is ${shown(found)}; expected at most 15 objects`);
    found.forEach((each, n) => grids.push({ shape: cellsOf(each), voxel: voxel * 2 ** (n + 1), low: numbers(each, "bounds_min", 3, -far, far) }));
    checkNesting(grids, brick);
    if (!("environment" in meta)) refuse("metadata 'environment' is missing; expected the rows of the map or null");
    rows = meta.environment === null ? 0 : number(meta, "environment", 1, 2048, true);
  }
  if (grids.reduce((sum, { shape: [x, y, z] }) => sum + x * y * z, 0) > 2 ** 30) refuse("more than 2^30 coarse cells");
  const region = regionOf(meta, minor), ndc = layout[2] === "ndc-" ? ndcOf(meta) : null;
  checkFrame(meta, ndc ? ndc.near : voxel);
  if (ndc && "spiral" in meta) checkSpiral(meta.spiral, ndc.near);
  if (!compact) return { meta, grids, brick, background, region, ndc };
  if (layout[3] !== "compact") refuse(`layout ${meta.layout}; this page reads compact. 'enerf convert' makes it`);
  const harmonics = (degree + 1) ** 2, groups = meta.sh_groups;
  if (!(Array.isArray(groups) && groups.every((n) => Number.isInteger(n) && n > 0) && groups.reduce((a, b) => a + b, 0) === harmonics - 1)) {
    refuse(`metadata 'sh_groups' is ${shown(groups)}; expected whole numbers above 0 whose sum is ${harmonics - 1}`);
  }
  return { meta, nearest, grids, brick, degree, harmonics, groups, background, step, rows, region, ndc };
}

function expectedTensors(tree, tensors) {
  const first = (name) => tensors.get(name)?.shape?.[0] ?? -1;
  const bricks = first("brick.mask"), count = first("voxel.density"), expected = new Map();
  tree.grids.forEach(({ shape: [x, y, z] }, n) => expected.set(n ? `coarse.occupancy.${n}` : "coarse.occupancy", [["U8"], [Math.ceil((x * y * z) / 8)]]));
  expected.set("brick.mask", [["U64"], [bricks, Math.ceil(tree.brick ** 3 / 64)]]);
  expected.set("voxel.density", [["U8"], [count]]);
  expected.set("voxel.base", [["U8"], [count, 3]]);
  expected.set("voxel.sh", [["U8", "U16"], [count, tree.groups.length]]);
  expected.set("density.table", [["F32"], [first("density.table")]]);
  expected.set("base.table", [["F32"], [first("base.table"), 3]]);
  expected.set("sh.palette", [["F16"], [first("sh.palette"), tree.harmonics - 1, 3]]);
  if (tree.rows) expected.set("environment", [["U8"], [tree.rows, 2 * tree.rows, 3]]);
  if (tree.region?.named) expected.set("x.region.bricks", [["U8"], [Math.ceil(bricks / 8)]]);
  return expected;
}

function checkMemory(tree, tensors, size) {
  const cells = tree.grids.reduce((sum, { shape: [x, y, z] }) => sum + x * y * z, 0);
  const sh = tensors.get("voxel.sh"), palette = tensors.get("sh.palette").shape;
  const each = 23 + sh.shape[1] * SIZES[sh.dtype] + (tree.nearest ? 12 * tree.harmonics : 0);
  const bricks = tensors.get("brick.mask").shape[0], voxels = tensors.get("voxel.density").shape[0];
  const needed = 6 * cells + (5 * tree.brick ** 3 + 72) * bricks + each * voxels + 28 * palette[0] * palette[1] + 24 * tree.rows ** 2;
  if (needed > 8 * size + 2e8) refuse(`${(size / 1e6).toFixed(1)} MB that take ${(needed / 1e6).toFixed(0)} MB of memory; its cells or bricks are nearly all empty`);
}

export function halfToFloat(half) {
  const exponent = (half >> 10) & 31, fraction = half & 1023, sign = half & 0x8000 ? -1 : 1;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -24 * fraction);
}

function floats(tensor) {
  if (tensor.dtype === "F32") return new Float32Array(tensor.bytes.slice().buffer);
  return Float32Array.from(new Uint16Array(tensor.bytes.slice().buffer), halfToFloat);
}

function checkBits(bytes, count, name) {
  const last = count % 8;
  if (last && bytes[bytes.length - 1] >> last) refuse(`'${name}' has bits set beyond its ${count}`);
}

function checkCodes(name, codes, entries) {
  let most = -1;
  for (let n = 0; n < codes.length; n++) if (codes[n] > most) most = codes[n];
  if (most >= entries) refuse(`'${name}' holds the code ${most}; expected codes below ${entries}`);
}

const BITS = Uint8Array.from({ length: 256 }, (_, n) => n.toString(2).replaceAll("0", "").length);

function countBits(bytes) {
  let sum = 0;
  for (let n = 0; n < bytes.length; n++) sum += BITS[bytes[n]];
  return sum;
}

// The tree of a file's bytes. Raises FormatError. `progress` is told a share from 0 to 1, and awaited.
export async function readAsset(bytes, progress = async () => {}) {
  const { tensors, meta } = containerOf(bytes), tree = structureOf(meta), expected = expectedTensors(tree, tensors);
  for (const name of tensors.keys()) {
    if (!expected.has(name) && !name.startsWith("x.")) refuse(`unknown tensor '${name.slice(0, 60)}'; only names that begin with 'x.' may be ignored`);
  }
  for (const [name, [types, shape]] of expected) {
    const found = tensors.get(name);
    if (!found) refuse(`tensor '${name}' is missing`);
    if (!types.includes(found.dtype)) refuse(`tensor '${name}' is ${shown(found.dtype)}; expected ${types.join(" or ")}`);
    if (found.shape.join() !== shape.join()) refuse(`tensor '${name}' has shape ${shown(found.shape)}; expected ${shown(shape)}`);
  }
  for (const [name, most] of [["density.table", 256], ["base.table", 256], ["sh.palette", 65536]]) {
    if (tensors.get(name).shape[0] > most) refuse(`tensor '${name}' has ${tensors.get(name).shape[0]} entries; expected at most ${most}`);
  }
  checkMemory(tree, tensors, bytes.length);
  let done = 0;
  for (const name of expected.keys()) {
    const tensor = tensors.get(name), want = isObject(meta.sha256) ? meta.sha256[name] : undefined;
    if ((await sha256(tensor.bytes)) !== want) refuse(`tensor '${name}' does not have the SHA-256 that the file states; it is damaged or was altered`);
    done += tensor.bytes.length;
    await progress(done / bytes.length);
  }
  return { ...tree, ...valuesOf(tree, tensors) };
}

function valuesOf(tree, tensors) {
  const raw = (name) => tensors.get(name).bytes, bricks = tensors.get("brick.mask").shape[0], count = tensors.get("voxel.density").shape[0];
  let owned = 0;
  const occupancy = tree.grids.map(({ shape: [x, y, z] }, n) => {
    const name = n ? `coarse.occupancy.${n}` : "coarse.occupancy";
    checkBits(raw(name), x * y * z, name);
    owned += countBits(raw(name));
    return raw(name);
  });
  if (owned !== bricks) refuse(`${owned} occupied cells but ${bricks} brick masks`);
  const masks = raw("brick.mask"), row = 8 * Math.ceil(tree.brick ** 3 / 64), cube = tree.brick ** 3;
  for (let n = 0; cube % 64 && n < bricks; n++) {
    for (let byte = cube >> 3; byte < row; byte++) {
      if (masks[n * row + byte] >> Math.max(0, cube - 8 * byte)) refuse(`'brick.mask' has bits set beyond the ${cube} voxels of a brick`);
    }
  }
  const named = countBits(masks);
  if (named !== count) refuse(`masks name ${named} voxels but ${count} are stored`);
  const sh = tensors.get("voxel.sh"), wide = sh.dtype === "U16", codes = sh.bytes.slice();
  const densityTable = floats(tensors.get("density.table")), baseTable = floats(tensors.get("base.table")), palette = floats(tensors.get("sh.palette"));
  if (!densityTable.every((x) => Number.isFinite(x) && x >= 0) || !baseTable.every(Number.isFinite) || !palette.every(Number.isFinite)) {
    refuse("densities must be finite and not negative, harmonics finite");
  }
  checkCodes("voxel.density", raw("voxel.density"), densityTable.length);
  checkCodes("voxel.base", raw("voxel.base"), baseTable.length / 3);
  checkCodes("voxel.sh", wide ? new Uint16Array(codes.buffer) : codes, tensors.get("sh.palette").shape[0]);
  const { region } = tree;
  if (region?.named) {
    checkBits(raw("x.region.bricks"), bricks, "x.region.bricks");
    region.bricks = raw("x.region.bricks");
  }
  return {
    bricks, count, occupancy, masks, maskBytes: row, density: raw("voxel.density"), densityTable, base: raw("voxel.base"), baseTable,
    codes, codeBytes: wide ? 2 : 1, palette, paletteEntries: tensors.get("sh.palette").shape[0], environment: tree.rows ? raw("environment") : null,
  };
}
