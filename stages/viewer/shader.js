// The fragment shader: a ray for each pixel, marched as FORMAT.md says.

export const VERTEX = `#version 300 es
void main() {
  gl_Position = vec4(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0, 0.0, 1.0);
}`;

// Real spherical harmonics by their numbers, orthonormal, of the unit direction d.
const S = Math.sqrt, PI = Math.PI;
export const BASIS = [
  [0.5 * S(1 / PI), "1.0"],
  [-S(3 / (4 * PI)), "d.y"], [S(3 / (4 * PI)), "d.z"], [-S(3 / (4 * PI)), "d.x"],
  [0.5 * S(15 / PI), "d.x*d.y"], [-0.5 * S(15 / PI), "d.y*d.z"], [0.25 * S(5 / PI), "(2.0*zz-xx-yy)"], [-0.5 * S(15 / PI), "d.x*d.z"],
  [0.25 * S(15 / PI), "(xx-yy)"],
  [-0.25 * S(35 / (2 * PI)), "d.y*(3.0*xx-yy)"], [0.5 * S(105 / PI), "d.x*d.y*d.z"], [-0.25 * S(21 / (2 * PI)), "d.y*(4.0*zz-xx-yy)"],
  [0.25 * S(7 / PI), "d.z*(2.0*zz-3.0*xx-3.0*yy)"], [-0.25 * S(21 / (2 * PI)), "d.x*(4.0*zz-xx-yy)"], [0.25 * S(105 / PI), "d.z*(xx-yy)"],
  [-0.25 * S(35 / (2 * PI)), "d.x*(xx-3.0*yy)"],
  [0.75 * S(35 / PI), "d.x*d.y*(xx-yy)"], [-0.75 * S(35 / (2 * PI)), "d.y*d.z*(3.0*xx-yy)"], [0.75 * S(5 / PI), "d.x*d.y*(7.0*zz-1.0)"],
  [-0.75 * S(5 / (2 * PI)), "d.y*d.z*(7.0*zz-3.0)"], [(3 / 16) * S(1 / PI), "(zz*(35.0*zz-30.0)+3.0)"], [-0.75 * S(5 / (2 * PI)), "d.x*d.z*(7.0*zz-3.0)"],
  [(3 / 8) * S(5 / PI), "(xx-yy)*(7.0*zz-1.0)"], [-0.75 * S(35 / (2 * PI)), "d.x*d.z*(xx-3.0*yy)"],
  [(3 / 16) * S(35 / PI), "(xx*(xx-3.0*yy)-yy*(3.0*xx-yy))"],
];

// The colour of a depth.
export const SCALE = `vec3 scale(float x) {
  vec3 c = mix(vec3(0.99, 0.91, 0.65), vec3(0.96, 0.48, 0.36), smoothstep(0.0, 0.4, x));
  c = mix(c, vec3(0.51, 0.15, 0.5), smoothstep(0.35, 0.75, x));
  return mix(c, vec3(0.04, 0.03, 0.16), smoothstep(0.7, 1.0, x));
}`;

// Statements that add a voxel's harmonics above the base, whose codes are words of `layers`.
function harmonicsOf(tree, layers) {
  const lines = layers.map((_, n) => `  uvec4 words${n} = texelFetch(codes${n}, texel, 0);`), each = tree.codeBytes === 2 ? 2 : 4;
  let k = 1;
  tree.groups.forEach((size, group) => {
    const word = Math.floor(group / each), shift = (group % each) * 8 * tree.codeBytes, mask = tree.codeBytes === 2 ? "65535u" : "255u";
    lines.push(`  code = (words${word >> 2}.${"xyzw"[word & 3]} >> ${shift}u) & ${mask};`);
    for (let j = 0; j < size; j++, k++) {
      lines.push(`  sum += Y[${k}] * texelFetch(palette, ivec2(int(code & 63u) * ${tree.harmonics - 1} + ${k - 1}, int(code >> 6u)), 0).rgb;`);
    }
  });
  return lines.join("\n");
}

