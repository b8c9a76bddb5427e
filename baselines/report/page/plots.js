// Plots over time that share their axis and their cursor. The lines are drawn once; the cursors are elements above.

const OUTLIER = 4; // times the next largest value, beyond which a line leaves the axis
const MARGIN = { left: 46, right: 10, top: 6, bottom: 18 };

class Plot {
  /** watch: { seek(time), hover(time or null) } */
  constructor(spec, length, watch) {
    Object.assign(this, { spec, length, watch });
    this.canvas = element("canvas", { role: "img", "aria-label": `${spec.title}, ${spec.unit}, over time` });
    this.cursor = element("div", { class: "cursor" });
    this.ghost = element("div", { class: "cursor ghost" });
    this.tip = element("div", { class: "tip", role: "status" });
    this.readout = element("span", { class: "readout" });
    this.values = spec.groups.map((group) => {
      const value = element("b", { own: group.colour, title: group.label });
      this.readout.append(value);
      return value;
    });
    const field = element("div", { class: "field" }, this.canvas, this.ghost, this.cursor, this.tip);
    const title = element("h3", {}, `${spec.title} `, element("small", {}, spec.unit));
    this.root = element("div", { class: "plot" }, element("header", {}, title, this.readout), field);
    this.listen(field);
    this.range = this.findRange();
  }

  listen(field) {
    const timeAt = (event) => {
      const box = this.canvas.getBoundingClientRect();
      const share = (event.clientX - box.left - MARGIN.left) / (box.width - MARGIN.left - MARGIN.right);
      return this.length * Math.max(0, Math.min(1, share));
    };
    field.addEventListener("pointermove", (event) => {
      const time = timeAt(event);
      if (event.buttons) this.watch.seek(time);
      this.watch.hover(time, this);
    });
    field.addEventListener("pointerdown", (event) => this.watch.seek(timeAt(event)));
    field.addEventListener("pointerleave", () => this.watch.hover(null, this));
  }

  /** Limits are part of the picture, unless everything stays far away from them. */
  findRange() {
    const { groups, limits, zero, log, band } = this.spec;
    const ranges = groups.map(({ series }) => rangeOf(series));
    let low = Math.min(...ranges.map((range) => range[0]));
    let high = Math.max(...ranges.map((range) => range[1]));
    if (low > high) [low, high] = [0, 1];
    const others = log ? high : withoutOutliers(ranges.map((range) => range[1]));
    this.outside = groups.filter((_, i) => ranges[i][1] > others).map((group) => group.label);
    high = Math.min(high, others);
    this.root.querySelector("h3 small").textContent = this.outside.length
      ? `${this.spec.unit}; ${this.outside.join(", ")} leaves the axis`
      : this.spec.unit;
    if (log) {
      if (band) [low, high] = [Math.min(low, band[0]), Math.max(high, band[1])];
      return [Math.log10(Math.max(low, 1e-4)) - 0.1, Math.log10(Math.max(high, 1e-4)) + 0.1];
    }
    for (const { value } of limits) {
      if (value < high + 2.5 * (high - low) && value > low - 2.5 * (high - low)) [low, high] = [Math.min(low, value), Math.max(high, value)];
    }
    if (zero) low = Math.min(low, 0);
    const pad = 0.07 * (high - low || Math.abs(high) || 1);
    return [zero && low === 0 ? -0.02 * (high || 1) : low - pad, high + pad];
  }

  place(width, height) {
    const [low, high] = this.range;
    const inner = { width: width - MARGIN.left - MARGIN.right, height: height - MARGIN.top - MARGIN.bottom };
    this.x = (time) => MARGIN.left + (inner.width * time) / this.length;
    this.y = (value) => {
      const level = this.spec.log ? Math.log10(Math.max(value, 1e-9)) : value;
      return MARGIN.top + inner.height * (1 - (level - low) / (high - low));
    };
  }

  draw() {
    const { context, width, height } = prepare(this.canvas);
    if (!width) return;
    this.place(width, height);
    this.drawFrame(context, width, height);
    context.save();
    context.beginPath();
    context.rect(MARGIN.left, MARGIN.top - 2, width - MARGIN.left - MARGIN.right, height - MARGIN.top - MARGIN.bottom + 4);
    context.clip();
    const crowd = this.spec.groups.reduce((sum, group) => sum + group.series.length, 0) > 8;
    for (const group of this.spec.groups) {
      for (const series of group.series) this.drawLine(context, series, group.colour, crowd || this.spec.fine ? 1.15 : 1.7);
    }
    context.restore();
  }

  drawFrame(context, width, height) {
    const [low, high] = this.range;
    const [line, soft, limit] = [css("--line"), css("--soft"), css("--limit")];
    const bottom = height - MARGIN.bottom;
    context.font = "11px system-ui, sans-serif";
    context.lineWidth = 1;
    context.textBaseline = "middle";
    context.textAlign = "right";
    const marks = this.spec.log ? decades(low, high) : ticks(low, high, 4);
    for (const mark of marks) {
      const y = this.y(mark);
      context.strokeStyle = line;
      strokeLine(context, MARGIN.left, y, width - MARGIN.right, y);
      context.fillStyle = soft;
      context.fillText(tickLabel(mark), MARGIN.left - 7, y);
    }
    context.textBaseline = "alphabetic";
    context.textAlign = "center";
    for (const mark of ticks(0, this.length, Math.max(2, width / 110))) {
      const last = mark > 0.93 * this.length;
      context.textAlign = last ? "right" : "center";
      context.fillText(`${tickLabel(mark)}${last ? " s" : ""}`, this.x(mark) + (last ? 8 : 0), height - 4);
    }
    this.drawShades(context, width, bottom, limit);
  }

