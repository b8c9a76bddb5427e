// A camera that orbits. Positions are NED, so up in the world is (0, 0, -1); nothing is mirrored.

const FIELD = 1.9; // focal length over half the smaller side
const LEAST_ELEVATION = -0.2;
const MOST_ELEVATION = 1.553; // straight down, but for a hair: there "up" is not defined

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const plus = (a, b, factor = 1) => [a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

class Camera {
  constructor() {
    this.center = [0, 0, 0];
    this.radius = 1;
    this.home();
  }

  /** The standing view: from behind and left of north, a little above. */
  home() {
    this.azimuth = 2.25; // rad, of the eye as seen from the centre
    this.elevation = 0.42;
    this.zoom = 1;
    this.shift = [0, 0, 0];
  }

  fit(low, high) {
    this.center = low.map((value, axis) => 0.5 * (value + high[axis]));
    this.radius = Math.max(0.8, 0.5 * Math.hypot(...minus(high, low)));
  }

  orbit(right, up) {
    this.azimuth += right;
    this.elevation = Math.max(LEAST_ELEVATION, Math.min(MOST_ELEVATION, this.elevation + up));
  }

  zoomBy(factor) {
    this.zoom = Math.max(0.08, Math.min(12, this.zoom * factor));
  }

  /** Move what is looked at, by pixels on a screen of that height. */
  pan(right, up, height) {
    const metres = (2.2 * this.radius) / this.zoom / height;
    const frame = this.frame();
    this.shift = plus(plus(this.shift, frame.right, -right * metres), frame.up, -up * metres);
  }

  frame() {
    const [ca, sa, ce, se] = [Math.cos(this.azimuth), Math.sin(this.azimuth), Math.cos(this.elevation), Math.sin(this.elevation)];
    const back = [ce * ca, ce * sa, -se]; // from the centre to the eye
    const forward = back.map((value) => -value);
    const right = [sa, -ca, 0]; // forward x (0, 0, -1), normalised
    return { back, forward, right, up: cross(right, forward) };
  }

  /** A function from positions to [x, y, depth] in pixels; depth <= 0 is behind the eye. */
  projector(width, height) {
    const { back, forward, right, up } = this.frame();
    const distance = (2.1 * this.radius) / this.zoom;
    const eye = plus(plus(this.center, this.shift), back, distance);
    const focal = 0.5 * FIELD * Math.min(width * 1.25, height);
    const project = (point) => {
      const seen = minus(point, eye);
      const depth = dot(seen, forward);
      const scale = focal / Math.max(depth, 1e-3);
      return [0.5 * width + scale * dot(seen, right), 0.5 * height - scale * dot(seen, up), depth];
    };
    project.perMetre = focal / distance; // pixels at the centre
    project.near = 0.02 * distance;
    project.axis = (direction) => [dot(direction, right), -dot(direction, up)];
    return project;
  }
}

/** Body to inertial rotation of roll, pitch, yaw applied to a body vector. */
function rotate([roll, pitch, yaw], [x, y, z]) {
  const [cr, sr, cp, sp, cy, sy] = [roll, pitch, yaw].flatMap((angle) => [Math.cos(angle), Math.sin(angle)]);
  return [
    cp * cy * x + (sr * sp * cy - cr * sy) * y + (cr * sp * cy + sr * sy) * z,
    cp * sy * x + (sr * sp * sy + cr * cy) * y + (cr * sp * sy - sr * cy) * z,
    -sp * x + sr * cp * y + cr * cp * z,
  ];
}
