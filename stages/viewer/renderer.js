// Textures and draws. A picture is drawn into a texture, whole or in bands, and copied to the canvas when it is done.

import { VERTEX, fragmentShader, programOf } from "./shader.js";
import { volumeOf } from "./volume.js";

export class Unsupported extends Error {}

const LEAST_WEIGHT = 1e-3, ROUGH_WEIGHT = 0.02; // docs/experiments/viewer.md
export const UNITS = ["coarse", "density", "base", "palette", "environment", "codes0", "codes1", "codes2"];

export class Renderer {
  constructor(canvas) {
    this.canvas = canvas;
    const wanted = { antialias: false, alpha: false, depth: false, preserveDrawingBuffer: true, powerPreference: "high-performance" };
    this.gl = canvas.getContext("webgl2", wanted);
    if (!this.gl) throw new Unsupported("This browser does not offer WebGL2, which the page draws with. Try a recent Chrome, Edge, Firefox or Safari with graphics acceleration on.");
    this.most = this.gl.getParameter(this.gl.MAX_3D_TEXTURE_SIZE);
    this.target = null;
    this.textures = {};
  }

  // The tree's textures; of what lies in a region alone, if there is one. Those of an earlier call are replaced.
  load(tree, region) {
    const { gl } = this;
    let volume;
    try {
      volume = volumeOf(tree, region, this.most);
    } catch (error) {
      if (error instanceof RangeError) throw new Unsupported(`The scene can't be shown here: ${error.message}.`);
      throw error;
    }
    for (const each of Object.values(this.textures)) gl.deleteTexture(each);
    this.textures = {};
    this.tree = tree;
    gl.pixelStorei(gl.UNPACK_ALIGNMENT, 1);
    const [tx, ty, tz] = volume.tiles, pad = tree.brick + 2, b = tree.brick;
    const cube = (name, size, inner, format, type, data, filter = gl.NEAREST) => {
      this._texture(name, gl.TEXTURE_3D, filter);
      gl.texImage3D(gl.TEXTURE_3D, 0, inner, ...size, 0, format, type, data);
    };
    cube("coarse", volume.coarseSize, gl.R32UI, gl.RED_INTEGER, gl.UNSIGNED_INT, volume.coarse);
    cube("density", [tx * pad, ty * pad, tz * pad], gl.R16F, gl.RED, gl.HALF_FLOAT, volume.density, tree.nearest ? gl.NEAREST : gl.LINEAR);
    cube("base", [tx * b, ty * b, tz * b], gl.RGBA8UI, gl.RGBA_INTEGER, gl.UNSIGNED_BYTE, volume.base);
    volume.layers.forEach(({ channels, data }, n) => {
      const [inner, format] = { 1: [gl.R32UI, gl.RED_INTEGER], 2: [gl.RG32UI, gl.RG_INTEGER], 4: [gl.RGBA32UI, gl.RGBA_INTEGER] }[channels];
      cube(`codes${n}`, [tx * b, ty * b, tz * b], inner, format, gl.UNSIGNED_INT, data);
    });
    this._tables(tree);
    const error = gl.getError();
    if (error === gl.OUT_OF_MEMORY) throw new Unsupported(`The scene needs ${Math.round(volume.bytes / 1e6)} MB of graphics memory, more than there is here.`);
    if (error !== gl.NO_ERROR) throw new Unsupported(`The scene's textures can't be made here (error ${error}).`);
    this._program(tree, volume);
    return volume.bytes;
  }

