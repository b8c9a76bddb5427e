// One moment of one or several flights in space. Everything is drawn from rows of the flights' tables.

const SIGMA_95 = 2.7955; // sqrt of the 95 % quantile of chi-square with 3 degrees of freedom
const LEAST_LABELLED = 46; // px, from which an error says how long it is
const LEAST_ARM = 11; // px, below which vehicles are drawn larger than they are
const CIRCLE = Array.from({ length: 33 }, (_, i) => [Math.cos((i * Math.PI) / 16), Math.sin((i * Math.PI) / 16)]);
const EDGES = [0, 1, 2, 3, 4, 5, 6, 7].flatMap((a) => [1, 2, 4].filter((bit) => !(a & bit)).map((bit) => [a, a | bit]));

/** Extent of what is wanted; a flight that leaves it far behind does not shrink the picture to nothing. */
function extent(flights, task) {
  const low = [Infinity, Infinity, Infinity];
  const high = [-Infinity, -Infinity, -Infinity];
  const take = (table, rows) => {
    for (const axis of [0, 1, 2]) {
      for (const value of rows ? table[axis].subarray(0, rows) : table[axis]) {
        if (Number.isFinite(value)) {
          low[axis] = Math.min(low[axis], value);
          high[axis] = Math.max(high[axis], value);
        }
      }
    }
  };
  for (const { tables } of flights) {
    const wanted = tables.reference ?? tables.p;
    wanted.forEach((table) => take(table));
    tables.p.forEach((table) => take(table, 1));
    tables.target?.forEach((table) => take(table));
  }
  const { position_lower: lower, position_upper: upper } = task.limits;
  for (const axis of [0, 1, 2]) {
    if (lower[axis] !== null && upper[axis] !== null) take(low.map((_, i) => (i === axis ? [lower[i], upper[i]] : [])));
  }
  return { low, high };
}

class Scene {
  /** shown: [{ flight, colourOf(vehicle) }], all of the same start. */
  constructor(canvas, camera, environment) {
    Object.assign(this, { canvas, camera, environment, shown: [] });
  }

  show(shown, bounds) {
    this.shown = shown;
    this.bounds = bounds;
    let lowest = bounds.high[2]; // z points down
    for (const { flight } of shown) {
      for (const [, , z] of flight.tables.p) for (const value of z) if (value > lowest) lowest = value;
    }
    this.floor = lowest + 0.12 * Math.max(1, bounds.high[2] - bounds.low[2]);
  }

  draw(time) {
    const { context, width, height } = prepare(this.canvas);
    if (!width || !this.shown.length) return;
    const project = this.camera.projector(width, height);
    Object.assign(this, { context, width, height, project });
    this.arm = this.environment.task.params.arm;
    this.factor = Math.max(1, LEAST_ARM / (this.arm * project.perMetre));
    this.colours = {
      ground: css("--ground"), ink: css("--ink"), soft: css("--soft"), faint: css("--faint"),
      limit: css("--limit"), reference: css("--reference"), target: css("--target"), paper: css("--sheet"),
    };
    context.lineJoin = context.lineCap = "round";
    this.drawGround();
    this.drawBox(time);
    this.drawReference(time);
    this.drawTarget(time);
    const bodies = this.shown.flatMap((entry) => this.drawFlight(entry, time));
    bodies.sort((one, other) => other.depth - one.depth).forEach(({ paint }) => paint());
    this.drawAxes();
  }

  path(points, colour, width = 1, dash = []) {
    const { context } = this;
    context.beginPath();
    let down = false;
    for (const point of points) {
      const [x, y, depth] = this.project(point);
      if (!(depth > this.project.near)) down = false; // nan too
      else if (down) context.lineTo(x, y);
      else {
        context.moveTo(x, y);
        down = true;
      }
    }
    context.strokeStyle = colour;
    context.lineWidth = width;
    context.setLineDash(dash);
    context.stroke();
    context.setLineDash([]);
  }

  disc(point, radius, colour, hollow = false) {
    const { context } = this;
    const [x, y, depth] = this.project(point);
    if (!(depth > this.project.near)) return;
    context.beginPath();
    context.arc(x, y, radius, 0, 2 * Math.PI);
    if (hollow) {
      context.strokeStyle = colour;
      context.lineWidth = 1.6;
      context.stroke();
    } else {
      context.fillStyle = colour;
      context.fill();
    }
  }