export function fragmentShader(tree, layers) {
  const cascades = tree.grids.length, b = tree.brick;
  return `#version 300 es
precision highp float; precision highp int; precision highp sampler2D; precision highp sampler3D; precision highp usampler3D;
uniform usampler3D coarse;
uniform sampler3D density;
uniform usampler3D base;
${layers.map((_, n) => `uniform usampler3D codes${n};`).join("\n")}
uniform sampler2D palette;
uniform sampler2D environment;
layout(std140) uniform Tables { vec4 baseTable[256]; };
uniform vec3 start[${cascades}];        // the eye in voxels of each cascade
uniform vec3 low[${cascades}];
uniform float side[${cascades}];        // of a voxel
uniform ivec3 shape[${cascades}];
uniform int above[${cascades}];         // where a cascade begins along z of the coarse volume
uniform vec3 densityScale;              // one over the atlas' sides
uniform vec4 lens;                      // fx, fy, cx, cy in pixels of the drawing
uniform float rows;                     // of the drawing
uniform mat3 worldFromCamera;
uniform vec3 eye;
uniform mat3 ndcFromWorld;              // rotation to the reference camera
uniform vec3 ndcEye;
uniform vec3 ndcLens;                   // slopes along x and y, near plane
uniform vec4 background;                // a: whether it takes the place of the environment
uniform int mode;                       // 0 colour, 1 depth, 2 normal, 3 harmonics of degree 0, 4 the depth's own bytes
uniform vec2 range;                     // least and greatest depth shown
uniform bool rough;                     // colours of one voxel in place of eight
uniform float least;                    // weight below which no colour is looked up; it is added to that of the next sample
out vec4 result;

const float STEP = ${tree.step.toFixed(9)};
const int B = ${b};
float Y[${tree.harmonics}];
vec3 direction;                         // of the world
float transmittance = 1.0, pending = 0.0, halfway = -1.0;
vec3 colour = vec3(0.0), facing = vec3(0.0), place = vec3(0.0);

void harmonics(vec3 d) {
  float xx = d.x * d.x, yy = d.y * d.y, zz = d.z * d.z;
${BASIS.slice(0, tree.harmonics).map(([factor, text], k) => `  Y[${k}] = ${factor.toFixed(12)} * ${text};`).join("\n")}
}

ivec3 tileOf(uint cell) {
  return ivec3(cell & 1023u, (cell >> 10u) & 1023u, (cell >> 20u) & 1023u);
}

// What is before the sigmoid, times the weight, of one voxel; w: the weight if it is stored.
vec4 voxel(ivec3 texel, float weight) {
  uvec4 codes = texelFetch(base, texel, 0);
  if (codes.a == 0u) return vec4(0.0);
  vec3 sum = Y[0] * vec3(baseTable[codes.r].r, baseTable[codes.g].g, baseTable[codes.b].b);
  if (mode != 3) {
    uint code;
${harmonicsOf(tree, layers)}
  }
  return vec4(sum, 1.0) * weight;
}

vec4 corner(ivec3 at, ivec3 cell, ivec3 tile, int n, float weight) {
  if (weight <= 0.0 || any(lessThan(at, ivec3(0))) || any(greaterThanEqual(at, shape[n] * B))) return vec4(0.0);
  ivec3 there = at / B, own = tile;
  if (there != cell) {
    uint found = texelFetch(coarse, there + ivec3(0, 0, above[n]), 0).r;
    if (found < 0x80000000u) return vec4(0.0);
    own = tileOf(found);
  }
  return voxel(own * B + at - there * B, weight);
}

vec3 colourAt(vec3 u, ivec3 cell, ivec3 tile, int n) {
  vec4 sum = vec4(0.0);
${tree.nearest ? "  sum = corner(ivec3(floor(u)), cell, tile, n, 1.0);" : `  vec3 q = u - 0.5, l = floor(q), f = q - l;
  ivec3 at = ivec3(l);
  if (rough) sum = corner(at + ivec3(greaterThan(f, vec3(0.5))), cell, tile, n, 1.0);
  if (sum.a == 0.0) {
    for (int i = 0; i < 8; i++) {
      ivec3 o = ivec3(i >> 2, (i >> 1) & 1, i & 1);
      vec3 w = mix(1.0 - f, f, vec3(o));
      sum += corner(at + o, cell, tile, n, w.x * w.y * w.z);
    }
  }`}
  return 1.0 / (1.0 + exp(-sum.rgb / max(sum.a, 1e-12)));
}

// Density, as an optical depth of a voxel's side, at voxel coordinates of cascade n.
float densityAt(int n, vec3 u) {
  if (any(lessThan(u, vec3(0.0))) || any(greaterThanEqual(u, vec3(shape[n] * B)))) return 0.0;
  ivec3 cell = min(ivec3(u / float(B)), shape[n] - 1);
  uint found = texelFetch(coarse, cell + ivec3(0, 0, above[n]), 0).r;
  if (found < 0x80000000u) return 0.0;
  return textureLod(density, (vec3(tileOf(found) * (B + 2) + 1 - cell * B) + u) * densityScale, 0.0).r;
}

// Samples from distance enter to distance leave, in voxels, of the ray from p along d through cascade n.
void march(int n, vec3 p, vec3 d, float enter, float leave) {
  vec3 inverse = 1.0 / mix(d, vec3(1e-9), lessThan(abs(d), vec3(1e-9)));
  ivec3 last = shape[n] - 1, cell = ivec3(0), tile = ivec3(0);
  vec3 at = vec3(0.0), along = d * densityScale;
  float k = 0.0, end = min(ceil((leave - enter) / STEP), 2.0 * float((last.x + last.y + last.z + 3) * B) / STEP + 4.0), next = 0.0;
  for (int i = 0; i < 16384; i++) { // one loop for cells and samples: rays that are drawn together stay together
    float t = enter + (k + 0.5) * STEP;
    if (!(t < leave) || k >= end || transmittance < 5e-4) break;
    vec3 u = p + t * d;
    if (k >= next) {
      cell = clamp(ivec3(floor(u / float(B))), ivec3(0), last);
      uint found = texelFetch(coarse, cell + ivec3(0, 0, above[n]), 0).r;
      bool occupied = found >= 0x80000000u;
      int reach = occupied ? 1 : int(found);
      vec3 beyond = max((vec3((cell - reach + 1) * B) - u) * inverse, (vec3((cell + reach) * B) - u) * inverse);
      next = k + max(1.0, ceil(min(beyond.x, min(beyond.y, beyond.z)) / STEP - 1e-3));
      if (!occupied) {
        k = next;
        continue;
      }
      tile = tileOf(found);
      at = (vec3(tile * (B + 2) + 1 - cell * B) + p) * densityScale;
    }
    k += 1.0;
    float thickness = textureLod(density, at + t * along, 0.0).r * STEP;
    if (thickness <= 0.0) continue;
    float left = transmittance * exp(-thickness);
    pending += transmittance - left;
    if (left < 0.5 && halfway < 0.0) {
      float middle = t + (log(2.0 * transmittance) / thickness - 0.5) * STEP;
      vec3 v = p + middle * d, x = vec3(1, 0, 0), y = vec3(0, 1, 0), z = vec3(0, 0, 1);
      halfway = middle * side[n];
      place = low[n] + v * side[n];
      facing = vec3(densityAt(n, v - x) - densityAt(n, v + x), densityAt(n, v - y) - densityAt(n, v + y), densityAt(n, v - z) - densityAt(n, v + z));
    }
    transmittance = left;
    if (pending > least && (mode == 0 || mode == 3)) {
      colour += pending * colourAt(u, cell, tile, n);
      pending = 0.0;
    }
  }
}

vec3 behind() {
  vec2 at = vec2(atan(direction.y, direction.x) / ${(2 * PI).toFixed(12)} + 0.5, atan(length(direction.xy), direction.z) / ${PI.toFixed(12)});
  return textureLod(environment, at, 0.0).rgb;
}

${SCALE}

// Near and far end of the ray in the box of cascade n, units of its frame.
vec2 boxOf(int n, vec3 p, vec3 d) {
  vec3 inverse = 1.0 / mix(d, vec3(1e-12), lessThan(abs(d), vec3(1e-12)));
  vec3 one = -p * inverse, other = (vec3(shape[n] * B) - p) * inverse, least = min(one, other), greatest = max(one, other);
  return vec2(max(0.0, max(least.x, max(least.y, least.z))), min(greatest.x, min(greatest.y, greatest.z))) * side[n];
}

void main() {
  vec2 pixel = vec2(gl_FragCoord.x, rows - gl_FragCoord.y);
  vec3 local = normalize(vec3((pixel - lens.zw) / lens.xy, 1.0));
  direction = worldFromCamera * local;
  harmonics(direction);
  float depth = -1.0;
${tree.ndc ? `  vec3 d = ndcFromWorld * direction;
  float z = ndcEye.z, near = ndcLens.z, begin = z < near ? (d.z > 1e-9 ? (near - z) / d.z : -1.0) : 0.0;
  if (begin >= 0.0) {
    vec3 at = ndcEye + begin * d;
    at.z = max(at.z, near);
    vec3 along = vec3(ndcLens.xy * (d.xy * at.z - at.xy * d.z), 2.0 * near * d.z) / (at.z * at.z);
    float speed = length(along);
    if (speed > 1e-12) {
      along /= speed;
      vec3 p = (vec3(ndcLens.xy * at.xy / at.z, 1.0 - 2.0 * near / at.z) - low[0]) / side[0];
      vec2 box = boxOf(0, p, along) / side[0];
      if (box.x < box.y) march(0, p, along, box.x, box.y);
      if (halfway >= 0.0) {
        float rest = speed - halfway * d.z / at.z, zz = 2.0 * near / max(1.0 - place.z, 1e-9);
        depth = rest > 1e-6 * speed ? (begin + halfway / rest) * local.z : 1e30;
        vec2 xy = place.xy * zz / ndcLens.xy;
        vec3 g = vec3(ndcLens.xy * facing.xy, 2.0 * near * facing.z);
        facing = transpose(ndcFromWorld) * vec3(g.xy, (zz * g.z - dot(xy, g.xy)) / zz);
      }
    }
  }` : `  vec2 box[${cascades}];
  for (int n = 0; n < ${cascades}; n++) box[n] = boxOf(n, start[n], direction);
  for (int i = 0; i < ${2 * cascades - 1}; i++) {
    int n = abs(${cascades - 1} - i);
    vec2 part = box[n];
    if (n > 0) {
      vec2 inner = box[n - 1];
      bool meets = inner.y > inner.x;
      part = i < ${cascades - 1} ? vec2(part.x, meets ? inner.x : part.y) : vec2(meets ? inner.y : part.y, part.y);
    }
    if (part.x < part.y) march(n, start[n], direction, part.x / side[n], part.y / side[n]);
  }
  if (halfway >= 0.0) depth = halfway * local.z;`}
  if (mode == 4) {
    uint bits = floatBitsToUint(depth);
    result = vec4(bits & 255u, (bits >> 8u) & 255u, (bits >> 16u) & 255u, bits >> 24u) / 255.0;
    return;
  }
  float opacity = 1.0 - transmittance;
  if (mode == 1) colour = depth < 0.0 ? background.rgb : scale(clamp((1.0 / range.x - 1.0 / max(depth, range.x)) / (1.0 / range.x - 1.0 / range.y), 0.0, 1.0));
  else if (mode == 2) colour = depth < 0.0 || dot(facing, facing) == 0.0 ? background.rgb : 0.5 + 0.5 * normalize(facing);
  else {
    if (pending > 0.0 && opacity > pending) colour *= opacity / (opacity - pending);
    if (transmittance >= 5e-4) colour += transmittance * (background.a > 0.5 ? background.rgb : behind());
  }
  result = vec4(colour, 1.0);
}`;
}

export function programOf(gl, vertex, fragment) {
  const program = gl.createProgram();
  for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.linkProgram(program);
  if (!gl.getProgramParameter(program, gl.LINK_STATUS)) {
    const logs = gl.getAttachedShaders(program).map((shader) => gl.getShaderInfoLog(shader));
    throw new Error(`the shader can't be built here: ${[gl.getProgramInfoLog(program), ...logs].join(" ").slice(0, 400)}`);
  }
  return program;
}