  drawShades(context, width, bottom, limit) {
    const { band, above: forbidden, limits } = this.spec;
    const inner = width - MARGIN.left - MARGIN.right;
    if (band) {
      context.fillStyle = withAlpha(css("--c2"), 0.16);
      context.fillRect(MARGIN.left, this.y(band[1]), inner, this.y(band[0]) - this.y(band[1]));
    }
    if (forbidden !== undefined && this.y(forbidden) > MARGIN.top) {
      context.fillStyle = css("--wash");
      context.fillRect(MARGIN.left, MARGIN.top, inner, Math.min(this.y(forbidden), bottom) - MARGIN.top);
    }
    context.setLineDash([5, 3]);
    let above = Infinity; // height of the label before
    for (const { value, text } of limits) {
      const y = this.y(value);
      if (y < MARGIN.top - 1 || y > bottom + 1) continue;
      context.strokeStyle = context.fillStyle = limit;
      strokeLine(context, MARGIN.left, y, width - MARGIN.right, y);
      context.textAlign = "right";
      const beside = Math.abs(y - above) < 13 ? 34 : 3; // two labels at one height stand side by side
      if (text) context.fillText(text, width - MARGIN.right - beside, y > MARGIN.top + 12 ? y - 3 : y + 11);
      above = y;
    }
    context.setLineDash([]);
  }

  drawLine(context, { values, dash, dt, end }, colour, thickness) {
    context.beginPath();
    let down = false;
    for (let k = 0; k < Math.min(values.length, end + 1); k++) {
      if (!Number.isFinite(values[k])) down = false;
      else {
        context[down ? "lineTo" : "moveTo"](this.x(k * dt), this.y(values[k]));
        down = true;
      }
    }
    context.strokeStyle = colour;
    context.lineWidth = thickness;
    context.lineJoin = "round";
    context.setLineDash(dash);
    context.stroke();
    context.setLineDash([]);
  }

  /** Cursor at the time of the flight, ghost at the time of the pointer; the numbers are those of the pointer's time. */
  mark(time, hovered, here) {
    if (!this.x) return;
    this.cursor.style.transform = `translateX(${this.x(time)}px)`;
    this.ghost.style.visibility = hovered === null ? "hidden" : "visible";
    if (hovered !== null) this.ghost.style.transform = `translateX(${this.x(hovered)}px)`;
    const at = hovered ?? time;
    this.spec.groups.forEach((group, i) => {
      const found = group.series.map((series) => valueAt(series, at)).filter(Number.isFinite);
      const said = (value) => toPlaces(value, this.spec.places);
      const text = found.length > 4 ? `${said(Math.min(...found))} … ${said(Math.max(...found))}` : found.map(said).join("  ");
      this.values[i].textContent = text || "–";
    });
    this.tip.style.visibility = here && hovered !== null ? "visible" : "hidden";
    if (here && hovered !== null) this.fillTip(hovered);
  }

  said(value) {
    return Number.isFinite(value) ? toPlaces(value, this.spec.places) : "–";
  }

  fillTip(time) {
    const lines = this.spec.groups.flatMap((group) =>
      group.series.slice(0, 12).map((series) =>
        element("div", { own: group.colour }, `${[group.label, series.name].filter(Boolean).join(" · ")}  ${this.said(valueAt(series, time))}`),
      ),
    );
    this.tip.replaceChildren(element("span", {}, `${time.toFixed(2)} s`), ...lines.slice(0, 16));
    const x = this.x(time);
    const room = this.canvas.clientWidth;
    const left = x > room / 2 ? x - this.tip.offsetWidth - 12 : x + 12;
    this.tip.style.transform = `translateX(${Math.max(0, Math.min(left, room - this.tip.offsetWidth))}px)`;
  }
}

function valueAt({ values, dt, end }, time) {
  const row = Math.floor(time / dt + 1e-6);
  return row > end ? NaN : values[Math.min(row, values.length - 1)];
}

/** Smallest and largest value of some lines; [Infinity, -Infinity] where there is none. */
function rangeOf(series) {
  let [low, high] = [Infinity, -Infinity];
  for (const { values, end } of series) {
    for (let k = 0; k < Math.min(values.length, end + 1); k++) {
      if (!Number.isFinite(values[k])) continue;
      low = Math.min(low, values[k]);
      high = Math.max(high, values[k]);
    }
  }
  return [low, high];
}

/** Where an axis ends so that one line far above the others does not flatten them. */
function withoutOutliers(highs) {
  const [first, second] = [...highs].sort((a, b) => b - a);
  return second > 0 && first > OUTLIER * second ? 1.5 * second : first;
}

function decades(low, high) {
  const out = [];
  for (let power = Math.ceil(low); power <= high; power++) out.push(10 ** power);
  const step = Math.ceil(out.length / 4);
  return out.length > 1 ? out.filter((_, i) => i % step === 0) : ticks(10 ** low, 10 ** high, 3);
}

function strokeLine(context, x0, y0, x1, y1) {
  context.beginPath();
  context.moveTo(x0, y0);
  context.lineTo(x1, y1);
  context.stroke();
}