  _texture(name, kind, filter) {
    const { gl } = this;
    this.textures[name] = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + UNITS.indexOf(name));
    gl.bindTexture(kind, this.textures[name]);
    gl.texParameteri(kind, gl.TEXTURE_MIN_FILTER, filter);
    gl.texParameteri(kind, gl.TEXTURE_MAG_FILTER, filter);
    for (const axis of kind === gl.TEXTURE_3D ? ["S", "T", "R"] : ["S", "T"]) gl.texParameteri(kind, gl[`TEXTURE_WRAP_${axis}`], gl.CLAMP_TO_EDGE);
  }

  _tables(tree) {
    const { gl } = this, above = tree.harmonics - 1, width = 64 * Math.max(1, above), height = Math.max(1, Math.ceil(tree.paletteEntries / 64));
    const palette = new Float32Array(4 * width * height);
    for (let n = 0; n < tree.paletteEntries * above; n++) {
      const entry = Math.floor(n / above), to = 4 * ((entry >> 6) * width + (entry & 63) * above + (n % above));
      palette.set(tree.palette.subarray(3 * n, 3 * n + 3), to);
    }
    this._texture("palette", gl.TEXTURE_2D, gl.NEAREST);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA32F, width, height, 0, gl.RGBA, gl.FLOAT, palette);
    this._texture("environment", gl.TEXTURE_2D, gl.LINEAR);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_WRAP_S, gl.REPEAT);
    const map = tree.environment;
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB8, map ? 2 * tree.rows : 1, map ? tree.rows : 1, 0, gl.RGB, gl.UNSIGNED_BYTE, map || new Uint8Array(3));
    const base = new Float32Array(1024);
    for (let n = 0; n < tree.baseTable.length / 3; n++) base.set(tree.baseTable.subarray(3 * n, 3 * n + 3), 4 * n);
    this.tables ||= gl.createBuffer();
    gl.bindBufferBase(gl.UNIFORM_BUFFER, 0, this.tables);
    gl.bufferData(gl.UNIFORM_BUFFER, base, gl.STATIC_DRAW);
  }

  _program(tree, volume) {
    const { gl } = this;
    if (this.program) gl.deleteProgram(this.program);
    const program = programOf(gl, VERTEX, fragmentShader(tree, volume.layers)), at = new Map(), [tx, ty, tz] = volume.tiles, pad = tree.brick + 2;
    this.program = program;
    this.at = (name) => {
      if (!at.has(name)) at.set(name, gl.getUniformLocation(program, name));
      return at.get(name);
    };
    gl.useProgram(program);
    UNITS.forEach((name, unit) => gl.uniform1i(this.at(name), unit));
    gl.uniformBlockBinding(program, gl.getUniformBlockIndex(program, "Tables"), 0);
    const depths = tree.grids.map(({ shape }) => shape[2]);
    gl.uniform3fv(this.at("low"), tree.grids.flatMap(({ low }) => low));
    gl.uniform1fv(this.at("side"), tree.grids.map(({ voxel }) => voxel));
    gl.uniform3iv(this.at("shape"), tree.grids.flatMap(({ shape }) => shape));
    gl.uniform1iv(this.at("above"), depths.map((_, n) => depths.slice(0, n).reduce((a, b) => a + b, 0)));
    gl.uniform3f(this.at("densityScale"), 1 / (tx * pad), 1 / (ty * pad), 1 / (tz * pad));
    if (tree.ndc) {
      const { rows, slopes, near } = tree.ndc;
      gl.uniformMatrix3fv(this.at("ndcFromWorld"), false, [0, 1, 2].flatMap((row) => rows[row].slice(0, 3)));
      gl.uniform3f(this.at("ndcLens"), ...slopes, near);
    }
  }

  // Starts a picture of so many pixels. view: rotation (rows of 3: right, down and forward in columns), eye, lens [fx, fy, cx, cy] in these pixels.
  begin(view, options, width, height) {
    const { gl, tree } = this, { rotation: r, eye } = view;
    if (!this.target || this.target.width !== width || this.target.height !== height) this._resize(width, height);
    gl.useProgram(this.program);
    gl.uniformMatrix3fv(this.at("worldFromCamera"), false, [r[0][0], r[1][0], r[2][0], r[0][1], r[1][1], r[2][1], r[0][2], r[1][2], r[2][2]]);
    gl.uniform3f(this.at("eye"), ...eye);
    gl.uniform3fv(this.at("start"), tree.grids.flatMap(({ low, voxel }) => eye.map((x, axis) => (x - low[axis]) / voxel)));
    if (tree.ndc) {
      const { rows } = tree.ndc, from = [0, 1, 2].map((axis) => eye[axis] - rows[axis][3]);
      gl.uniform3f(this.at("ndcEye"), ...[0, 1, 2].map((column) => rows[0][column] * from[0] + rows[1][column] * from[1] + rows[2][column] * from[2]));
    }
    gl.uniform4f(this.at("lens"), ...view.lens);
    gl.uniform1f(this.at("rows"), height);
    gl.uniform4f(this.at("background"), ...options.background, options.surroundings ? 0 : 1);
    gl.uniform1i(this.at("mode"), options.mode);
    gl.uniform2f(this.at("range"), ...options.range);
    gl.uniform1i(this.at("rough"), options.rough ? 1 : 0);
    gl.uniform1f(this.at("least"), options.rough ? ROUGH_WEIGHT : options.least ?? LEAST_WEIGHT);
    this.done = 0;
  }

  // Draws the next `rows` rows; whether the picture is complete.
  band(rows) {
    const { gl } = this, { width, height, buffer } = this.target;
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.viewport(0, 0, width, height);
    gl.enable(gl.SCISSOR_TEST);
    const to = Math.min(height, this.done + rows);
    gl.scissor(0, height - to, width, to - this.done);
    gl.drawArrays(gl.TRIANGLES, 0, 3);
    gl.disable(gl.SCISSOR_TEST);
    this.done = to;
    return to === height;
  }

  // Along the axis of a view of the canvas to the surface that it shows at a point, in pixels; below zero where there is none.
  depth({ rotation, eye, lens: [fx, fy, cx, cy] }, x, y, options) {
    this.begin({ rotation, eye, lens: [fx, fy, cx - x + 0.5, cy - y + 0.5] }, { ...options, mode: 4 }, 1, 1);
    this.band(1);
    return new DataView(this.pixels().buffer).getFloat32(0, true);
  }

  present() {
    const { gl, canvas } = this, { width, height, buffer } = this.target;
    gl.bindFramebuffer(gl.READ_FRAMEBUFFER, buffer);
    gl.bindFramebuffer(gl.DRAW_FRAMEBUFFER, null);
    gl.blitFramebuffer(0, 0, width, height, 0, 0, canvas.width, canvas.height, gl.COLOR_BUFFER_BIT, gl.LINEAR);
  }

  // RGBA bytes of the picture, from its upper row.
  pixels() {
    const { gl } = this, { width, height, buffer } = this.target, raw = new Uint8Array(4 * width * height), out = new Uint8Array(raw.length);
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, raw);
    for (let row = 0; row < height; row++) out.set(raw.subarray(4 * width * (height - 1 - row), 4 * width * (height - row)), 4 * width * row);
    return out;
  }

  _resize(width, height) {
    const { gl } = this;
    if (this.target) {
      gl.deleteFramebuffer(this.target.buffer);
      gl.deleteTexture(this.target.texture);
    }
    const texture = gl.createTexture(), buffer = gl.createFramebuffer();
    gl.activeTexture(gl.TEXTURE0 + UNITS.length);
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texStorage2D(gl.TEXTURE_2D, 1, gl.RGBA8, width, height);
    gl.bindFramebuffer(gl.FRAMEBUFFER, buffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, texture, 0);
    this.target = { width, height, texture, buffer };
  }
}
