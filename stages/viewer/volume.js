// From a tree to the arrays of textures: a volume of coarse cells, and bricks in atlases.
//
// coarse   per cell: OCCUPIED and its brick's tile, ten bits an axis, or the chessboard distance to the nearest occupied cell; the cascades lie one above the other along z
// density  optical depth of a voxel's side, halves; tiles of brick + 2 voxels a side, the outermost those of the bricks around, so that the texture unit
//          interpolates it
// base     codes of the base colour, and 255 where a voxel is stored; tiles of brick voxels a side
// codes    those of the harmonics above it, in 32-bit words

export const OCCUPIED = 0x80000000;
const FULL = 60000; // a half holds it

// 16-bit floats of a positive number below FULL, rounded to nearest.
function half(x) {
  if (x < 2 ** -14) return Math.round(x * 2 ** 24);
  const exponent = Math.floor(Math.log2(x)), bits = ((exponent + 15) << 10) + Math.round((x / 2 ** exponent - 1) * 1024);
  return bits;
}

// How far from an empty cell the next occupied one is, in steps to any of the 26 cells around: two passes suffice for this distance.
function leaps(cells, [X, Y, Z]) {
  const most = 255, at = (x, y, z) => (x * Y + y) * Z + z;
  const pass = (forward) => {
    const sign = forward ? -1 : 1;
    for (let i = 0; i < X; i++) for (let j = 0; j < Y; j++) for (let k = 0; k < Z; k++) {
      const x = forward ? i : X - 1 - i, y = forward ? j : Y - 1 - j, z = forward ? k : Z - 1 - k, here = at(x, y, z);
      let least = cells[here];
      if (least === 0) continue;
      if (least > most) least = most;
      const look = (a, b, c) => {
        if (a >= 0 && a < X && b >= 0 && b < Y && c >= 0 && c < Z) {
          const there = cells[(a * Y + b) * Z + c] + 1;
          if (there < least) least = there;
        }
      };
      if (x + sign >= 0 && x + sign < X) for (let b = -1; b <= 1; b++) for (let c = -1; c <= 1; c++) look(x + sign, y + b, z + c);
      for (let c = -1; c <= 1; c++) look(x, y + sign, z + c);
      look(x, y, z + sign);
      cells[here] = least;
    }
  };
  pass(true);
  pass(false);
}

// Share of the opacity of a voxel at a point that belongs to a region's box; `rows`: from the world to the frame that the box is in.
export function insideShare(region, x, y, z) {
  const at = region.rows ? region.rows.map((row) => row[0] * x + row[1] * y + row[2] * z + row[3]) : [x, y, z];
  const [a, b, c] = [0, 1, 2].map((axis) => Math.abs(at[axis] - (region.low[axis] + region.high[axis]) / 2) - (region.high[axis] - region.low[axis]) / 2);
  const radius = Math.min(region.radius, Math.min(region.high[0] - region.low[0], region.high[1] - region.low[1]) / 2), p = a + radius, q = b + radius;
  const across = Math.hypot(Math.max(p, 0), Math.max(q, 0)) + Math.min(Math.max(p, q), 0) - radius, distance = -Math.max(across, c);
  if (region.fade <= 0) return distance > 0 ? 1 : 0;
  const share = Math.min(Math.max(distance / region.fade, 0), 1);
  return share * share * (3 - 2 * share);
}

// Tiles along each axis for so many bricks, with sides of at most `most` texels.
function tilesFor(bricks, side, most) {
  const limit = Math.floor(most / side), x = Math.min(limit, Math.max(1, Math.ceil(Math.cbrt(bricks))));
  const y = Math.min(limit, Math.max(1, Math.ceil(Math.sqrt(bricks / x)))), z = Math.max(1, Math.ceil(bricks / (x * y)));
  return z > limit ? null : [x, y, z];
}

