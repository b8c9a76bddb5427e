// Words, numbers, colours and elements. Text from the data is only ever set as text, never as markup.

const VEHICLE_COLOURS = 8;
const NO_MORE = 1e-4; // half width over the mean, below which the interval is not worth its digits

function element(kind, settings = {}, ...children) {
  const made = document.createElement(kind);
  for (const [name, value] of Object.entries(settings)) {
    if (name === "class") made.className = value;
    else if (name === "own") made.style.setProperty("--own", value);
    else if (name.startsWith("on")) made.addEventListener(name.slice(2), value);
    else if (value !== undefined && value !== false) made.setAttribute(name, value === true ? "" : value);
  }
  made.append(...children.filter((child) => child !== null));
  return made;
}

function drawing(kind, settings) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", kind);
  for (const [name, value] of Object.entries(settings)) made.setAttribute(name, value);
  return made;
}

/** Four significant digits, no exponent where it can be helped. */
function number(value, digits = 4) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  if (size === 0) return "0";
  if (size >= 1e6 || size < 1e-5) return value.toExponential(2);
  if (size >= 10 ** (digits - 1)) return value.toFixed(0);
  const places = Math.min(6, digits - 1 - Math.floor(Math.log10(size)));
  return value.toFixed(Math.max(0, places)).replace("-", "−");
}

/** Decimal places that an interval leaves meaning to: one digit of its half width, two where it begins with 1. */
function placesOf(half) {
  const power = Math.floor(Math.log10(half));
  return -power + (half / 10 ** power < 2 ? 1 : 0);
}

/** A number to so many places; below none to tens, hundreds and so on. */
function toPlaces(value, places) {
  const text = places >= 0 ? value.toFixed(Math.min(places, 8)) : (Math.round(value / 10 ** -places) * 10 ** -places).toFixed(0);
  return Number(text) === 0 ? text.replace("-", "") : text.replace("-", "−");
}

/** A mean and the half width of its interval as texts, rounded to the interval; without one the half is null. */
function rounded(mean, half, digits = 3) {
  if (mean === null) return ["–", null];
  if (half === null || half === undefined || !(half > NO_MORE * Math.abs(mean))) return [number(mean, digits), null];
  const places = placesOf(half);
  return [toPlaces(mean, places), toPlaces(half, places)];
}

function withSign(text) {
  return text.startsWith("−") || text === "–" ? text : `+${text}`;
}

/** The colour variable of a policy, or of a vehicle where one team alone is shown. */
function colourName(index) {
  return `--c${index % VEHICLE_COLOURS}`;
}

function css(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

function withAlpha(colour, alpha) {
  return colour + Math.round(255 * alpha).toString(16).padStart(2, "0");
}

/** Ticks at round numbers over a range. */
function ticks(low, high, wanted) {
  const raw = (high - low) / Math.max(1, wanted);
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map((factor) => factor * power).find((size) => size >= raw) ?? 10 * power;
  const out = [];
  for (let tick = Math.ceil(low / step - 1e-9) * step; tick <= high + 1e-9 * step; tick += step) out.push(tick);
  return out;
}

function tickLabel(value) {
  if (Math.abs(value) < 1e-12) return "0";
  return String(Number(value.toPrecision(3))).replace("-", "−");
}

/** A canvas sized for the screen's pixels, cleared, in CSS units. */
function prepare(canvas) {
  const ratio = window.devicePixelRatio || 1;
  const { clientWidth: width, clientHeight: height } = canvas;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}

function switchOf(label, options, chosen, onchoose) {
  const group = element("span", { class: "switch", role: "group", "aria-label": label });
  for (const [value, text] of options) {
    group.append(
      element("button", { type: "button", "aria-pressed": String(value === chosen), onclick: () => onchoose(value) }, text),
    );
  }
  return group;
}

function selectOf(label, options, chosen, onchoose) {
  const select = element("select", { "aria-label": label, onchange: (event) => onchoose(event.target.value) });
  for (const [value, text] of options) {
    const option = element("option", { value }, text);
    option.selected = String(value) === String(chosen);
    select.append(option);
  }
  return select;
}