  rows(table, from, to, step = 1) {
    const out = [];
    for (let row = Math.max(0, from); row <= Math.min(to, table[0].length - 1); row += step) {
      out.push([table[0][row], table[1][row], table[2][row]]);
    }
    return out;
  }

  drawGround() {
    const { low, high } = this.bounds;
    const middle = [0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1])];
    const reach = 0.5 * Math.hypot(high[0] - low[0], high[1] - low[1]) + 0.35 * this.camera.radius + 0.5;
    this.cell = [0.5, 1, 2, 5, 10, 20, 50].find((size) => reach / size < 9) ?? 100;
    for (const axis of [0, 1]) {
      for (const place of ticks(middle[axis] - reach, middle[axis] + reach, (2 * reach) / this.cell)) {
        const chord = Math.sqrt(Math.max(0, reach ** 2 - (place - middle[axis]) ** 2));
        const end = (side) => (axis ? [middle[0] + side * chord, place, this.floor] : [place, middle[1] + side * chord, this.floor]);
        this.path([end(-1), end(-0.5), end(0), end(0.5), end(1)], this.colours.ground, 1);
      }
    }
  }

  /** Position limits; edges of a face that a vehicle is beyond are drawn strongly. */
  drawBox(time) {
    const { position_lower: lower, position_upper: upper } = this.environment.task.limits;
    if (![...lower, ...upper].some((value) => value !== null)) return;
    const far = 1.3 * this.camera.radius;
    const centre = this.camera.center;
    const faces = [lower.map((v, i) => v ?? centre[i] - far), upper.map((v, i) => v ?? centre[i] + far)];
    const beyond = [0, 1].map((side) => [0, 1, 2].map((axis) => this.isBeyond(time, side, axis, (side ? upper : lower)[axis])));
    const corner = (bits) => [0, 1, 2].map((axis) => faces[(bits >> axis) & 1][axis]);
    for (const [a, b] of EDGES) {
      const broken = [0, 1, 2].some((axis) => !((a ^ b) & (1 << axis)) && beyond[(a >> axis) & 1][axis]);
      this.path([corner(a), corner(b)], broken ? this.colours.limit : withAlpha(this.colours.limit, 0.4), broken ? 2.2 : 1);
    }
  }

  isBeyond(time, side, axis, limit) {
    if (limit === null) return false;
    const slack = this.environment.task.tolerance;
    return this.shown.some(({ flight }) =>
      flight.tables.p.some((table, vehicle) => {
        const p = sample(table[axis], Math.min(time / flight.dt, lastRow(flight, vehicle)));
        return side ? p > limit + slack : p < limit - slack;
      }),
    );
  }

  drawReference(time) {
    const longest = this.shown.reduce((a, b) => (a.flight.tables.reference?.[0][0].length >= b.flight.tables.reference?.[0][0].length ? a : b));
    const { reference } = longest.flight.tables;
    if (!reference) return;
    const row = time / longest.flight.dt;
    const team = reference.length > 1;
    reference.forEach((table) => {
      const colour = withAlpha(this.colours.reference, team ? 0.35 : 0.9);
      this.path(this.rows(table, 0, Infinity), colour, team ? 1 : 1.4, [5, 4]);
      const here = samplePoint(table, Math.min(row, table[0].length - 1));
      if (here.every(Number.isFinite)) this.cross(here, 5, this.colours.reference);
    });
  }

  cross(point, size, colour) {
    const { context } = this;
    const [x, y, depth] = this.project(point);
    if (!(depth > this.project.near)) return;
    context.beginPath();
    context.moveTo(x - size, y);
    context.lineTo(x + size, y);
    context.moveTo(x, y - size);
    context.lineTo(x, y + size);
    context.strokeStyle = colour;
    context.lineWidth = 1.6;
    context.stroke();
  }

  drawTarget(time) {
    const entry = this.shown.find(({ flight }) => flight.tables.target);
    if (!entry) return;
    const table = entry.flight.tables.target[0];
    const row = Math.min(time / entry.flight.dt, table[0].length - 1);
    this.path(this.rows(table, 0, Infinity), withAlpha(this.colours.target, 0.25), 1, [2, 4]);
    this.path([...this.rows(table, 0, Math.floor(row)), samplePoint(table, row)], this.colours.target, 1.6);
    const [x, y, depth] = this.project(samplePoint(table, row));
    if (!(depth > this.project.near)) return;
    const { context } = this;
    context.save();
    context.translate(x, y);
    context.rotate(Math.PI / 4);
    context.fillStyle = this.colours.target;
    context.fillRect(-5, -5, 10, 10);
    context.restore();
  }

  /** Trails, links and beliefs at once; the bodies are returned, to be painted from far to near. */
  drawFlight({ flight, colourOf }, time) {
    const row = time / flight.dt;
    const places = flight.tables.p.map((table, vehicle) => samplePoint(table, Math.min(row, lastRow(flight, vehicle))));
    this.drawLinks(flight, places, row);
    return flight.tables.p.map((table, vehicle) => {
      const colour = colourOf(vehicle);
      const last = lastRow(flight, vehicle);
      const now = Math.min(row, last);
      this.path(this.rows(table, Math.floor(now), last), withAlpha(colour, 0.28), 1.3);
      this.path([...this.rows(table, 0, Math.floor(now)), places[vehicle]], colour, 2);
      this.drawError(flight, vehicle, row, places[vehicle], colour);
      this.drawBelief(flight, vehicle, row, colour);
      const [x, y, z] = places[vehicle];
      if (z < this.floor) {
        this.path([[x, y, z], [x, y, this.floor]], withAlpha(this.colours.faint, 0.5), 1);
        this.disc([x, y, this.floor], 2.2, withAlpha(this.colours.faint, 0.8));
      }
      const depth = this.project(places[vehicle])[2];
      return { depth, paint: () => this.drawVehicle(flight, vehicle, places[vehicle], now, colour, row >= last) };
    });
  }

  /** From a vehicle to where it should be, with the distance where there is room for it. */
  drawError(flight, vehicle, row, place, colour) {
    const table = flight.tables.reference?.[vehicle];
    if (!table || flight.lengths.length > 1 || row > lastRow(flight, vehicle)) return;
    const wanted = samplePoint(table, Math.min(row, table[0].length - 1));
    this.path([place, wanted], colour, 1.6, [1.5, 4]);
    const [[x0, y0, near], [x1, y1, far]] = [this.project(place), this.project(wanted)];
    if (!(Math.min(near, far) > this.project.near) || Math.hypot(x1 - x0, y1 - y0) < LEAST_LABELLED) return;
    const { context } = this;
    context.font = "600 12px system-ui, sans-serif";
    context.textAlign = "left";
    context.lineWidth = 3;
    context.strokeStyle = this.colours.paper;
    context.fillStyle = colour;
    const text = `${Math.hypot(...minus(place, wanted)).toFixed(2)} m`;
    const at = [0.5 * (x0 + x1) + 8, 0.5 * (y0 + y1) + 4];
    context.strokeText(text, ...at);
    context.fillText(text, ...at);
  }

  drawLinks(flight, places, row) {
    if (!flight.schedule.length) return;
    const held = flight.schedule.filter(([from]) => from <= Math.max(0, row)).at(-1)[1];
    for (const [hearer, sender] of flight.graphs[held]) {
      const [to, from] = [places[hearer], places[sender]];
      this.path([from, to], withAlpha(this.colours.soft, 0.45), 1);
      const head = plus(from, minus(to, from), 0.62);
      this.disc(head, 2, withAlpha(this.colours.soft, 0.8));
    }
    const wanted = this.environment.task.separation;
    if (!wanted || !flight.tables.separation) return;
    places.forEach((one, i) =>
      places.slice(0, i).forEach((other) => {
        if (Math.hypot(...minus(one, other)) < wanted - this.environment.task.tolerance) this.path([one, other], this.colours.limit, 2.5);
      }),
    );
  }

  /** Where a vehicle believes the target to be, with the great circles of its 95 % ellipsoid. */
  drawBelief(flight, vehicle, row, colour) {
    const { estimate, root } = flight.tables;
    if (!estimate) return;
    const at = Math.max(0, Math.min(Math.floor(row), estimate[vehicle][0].length - 1));
    const centre = [0, 1, 2].map((axis) => estimate[vehicle][axis][at]);
    if (!centre.every(Number.isFinite)) return;
    this.disc(centre, 3, colour, true);
    if (!root) return;
    const [xx, yx, yy, zx, zy, zz] = root[vehicle].map((series) => SIGMA_95 * series[at]);
    for (const [i, j] of [[0, 1], [1, 2], [0, 2]]) {
      const ring = CIRCLE.map(([c, s]) => {
        const unit = [0, 0, 0];
        unit[i] = c;
        unit[j] = s;
        const spread = [xx * unit[0], yx * unit[0] + yy * unit[1], zx * unit[0] + zy * unit[1] + zz * unit[2]];
        return plus(centre, spread);
      });
      this.path(ring, withAlpha(colour, 0.6), 1);
    }
  }

  drawVehicle(flight, vehicle, place, row, colour, ended) {
    const { attitude, forces, constraints } = flight.tables;
    if (!attitude) {
      this.disc(place, 5, colour);
      return;
    }
    const angles = attitude[vehicle].map((series) => series[Math.round(row)]);
    const reach = this.arm * this.factor;
    const body = (vector) => plus(place, rotate(angles, vector));
    const arms = this.environment.task.rotors.map(([x, y]) => [reach * x, reach * y, 0]);
    const violated = constraints?.[vehicle].some((series) => series[Math.max(0, Math.ceil(row) - 1)] > this.environment.task.tolerance);
    if (violated) {
      const [x, y] = this.project(place);
      this.context.beginPath();
      this.context.arc(x, y, 1.9 * reach * this.project.perMetre, 0, 2 * Math.PI);
      this.context.fillStyle = withAlpha(this.colours.limit, 0.14);
      this.context.strokeStyle = this.colours.limit;
      this.context.lineWidth = 1.2;
      this.context.fill();
      this.context.stroke();
    }
    this.path([body(arms[0]), body(arms[2])], colour, 2.4);
    this.path([body(arms[1]), body(arms[3])], colour, 2.4);
    arms.forEach((arm, i) => {
      const rim = CIRCLE.map(([c, s]) => body([arm[0] + 0.62 * reach * c, arm[1] + 0.62 * reach * s, 0]));
      this.fill(rim, withAlpha(colour, i === 0 ? 0.75 : 0.25));
      this.path(rim, colour, i === 0 ? 1.6 : 1);
      if (forces) {
        const share = forces[vehicle][i][Math.round(row)] / this.environment.task.force_max[i];
        this.path([body(arm), body([arm[0], arm[1], -1.5 * reach * share])], this.colours.ink, 1.3);
      }
    });
    if (flight.crashed[vehicle] && ended) this.drawCrash(place);
  }

  fill(points, colour) {
    const { context } = this;
    context.beginPath();
    points.forEach((point, i) => context[i ? "lineTo" : "moveTo"](...this.project(point).slice(0, 2)));
    context.fillStyle = colour;
    context.fill();
  }

  drawCrash(place) {
    const { context } = this;
    const [x, y] = this.project(place);
    context.strokeStyle = this.colours.limit;
    context.lineWidth = 3;
    context.beginPath();
    for (const side of [-1, 1]) {
      context.moveTo(x - 9, y - 9 * side);
      context.lineTo(x + 9, y + 9 * side);
    }
    context.stroke();
    context.fillStyle = this.colours.limit;
    context.font = "600 12px system-ui, sans-serif";
    context.textAlign = "left";
    context.fillText("crashed", x + 14, y + 4);
  }

  drawAxes() {
    const { context, height, colours } = this;
    const [x, y] = [38, height - 40];
    context.font = "12px system-ui, sans-serif";
    context.textAlign = "center";
    context.textBaseline = "middle";
    for (const [name, direction] of [["x", [1, 0, 0]], ["y", [0, 1, 0]], ["up", [0, 0, -1]]]) {
      const [u, v] = this.project.axis(direction).map((part) => 22 * part);
      context.strokeStyle = context.fillStyle = colours.soft;
      context.lineWidth = 1.4;
      context.beginPath();
      context.moveTo(x, y);
      context.lineTo(x + u, y + v);
      context.stroke();
      context.fillText(name, x + 1.5 * u, y + 1.5 * v);
    }
    context.textAlign = "right";
    const drawn = this.factor > 1.05 && this.environment.task.mission !== "estimation" ? ` · vehicles ×${this.factor.toFixed(1)}` : "";
    context.fillStyle = colours.soft;
    context.fillText(`grid ${tickLabel(this.cell)} m${drawn}`, this.width - 14, height - 16);
    context.textBaseline = "alphabetic";
  }
}
