// A camera that orbits. Positions are NED, so up in the world is (0, 0, -1); nothing is mirrored.

const HOME = [2.25, 0.42]; // rad, azimuth and elevation of the eye as seen from the centre
const FILLED = 0.43; // share of the canvas, from its middle to each side, that the scene fills at first
const FIELD = 1.9; // focal length over half the smaller side
const LEAST_ELEVATION = -0.2;
const MOST_ELEVATION = 1.553; // straight down, but for a hair: there "up" is not defined

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const minus = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const plus = (a, b, factor = 1) => [a[0] + factor * b[0], a[1] + factor * b[1], a[2] + factor * b[2]];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];

const focalLength = (width, height) => 0.5 * FIELD * Math.min(1.25 * width, height);

function frameOf(azimuth, elevation) {
  const [ca, sa, ce, se] = [Math.cos(azimuth), Math.sin(azimuth), Math.cos(elevation), Math.sin(elevation)];
  const back = [ce * ca, ce * sa, -se]; // from the centre to the eye
  const forward = back.map((value) => -value);
  const right = [sa, -ca, 0]; // forward x (0, 0, -1), normalised
  return { back, forward, right, up: cross(right, forward) };
}

class Camera {
  constructor() {
    this.fit([-1, -1, -1], [1, 1, 1]);
    this.anchor = null; // what is followed, instead of the centre
    this.home();
  }

  /** The standing view: from behind and left of north, a little above. */
  home() {
    [this.azimuth, this.elevation] = HOME;
    this.zoom = 1;
    this.shift = [0, 0, 0];
  }

  fit(low, high) {
    this.center = low.map((value, axis) => 0.5 * (value + high[axis]));
    this.radius = Math.max(0.8, 0.5 * Math.hypot(...minus(high, low)));
    this.corners = [0, 1, 2, 3, 4, 5, 6, 7].map((bits) => [0, 1, 2].map((axis) => (bits & (1 << axis) ? high : low)[axis]));
    this.distances = new Map();
  }

  /** Look at something of that half width, or at the whole scene again. */
  follow(halfWidth) {
    this.shift = [0, 0, 0];
    this.zoom = halfWidth === null ? 1 : Math.max(1, this.radius / halfWidth);
  }

  /** Distance from which the scene fills the canvas in the standing view; orbiting does not change it. */
  distance(width, height) {
    const key = `${width}x${height}`;
    if (!this.distances.has(key)) {
      const standing = frameOf(...HOME);
      const focal = focalLength(width, height);
      let distance = 2.1 * this.radius;
      for (let turn = 0; turn < 4; turn++) {
        const eye = plus(this.center, standing.back, distance);
        const filled = this.corners.map((corner) => {
          const seen = minus(corner, eye);
          const scale = focal / Math.max(dot(seen, standing.forward), 0.1 * distance);
          return Math.max(Math.abs(dot(seen, standing.right)) / width, Math.abs(dot(seen, standing.up)) / height) * scale;
        });
        distance *= Math.max(...filled, 0.05) / FILLED;
      }
      this.distances.set(key, Math.max(distance, 1.2 * this.radius, 1));
    }
    return this.distances.get(key);
  }

  orbit(right, up) {
    this.azimuth += right;
    this.elevation = Math.max(LEAST_ELEVATION, Math.min(MOST_ELEVATION, this.elevation + up));
  }

  zoomBy(factor) {
    this.zoom = Math.max(0.08, Math.min(60, this.zoom * factor));
  }

  /** Move what is looked at, by pixels on a screen of that height. */
  pan(right, up, height) {
    const metres = (2.2 * this.radius) / this.zoom / height;
    const frame = frameOf(this.azimuth, this.elevation);
    this.shift = plus(plus(this.shift, frame.right, -right * metres), frame.up, -up * metres);
  }

  /** A function from positions to [x, y, depth] in pixels; depth <= 0 is behind the eye. */
  projector(width, height) {
    const { back, forward, right, up } = frameOf(this.azimuth, this.elevation);
    const distance = this.distance(width, height) / this.zoom;
    const eye = plus(plus(this.anchor ?? this.center, this.shift), back, distance);
    const focal = focalLength(width, height);
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
