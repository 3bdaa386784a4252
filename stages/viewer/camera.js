// Where the eye is: on an orbit around a point, upright, or at a captured camera until it is moved. Axes of a camera: x right, y down, z forward.

const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => a.map((x) => x / (Math.hypot(...a) || 1));
export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
export const turned = (rows, a) => rows.map((row) => dot(row, a));
const transposed = (rows) => [0, 1, 2].map((column) => rows.map((row) => row[column]));
const STEEPEST = (89.5 * Math.PI) / 180;

const clamp = (x, low, high) => Math.min(Math.max(x, low), high);

// Rows of the smallest rotation from the world to where z is up: the world's, unless the metadata state the up that someone set.
export function uprightOf({ up, world_from_capture: capture }) {
  if (!Array.isArray(up) || up.length !== 3 || !(Math.abs(Math.hypot(...up) - 1) < 1e-3)) return [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  const [x, y, z] = capture ? turned(capture.rotation, unit(up)) : unit(up), k = 1 / (1 + z);
  return z < -1 + 1e-9 ? [[1, 0, 0], [0, -1, 0], [0, 0, -1]] : [[1 - x * x * k, -x * y * k, -x], [-x * y * k, 1 - y * y * k, -y], [x, y, z]];
}

export class Eye {
  // cameras: captured ones, {rotation, eye, width, height, fx, fy, cx, cy}; orbit: of the file's metadata; box: [low, high] of the scene; upright: see uprightOf,
  // where the orbit's point and angles are
  constructor(orbit, cameras, box, upright) {
    Object.assign(this, { cameras, upright });
    const size = Math.hypot(...[0, 1, 2].map((axis) => box[1][axis] - box[0][axis]));
    this.home = orbit ? { ...orbit } : { centre: [0, 1, 2].map((axis) => (box[0][axis] + box[1][axis]) / 2), radius: 1.2 * size, elevation: 20, heading: 0, forward_facing: false };
    this.home.centre = turned(upright, this.home.centre);
    this.size = size;
    const middle = cameras[Math.floor(cameras.length / 2)];
    this.home.fov = middle ? 2 * Math.atan(middle.height / 2 / middle.fy) : (50 * Math.PI) / 180;
    this.reset();
  }

  reset() {
    const { centre, radius, elevation, heading, forward_facing: forward, fov } = this.home;
    Object.assign(this, { target: [...centre], distance: radius, azimuth: (heading * Math.PI) / 180, elevation: (elevation * Math.PI) / 180, held: null });
    this.fov = fov;
    if (forward && this.cameras.length) this.jump(Math.floor(this.cameras.length / 2));
  }

  get uprightPose() {
    const { azimuth: a, elevation: e } = this, back = [Math.cos(e) * Math.cos(a), Math.cos(e) * Math.sin(a), Math.sin(e)];
    const forward = back.map((x) => -x), right = unit(cross(forward, [0, 0, 1])), down = cross(forward, right);
    return { rotation: [0, 1, 2].map((row) => [right[row], down[row], forward[row]]), eye: this.target.map((x, axis) => x + this.distance * back[axis]) };
  }

  get orbitPose() {
    const { rotation, eye } = this.uprightPose, back = transposed(this.upright);
    return { rotation: transposed(transposed(rotation).map((axis) => turned(back, axis))), eye: turned(back, eye) };
  }

  // The view for a drawing of so many pixels; that of a captured camera shows all of its image.
  view(width, height) {
    if (this.held === null) {
      const focal = (height / 2 / Math.tan(this.fov / 2)) * Math.min(1, width / height + 0.25);
      return { ...this.orbitPose, lens: [focal, focal, width / 2, height / 2] };
    }
    const { rotation, eye, fx, fy, cx, cy } = this.held, { left, top, scale } = this.frame(width, height);
    return { rotation, eye, lens: [fx * scale, fy * scale, left + cx * scale, top + cy * scale] };
  }

  // Where the captured camera's image lies in the drawing.
  frame(width, height) {
    const scale = Math.min(width / this.held.width, height / this.held.height);
    return { left: (width - this.held.width * scale) / 2, top: (height - this.held.height * scale) / 2, scale };
  }

  jump(index) {
    this.held = this.cameras[index];
    this.index = index;
  }

  // From a captured camera to the orbit through it; its roll is lost.
  release() {
    if (this.held === null) return;
    const { fy, height } = this.held, eye = turned(this.upright, this.held.eye), forward = turned(this.upright, this.held.rotation.map((row) => row[2]));
    const ahead = dot(this.home.centre.map((x, axis) => x - eye[axis]), forward), distance = ahead > 0.05 * this.home.radius ? ahead : this.home.radius;
    Object.assign(this, { distance, target: eye.map((x, axis) => x + distance * forward[axis]), held: null, fov: 2 * Math.atan(height / 2 / fy) });
    this.azimuth = Math.atan2(-forward[1], -forward[0]);
    this.elevation = clamp(Math.asin(clamp(-forward[2], -1, 1)), -STEEPEST, STEEPEST);
  }

  turn(across, up) {
    this.release();
    this.azimuth -= across;
    this.elevation = clamp(this.elevation + up, -STEEPEST, STEEPEST);
  }

  // x, y: in heights of the picture
  pan(x, y) {
    this.release();
    const { rotation } = this.uprightPose, length = 2 * Math.tan(this.fov / 2) * this.distance;
    this.target = this.target.map((value, axis) => value - length * (x * rotation[axis][0] + y * rotation[axis][1]));
  }

  approach(factor) {
    this.release();
    this.distance = clamp(this.distance * factor, 1e-3 * this.home.radius, 100 * Math.max(this.home.radius, this.size));
  }
}

// Pixel and depth of a point in a view, or null behind it.
export function projected(view, point) {
  const { rotation, eye, lens } = view, from = point.map((x, axis) => x - eye[axis]);
  const [x, y, z] = [0, 1, 2].map((column) => rotation[0][column] * from[0] + rotation[1][column] * from[1] + rotation[2][column] * from[2]);
  return z > 1e-6 ? [(lens[0] * x) / z + lens[2], (lens[1] * y) / z + lens[3], z] : null;
}
