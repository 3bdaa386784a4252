// 3D Gaussians of an SPZ file, drawn as `efficientnerf.splats.rendering` does: sorted and projected once a picture, into textures, then blended from back to
// front, a square each, without instances: software renderers draw those one by one.

import { FormatError, structureOf } from "./asset.js";
import { dot } from "./camera.js";
import { Renderer, UNITS } from "./renderer.js";
import { BASIS, SCALE, VERTEX, programOf } from "./shader.js";
import { sha256 } from "./sha256.js";
import { insideShare } from "./volume.js";

const NEAR = 0.05, BESIDE = 0.15, LOW_PASS = 0.3; // as the CPU has them
const AXES = [0, 1, 2];
const SLANT = 1.3, SOFT = 2; // how much longer a Gaussian off the axis is drawn than it is; pixels that LOW_PASS adds
const ROUGH = 0.3; // pixels, the size of Gaussians that are left out while the eye moves
const SQUARE = [0, 1, 2, 2, 1, 3]; // its corners, of two triangles
const HEADER = 16, ROW = 512, HARMONICS = 23; // bytes of the file's header; Gaussians in a row of the texture; where their codes begin in one's texels

// What the page carries, checked: the tree of its asset's metadata, and a texture's rows: place (3 x int32), opacity, colour, rotation, scales, harmonics.
export async function readSplats(bytes, { sha256: digest, meta, frame }) {
  if ((await sha256(bytes)) !== digest) throw new FormatError("the Gaussians do not have the SHA-256 that the page states; the page is damaged");
  const view = new DataView(bytes.buffer), count = view.getUint32(8, true), degree = bytes[12], each = 3 * ((degree + 1) ** 2 - 1);
  const texels = Math.ceil((HARMONICS + each) / 16), rows = new Uint8Array(16 * texels * ROW * Math.ceil(count / ROW)), places = new Float32Array(3 * count);
  const out = new Int32Array(rows.buffer), sections = [[12, 1], [13, 3], [20, 3], [16, 4], [HARMONICS, each]];
  for (let n = 0, from = HEADER, unit = 2 ** -bytes[13]; n < 3 * count; n++, from += 3) {
    const place = ((bytes[from] << 8) | (bytes[from + 1] << 16) | (bytes[from + 2] << 24)) >> 8;
    places[n] = place * unit;
    out[4 * texels * Math.floor(n / 3) + (n % 3)] = place;
  }
  let from = HEADER + 9 * count;
  for (const [to, size] of sections) for (let n = 0; n < count; n++) for (let k = 0; k < size; k++) rows[16 * texels * n + to + k] = bytes[from++];
  const extents = new Float32Array(2 * count);
  for (let n = 0; n < count; n++) {
    const at = 16 * texels * n, [, middle, most] = rows.slice(at + 20, at + 23).sort(), opacity = rows[at + 12] / 255;
    extents[2 * n] = SLANT * Math.exp(most / 16 - 10) * Math.sqrt(2 * Math.log(Math.max(255 * opacity, 1)));
    extents[2 * n + 1] = Math.exp((middle + most) / 32 - 10) * Math.sqrt(opacity);
  }
  return { ...structureOf(meta, false), environment: null, count, degree, splats: { frame, texels, rows, places, extents, unit: 2 ** -bytes[13] } };
}

// The numbers of the Gaussians that may show, the farthest first: a counting sort of the bits of their depths. A worker runs its text.
// planes: rows [a, b, c, d] in the file's frame, to the inside; the first gives depths. extents: how far a Gaussian reaches over a side plane, and its size.
// least: size at a depth of 1.
function backToFront(places, extents, [[a, b, c, d], ...sides], near, least) {
  const count = extents.length / 2, depths = new Float32Array(count), keys = new Uint32Array(depths.buffer), starts = new Uint32Array(65537);
  let low = 2 ** 32, high = 0, shown = 0;
  for (let n = 0; n < count; n++) {
    const x = places[3 * n], y = places[3 * n + 1], z = places[3 * n + 2], depth = a * x + b * y + c * z + d;
    if (!(depth > near) || extents[2 * n + 1] < least * depth || sides.some(([a, b, c, d]) => a * x + b * y + c * z + d < -extents[2 * n])) continue;
    depths[n] = depth;
    if (keys[n] < low) low = keys[n];
    if (keys[n] > high) high = keys[n];
    shown++;
  }
  const order = new Uint32Array(shown), scale = 65535 / Math.max(1, high - low);
  for (let n = 0; n < count; n++) if (keys[n]) starts[(keys[n] = 65535 - Math.floor((keys[n] - low) * scale) + 1)]++;
  for (let n = 1; n < 65537; n++) starts[n] += starts[n - 1];
  for (let n = count - 1; n >= 0; n--) if (keys[n]) order[--starts[keys[n]]] = n;
  return order;
}