// The arrays of a tree, or of what of it lies in a region. Raises RangeError where textures of `most` texels a side do not hold it.
export function volumeOf(tree, region, most) {
  const b = tree.brick, cube = b ** 3, pad = b + 2, tiles = tilesFor(tree.bricks, pad, most);
  const height = tree.grids.map(({ shape }) => shape[2]), size = [0, 1].map((axis) => Math.max(...tree.grids.map(({ shape }) => shape[axis])));
  const depth = height.reduce((sum, z) => sum + z, 0);
  if (tiles === null || Math.max(...size, depth) > most) throw new RangeError(`larger than this device's textures of ${most} texels a side`);
  const [tx, ty, tz] = tiles, words = Math.ceil((tree.groups.length * tree.codeBytes) / 4);
  const coarse = new Uint32Array(size[0] * size[1] * depth), density = new Uint16Array(tx * ty * tz * pad ** 3);
  const base = new Uint8Array(tx * ty * tz * cube * 4), cellWidth = tx * b, cellPlane = tx * ty * b * b, padWidth = tx * pad, padPlane = tx * ty * pad * pad;
  const layers = [];
  for (let left = words; left > 0; left -= 4) {
    const channels = left >= 3 ? 4 : left;
    layers.push({ channels, data: new Uint32Array(tx * ty * tz * cube * channels) });
  }
  const rowBytes = tree.groups.length * tree.codeBytes, plain = tree.codes.byteOffset === 0 && rowBytes % 4 === 0 ? new Uint32Array(tree.codes.buffer) : null;
  const word = new Uint8Array(4), wordView = new DataView(word.buffer);
  let voxel = 0, brick = 0, offset = 0;
  tree.grids.forEach(({ shape: [X, Y, Z], voxel: side, low }, n) => {
    const cells = new Int32Array(X * Y * Z).fill(255), first = brick, places = [], owner = new Int32Array(X * Y * Z).fill(-1), occupied = tree.occupancy[n];
    const coded = Uint16Array.from(tree.densityTable, (x) => half(Math.min(x * side, FULL)));
    for (let c = 0; c < X * Y * Z; c++) if ((occupied[c >> 3] >> (c & 7)) & 1) { owner[c] = brick++; places.push(c); }
    places.forEach((c, place) => {
      const id = first + place, z = c % Z, y = ((c - z) / Z) % Y, x = (c - z - y * Z) / (Y * Z);
      const ix = id % tx, iy = Math.floor(id / tx) % ty, iz = Math.floor(id / (tx * ty));
      const mine = !(region && region.bricks) || (region.bricks[id >> 3] >> (id & 7)) & 1;
      let any = false;
      for (let slot = 0; slot < cube; slot++) {
        if (!((tree.masks[id * tree.maskBytes + (slot >> 3)] >> (slot & 7)) & 1)) continue;
        const from = voxel++, r = slot % b, q = Math.floor(slot / b) % b, p = Math.floor(slot / (b * b));
        let value = coded[tree.density[from]];
        if (region) {
          const at = (cell, local, axis) => low[axis] + (cell * b + local + 0.5) * side;
          const share = mine ? insideShare(region, at(x, p, 0), at(y, q, 1), at(z, r, 2)) : 0;
          if (share <= 0) continue;
          if (share < 1) value = half(Math.min(-Math.log1p(share * Math.expm1(-tree.densityTable[tree.density[from]] * side)), FULL));
        }
        any = true;
        const to = (iz * b + r) * cellPlane + (iy * b + q) * cellWidth + ix * b + p;
        base[4 * to] = tree.base[3 * from];
        base[4 * to + 1] = tree.base[3 * from + 1];
        base[4 * to + 2] = tree.base[3 * from + 2];
        base[4 * to + 3] = 255;
        for (let w = 0, layer = 0; layer < layers.length; layer++) {
          const { channels, data } = layers[layer];
          for (let channel = 0; channel < channels && w < words; channel++, w++) {
            if (plain) data[to * channels + channel] = plain[from * words + w];
            else {
              for (let byte = 0; byte < 4; byte++) word[byte] = 4 * w + byte < rowBytes ? tree.codes[from * rowBytes + 4 * w + byte] : 0;
              data[to * channels + channel] = wordView.getUint32(0, true);
            }
          }
        }
        if (value === 0) continue;
        // Its own tile, and the borders of those beside it.
        const x0 = p === 0 && x > 0 ? -1 : 0, x1 = p === b - 1 && x < X - 1 ? 1 : 0, y0 = q === 0 && y > 0 ? -1 : 0, y1 = q === b - 1 && y < Y - 1 ? 1 : 0;
        const z0 = r === 0 && z > 0 ? -1 : 0, z1 = r === b - 1 && z < Z - 1 ? 1 : 0;
        for (let dx = x0; dx <= x1; dx++) for (let dy = y0; dy <= y1; dy++) for (let dz = z0; dz <= z1; dz++) {
          const other = dx || dy || dz ? owner[c + (dx * Y + dy) * Z + dz] : id;
          if (other < 0) continue;
          const jx = other % tx, jy = Math.floor(other / tx) % ty, jz = Math.floor(other / (tx * ty));
          density[(jz * pad + r + 1 - dz * b) * padPlane + (jy * pad + q + 1 - dy * b) * padWidth + jx * pad + p + 1 - dx * b] = value;
        }
      }
      if (any) cells[c] = 0;
    });
    leaps(cells, [X, Y, Z]);
    for (let x = 0; x < X; x++) for (let y = 0; y < Y; y++) for (let z = 0; z < Z; z++) {
      const c = (x * Y + y) * Z + z;
      const id = owner[c], tile = (id % tx) + (Math.floor(id / tx) % ty) * 1024 + Math.floor(id / (tx * ty)) * 1048576;
      coarse[(offset + z) * size[0] * size[1] + y * size[0] + x] = cells[c] === 0 ? OCCUPIED + tile : cells[c];
    }
    offset += Z;
  });
  const sum = (arrays) => arrays.reduce((total, { byteLength }) => total + byteLength, 0);
  return { coarse, coarseSize: [...size, depth], density, base, layers, tiles, bytes: sum([coarse, density, base, ...layers.map(({ data }) => data)]) };
}