const WORKER = `${backToFront}
let places, extents;
onmessage = ({ data }) => {
  if (data.places) ({ places, extents } = data);
  else postMessage(backToFront(places, extents, data.planes, ${NEAR}, data.least));
};`;

// How a view of so many pixels sees what is in the file's frame: rows `turn` and `shift` to the camera, the eye in that frame, the world's units in one of it,
// and the least and greatest x / z and y / z up to which derivatives of the projection follow the means.
function cameraOf(frame, { rotation: r, eye, lens }, width, height) {
  const [fx, fy, cx, cy] = lens, away = frame.map((row, axis) => row[3] - eye[axis]), camera = (column, of) => AXES.reduce((sum, axis) => sum + r[axis][column] * of(axis), 0);
  const turn = AXES.map((row) => AXES.map((column) => camera(row, (axis) => frame[axis][column]))), shift = AXES.map((row) => camera(row, (axis) => away[axis]));
  const square = AXES.reduce((sum, axis) => sum + frame[axis][0] ** 2, 0), own = AXES.map((column) => AXES.reduce((sum, axis) => sum - (frame[axis][column] * away[axis]) / square, 0));
  const [x, y] = [(BESIDE * width) / fx, (BESIDE * height) / fy];
  return { turn, shift, own, size: Math.sqrt(square), lens, limits: [-cx / fx - x, -cy / fy - y, (width - cx) / fx + x, (height - cy) / fy + y] };
}

// The planes of `backToFront` for a picture with `spare` pixels round it.
function planesOf({ turn, shift, size }, [fx, fy, cx, cy], width, height, spare) {
  // What is between a side of the picture and its middle, in the units of the file.
  const inside = (axis, sign, slope) => {
    const scale = sign / size / Math.hypot(1, slope), [one, z] = [turn[axis], turn[2]];
    return [...one.map((x, column) => (x - slope * z[column]) * scale), (shift[axis] - slope * shift[2]) * scale];
  };
  const across = [inside(0, 1, (-cx - spare) / fx), inside(0, -1, (width - cx + spare) / fx)];
  return [[...turn[2], shift[2]], ...across, inside(1, 1, (-cy - spare) / fy), inside(1, -1, (height - cy + spare) / fy)];
}

// Of a Gaussian at a point of the picture: its alpha, as `projection` and PAINT have it, and the depth at which it is densest along the point's ray. For that its
// standard deviations have the low-pass of its picture, too: the ray may pass by a Gaussian that is thinner than a pixel.
function alongRay({ splats: { frame, texels, rows, unit } }, number, { turn, shift, lens: [fx, fy, cx, cy], limits }, x, y, region) {
  const at = 16 * texels * number, view = new DataView(rows.buffer, at), mean = AXES.map((axis) => view.getInt32(4 * axis, true) * unit);
  const p = turn.map((row, axis) => dot(row, mean) + shift[axis]), code = view.getUint32(16, true), which = code >>> 30;
  const three = [20, 10, 0].map((low) => ((((code >>> low) & 511) * Math.SQRT1_2) / 511) * (1 - 2 * ((code >>> (low + 9)) & 1)));
  const [i, j, k, w] = [...three.slice(0, which), Math.sqrt(Math.max(0, 1 - dot(three, three))), ...three.slice(which)];
  const own = [
    [1 - 2 * (j * j + k * k), 2 * (i * j + k * w), 2 * (i * k - j * w)],
    [2 * (i * j - k * w), 1 - 2 * (i * i + k * k), 2 * (k * j + i * w)],
    [2 * (i * k + j * w), 2 * (k * j - i * w), 1 - 2 * (i * i + j * j)],
  ];
  const root = own.map((axis, n) => turn.map((row) => dot(row, axis) * Math.exp(rows[at + 20 + n] / 16 - 10)));
  const slope = [0, 1].map((axis) => Math.min(Math.max(p[axis] / p[2], limits[axis]), limits[axis + 2]));
  const [u, v] = [0, 1].map((axis) => root.map((each) => ([fx, fy][axis] / p[2]) * (each[axis] - slope[axis] * each[2])));
  const a = dot(u, u) + LOW_PASS, b = dot(u, v), c = dot(v, v) + LOW_PASS, dx = x - (fx * p[0]) / p[2] - cx, dy = y - (fy * p[1]) / p[2] - cy;
  const across = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]], determinant = dot(across, across) + LOW_PASS * (a + c - LOW_PASS);
  const share = region ? insideShare(region, ...frame.map((row) => dot(row, mean) + row[3])) : 1;
  const alpha = Math.min(0.99, ((share * rows[at + 12]) / 255) * Math.exp((-0.5 * (c * dx * dx - 2 * b * dx * dy + a * dy * dy)) / determinant));
  const ray = [(x - cx) / fx, (y - cy) / fy, 1], sums = [0, 0];
  for (const each of root) {
    const square = dot(each, each), weight = dot(ray, each) / square / (square + LOW_PASS * (p[2] / fx) ** 2);
    sums[0] += weight * dot(p, each);
    sums[1] += weight * dot(ray, each);
  }
  return { alpha: alpha < 1 / 255 ? 0 : alpha, depth: sums[0] / sums[1] };
}

function projection({ degree, splats: { texels, unit } }) {
  const code = (byte) => `float((w${byte >> 4}.${"xyzw"[(byte >> 2) & 3]} >> ${8 * (byte & 3)}u) & 255u)`;
  const term = ([factor, text], k) => `  colour += ${factor.toFixed(9)} * ${text} / 128.0 * (vec3(${[0, 1, 2].map((c) => code(HARMONICS + 3 * (k - 1) + c))}) - 128.0);`;
  return `#version 300 es
precision highp float; precision highp int; precision highp usampler2D;
uniform usampler2D order, gaussians;
uniform mat3 turn, world;               // from the file to the camera, and to the world; with its scale
uniform vec3 shift, eye, origin;        // of the camera; of the eye in the file; of the world
uniform vec4 lens, limits;
uniform vec2 range;
uniform int mode;
uniform bool inRegion;                  // of which alone is drawn, see insideShare
uniform mat3 box;
uniform vec3 boxOrigin, middle, reach;
uniform vec2 soft;                      // radius of the corners, width of the band
uniform int count;
layout(location = 0) out uvec4 place;   // centre in pixels, first column of a root of the covariance
layout(location = 1) out uvec4 paint;   // the second column, below; colour and opacity
${SCALE}
void main() {
  ivec2 target = ivec2(gl_FragCoord.xy);
  if (target.y * ${ROW} + target.x >= count) discard;
  int number = int(texelFetch(order, target, 0).r), at = number % ${ROW} * ${texels}, row = number / ${ROW};
${Array.from({ length: texels }, (_, n) => `  uvec4 w${n} = texelFetch(gaussians, ivec2(at + ${n}, row), 0);`).join("\n")}
  vec3 mean = vec3(ivec3(w0.xyz)) * float(${unit}), p = turn * mean + shift, size = exp(vec3(${[20, 21, 22].map(code)}) / 16.0 - 10.0);
  vec3 three = vec3((w1.xxx >> uvec3(20u, 10u, 0u)) & 511u) * ${(Math.SQRT1_2 / 511).toFixed(12)} * (1.0 - 2.0 * vec3((w1.xxx >> uvec3(29u, 19u, 9u)) & 1u));
  float most = sqrt(max(0.0, 1.0 - dot(three, three)));
  uint which = w1.x >> 30;
  vec4 q = which == 0u ? vec4(most, three) : which == 1u ? vec4(three.x, most, three.yz) : which == 2u ? vec4(three.xy, most, three.z) : vec4(three, most);
  vec3 x = q.x * q.xyz, z = q.z * q.xyz, u = q.w * q.xyz;
  float yy = q.y * q.y;
  mat3 own = mat3(1.0 - 2.0 * (yy + z.z), 2.0 * (x.y + u.z), 2.0 * (x.z - u.y), 2.0 * (x.y - u.z), 1.0 - 2.0 * (x.x + z.z), 2.0 * (z.y + u.x),
    2.0 * (x.z + u.y), 2.0 * (z.y - u.x), 1.0 - 2.0 * (x.x + yy));
  mat3 root = turn * own * mat3(size.x, 0, 0, 0, size.y, 0, 0, 0, size.z);
  vec2 plane = clamp(p.xy / p.z, limits.xy, limits.zw);
  mat3 rows = transpose(root);
  vec3 i = lens.x / p.z * (rows[0] - plane.x * rows[2]), j = lens.y / p.z * (rows[1] - plane.y * rows[2]), across = cross(i, j);
  float a = dot(i, i) + ${LOW_PASS}, b = dot(i, j);
  float determinant = dot(across, across) + ${LOW_PASS} * (a + dot(j, j)); // not a difference of products: needles would lose their digits
  place = floatBitsToUint(vec4(lens.xy * p.xy / p.z + lens.zw, sqrt(a), b / sqrt(a)));
  float opacity = ${code(12)} / 255.0;
  if (inRegion) {
    vec3 v = abs(box * (world * mean + origin) + boxOrigin - middle) - reach;
    float round = min(soft.x, min(reach.x, reach.y));
    vec2 plan = v.xy + round;
    float inside = -max(length(max(plan, 0.0)) + min(max(plan.x, plan.y), 0.0) - round, v.z);
    opacity *= smoothstep(0.0, soft.y, inside);
  }
  vec3 d = normalize(mean - eye), colour = 0.5 + (vec3(${[13, 14, 15].map(code)}) / 255.0 - 0.5) / 0.15 * ${BASIS[0][0].toFixed(9)};
  if (mode == 0) {
    float xx = d.x * d.x, yy = d.y * d.y, zz = d.z * d.z;
${BASIS.slice(1, (degree + 1) ** 2).map((basis, k) => term(basis, k + 1)).join("\n")}
  } else if (mode == 1) colour = scale(clamp((1.0 / range.x - 1.0 / max(p.z, range.x)) / (1.0 / range.x - 1.0 / range.y), 0.0, 1.0));
  else if (mode == 2) {
    vec3 n = world * (size.x < min(size.y, size.z) ? own[0] : size.y < size.z ? own[1] : own[2]);
    colour = 0.5 - 0.5 * normalize(n) * sign(dot(n, world * d));
  }
  colour = max(colour, 0.0);
  paint = uvec4(floatBitsToUint(sqrt(determinant / a)), packHalf2x16(colour.rg), packHalf2x16(vec2(colour.b, opacity)), 0u);
}`;
}

const SQUARES = `#version 300 es
precision highp float;
precision highp int; precision highp usampler2D;
uniform usampler2D places, paints;
uniform vec2 size;
out vec2 at;
flat out vec4 colour;
void main() {
  int number = gl_VertexID / 4, corner = gl_VertexID % 4;
  ivec2 from = ivec2(number % ${ROW}, number / ${ROW});
  vec4 place = uintBitsToFloat(texelFetch(places, from, 0));
  uvec3 paint = texelFetch(paints, from, 0).xyz;
  colour = vec4(unpackHalf2x16(paint.y), unpackHalf2x16(paint.z));
  at = vec2(2 * (corner & 1) - 1, (corner & 2) - 1) * sqrt(max(0.0, 2.0 * log(255.0 * colour.a)));
  vec2 pixel = place.xy + vec2(place.z * at.x, place.w * at.x + uintBitsToFloat(paint.x) * at.y);
  gl_Position = vec4((2.0 * pixel / size - 1.0) * vec2(1, -1), 0, 1);
}`;

const PAINT = `#version 300 es
precision highp float;
in vec2 at;
flat in vec4 colour;
out vec4 result;
void main() {
  float alpha = min(0.99, colour.a * exp(-0.5 * dot(at, at)));
  if (alpha < 1.0 / 255.0) discard;
  result = vec4(colour.rgb * alpha, alpha);
}`;

export class SplatRenderer extends Renderer {
  load(tree, region) {
    this.region = region;
    if (this.tree) return 0;
    const { gl } = this, { texels, rows, places, extents } = tree.splats;
    const height = rows.length / (16 * texels * ROW), first = programOf(gl, VERTEX, projection(tree)), program = programOf(gl, SQUARES, PAINT);
    Object.assign(this, { tree, first, program, projected: gl.createFramebuffer(), numbers: new Uint32Array(ROW * height) });
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.projected);
    ["gaussians", "order", "places", "paints"].forEach((name, n) => {
      this._texture(UNITS[n], gl.TEXTURE_2D, gl.NEAREST);
      gl.texStorage2D(gl.TEXTURE_2D, 1, n === 1 ? gl.R32UI : gl.RGBA32UI, ROW * (n ? 1 : texels), height);
      if (n > 1) gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0 + n - 2, gl.TEXTURE_2D, this.textures[UNITS[n]], 0);
      const user = n > 1 ? program : first;
      gl.useProgram(user);
      gl.uniform1i(gl.getUniformLocation(user, name), n);
    });
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, Uint32Array.from({ length: 6 * tree.count }, (_, n) => 4 * Math.floor(n / 6) + SQUARE[n % 6]), gl.STATIC_DRAW);
    gl.drawBuffers([gl.COLOR_ATTACHMENT0, gl.COLOR_ATTACHMENT1]);
    gl.activeTexture(gl.TEXTURE0);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW * texels, height, gl.RGBA_INTEGER, gl.UNSIGNED_INT, new Uint32Array(rows.buffer));
    try {
      this.worker = new Worker(URL.createObjectURL(new Blob([WORKER], { type: "text/javascript" })));
      this.worker.onmessage = ({ data }) => Object.assign(this, { order: data, sorting: false });
      this.worker.onerror = () => Object.assign(this, { worker: null });
      this.worker.postMessage({ places, extents });
    } catch {
      this.worker = null; // sorted here
    }
    return rows.length + 36 * tree.count;
  }

  // At rest Gaussians are sorted for the view at once; while the eye moves as the worker last had them.
  begin(view, options, width, height) {
    const { gl, tree } = this, { frame, places, extents } = tree.splats, camera = cameraOf(frame, view, width, height);
    if (!this.target || this.target.width !== width || this.target.height !== height) this._resize(width, height);
    const rough = options.rough && this.order && this.worker, least = (options.rough ? ROUGH : 0) / (view.lens[0] * camera.size);
    const spare = options.rough ? 0.1 * width : SOFT; // the eye goes on while they are sorted
    const planes = planesOf(camera, view.lens, width, height, spare);
    if (!rough) this.order = backToFront(places, extents, planes, NEAR, least);
    else if (!this.sorting) {
      this.sorting = true;
      this.worker.postMessage({ planes, least });
    }
    gl.useProgram(this.first);
    const at = (name, program = this.first) => gl.getUniformLocation(program, name), columns = (rows) => AXES.flatMap((column) => AXES.map((axis) => rows[axis][column]));
    gl.uniformMatrix3fv(at("turn"), false, columns(camera.turn));
    gl.uniformMatrix3fv(at("world"), false, columns(frame));
    gl.uniform3f(at("shift"), ...camera.shift);
    gl.uniform3f(at("eye"), ...camera.own);
    gl.uniform3f(at("origin"), ...frame.map((each) => each[3]));
    gl.uniform4f(at("lens"), ...view.lens);
    gl.uniform4f(at("limits"), ...camera.limits);
    gl.uniform2f(at("range"), ...options.range);
    gl.uniform1i(at("mode"), options.mode);
    const { low, high, radius, fade, rows = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]] } = this.region || { low: [0, 0, 0], high: [0, 0, 0], radius: 0, fade: 0 };
    gl.uniform1i(at("inRegion"), this.region ? 1 : 0);
    gl.uniformMatrix3fv(at("box"), false, columns(rows));
    gl.uniform3f(at("boxOrigin"), ...rows.map((row) => row[3]));
    gl.uniform3f(at("middle"), ...AXES.map((axis) => (low[axis] + high[axis]) / 2));
    gl.uniform3f(at("reach"), ...AXES.map((axis) => (high[axis] - low[axis]) / 2));
    gl.uniform2f(at("soft"), radius, Math.max(fade, 1e-9));
    gl.uniform1i(at("count"), this.order.length);
    const used = Math.ceil(this.order.length / ROW);
    this.numbers.set(this.order);
    gl.activeTexture(gl.TEXTURE1);
    gl.texSubImage2D(gl.TEXTURE_2D, 0, 0, 0, ROW, used, gl.RED_INTEGER, gl.UNSIGNED_INT, this.numbers);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.projected);
    gl.viewport(0, 0, ROW, used);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.useProgram(this.program);
    gl.uniform2f(at("size", this.program), width, height);
    this.background = options.background;
  }

  // At the Gaussian with which more than half of the light of the point is absorbed, of those that are drawn there, in the order of their centres.
  depth(view, x, y) {
    const { tree, canvas: { width, height } } = this, { frame, places, extents } = tree.splats, [fx, fy, cx, cy] = view.lens;
    const camera = cameraOf(frame, view, width, height), planes = planesOf(camera, [fx, fy, cx - x + 0.5, cy - y + 0.5], 1, 1, SOFT);
    const order = backToFront(places, extents, planes, NEAR, 0);
    for (let n = order.length - 1, light = 1; n >= 0; n--) {
      const { alpha, depth } = alongRay(tree, order[n], camera, x, y, this.region);
      light *= 1 - alpha;
      if (light < 0.5) return depth;
    }
    return -1;
  }

  // The picture, whole.
  band() {
    const { gl } = this, { width, height, buffer } = this.target;
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...this.background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawElements(gl.TRIANGLES, 6 * this.order.length, gl.UNSIGNED_INT, 0);
    gl.disable(gl.BLEND);
    return true;
  }
}
