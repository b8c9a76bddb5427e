// The leaderboard: sortable by click and by keyboard, with intervals and paired differences.

/** board: an environment, or its contenders; what is drawn needs `base`, `columns` and `rows`. */
function drawBoard(environment, columns = environment.columns) {
  const state = { key: "score", down: true };
  const head = element("tr");
  const body = element("tbody");
  const scale = Math.max(...environment.rows.map(({ cells }) => (cells.score?.[0] ?? 0) + (cells.score?.[1] ?? 0)), 1e-9);
  const sortBy = (key, better) => {
    state.down = state.key === key ? !state.down : better !== -1;
    state.key = key;
    fill();
  };
  const heading = (key, title, unit, about, better) => {
    const button = element("button", { type: "button", title: about, onclick: () => sortBy(key, better) }, title);
    button.append(element("span", { class: "unit" }, unit || "\u00a0"));
    return element("th", { scope: "col", "data-key": key }, button);
  };
  head.append(heading("policy", "Policy", "", "name of the policy", -1));
  for (const column of columns) {
    head.append(heading(column.key, column.title, column.unit, column.about, column.better));
  }
  const value = (row) => (state.key === "policy" ? row.policy : row.cells[state.key]?.[0]);
  const order = (one, other) => {
    const [a, b] = [value(one), value(other)];
    if (a === null || b === null) return (a === null) - (b === null);
    const sign = typeof a === "string" ? a.localeCompare(b) : a - b;
    return state.down ? -sign : sign;
  };
  const fill = () => {
    body.replaceChildren(...[...environment.rows].sort(order).map((row) => boardRow(environment, row, columns, scale)));
    for (const th of head.children) {
      if (th.dataset.key === state.key) th.setAttribute("aria-sort", state.down ? "descending" : "ascending");
      else th.removeAttribute("aria-sort");
      const mark = th.dataset.key === state.key ? (state.down ? " ↓" : " ↑") : "";
      th.firstChild.firstChild.textContent = th.firstChild.firstChild.textContent.replace(/ [↓↑]$/, "") + mark;
    }
  };
  fill();
  return element("table", {}, element("thead", {}, head), body);
}

function boardRow(environment, row, columns, scale) {
  const own = `var(${colourName(environment.rows.indexOf(row))})`;
  const name = element("th", { scope: "row", own }, element("span", { class: "swatch" }), row.policy);
  if (row.privileged) name.append(element("span", { class: "tag", title: "it decides from the whole truth" }, "privileged"));
  if (row.policy === environment.base) name.append(element("span", { class: "tag" }, "base"));
  const cells = columns.map((column) => boardCell(column, row, environment, scale, own));
  return element("tr", {}, name, ...cells);
}

function boardCell(column, row, environment, scale, own) {
  const [mean = null, half = null] = row.cells[column.key] ?? [];
  if (column.kind === "difference") return differenceCell(column, mean, half, row.policy === environment.base);
  if (column.kind === "interval") return intervalCell(column, row.cells[column.key], row.policy === environment.base);
  const cell = element("td", { own });
  const factor = column.kind === "percent" ? 100 : 1;
  const [text, spread] = column.kind === "count" && mean !== null
    ? [String(Math.round(mean)), null]
    : rounded(mean === null ? null : factor * mean, half === null ? null : factor * half);
  const words = [text];
  if (spread !== null) words.push(element("span", { class: "half" }, `± ${spread}`));
  if (column.kind !== "score" || mean === null) cell.append(...words);
  else cell.append(element("span", { class: "score" }, scoreBar(mean, half ?? 0, scale), element("span", {}, ...words)));
  return cell;
}

/** Better and worse by a sign and a colour, and only where the interval excludes zero. */
function differenceCell(column, mean, half, isBase) {
  if (isBase) return element("td", { class: "half" }, "base");
  if (mean === null) return element("td", {}, "–");
  const clear = half !== null && Math.abs(mean) > half && mean !== 0;
  const good = mean * column.better > 0;
  const word = !clear || !column.better ? "" : good ? "better" : "worse";
  const cell = element("td", { class: word, title: word || "the interval contains zero" });
  const [text, spread] = rounded(mean, half);
  cell.append(`${word ? (good ? "▲ " : "▼ ") : ""}${withSign(text)}`);
  if (spread !== null) cell.append(element("span", { class: "half" }, `± ${spread}`));
  return cell;
}

/** A value with both ends of its interval; a difference is judged by whether they exclude zero. */
function intervalCell(column, [value, low, high], isBase) {
  if (value === null) return element("td", {}, "–");
  const isDifference = column.key.endsWith("_minus_base");
  if (isBase && isDifference) return element("td", { class: "half" }, "base");
  const known = low !== null && high !== null;
  const open = low !== null && !isDifference; // no upper end: too few flights to bound what is rare
  const word = !isDifference || !known || low * high <= 0 ? "" : value > 0 ? "better" : "worse";
  const places = known && high > low ? placesOf(0.5 * (high - low)) : null;
  const said = (x) => (x === null || places === null ? number(x, 3) : toPlaces(x, places));
  const text = isDifference ? withSign(said(value)) : said(value);
  const mark = word ? (value > 0 ? "▲ " : "▼ ") : "";
  const ends = known || open ? element("span", { class: "half" }, `[${said(low)}, ${said(high)}]`) : null;
  return element("td", { class: word }, mark + text, ends);
}

function scoreBar(mean, half, scale) {
  const x = (value) => 2 + (80 * Math.max(0, Math.min(value, scale))) / scale;
  const bar = drawing("svg", { class: "bar", viewBox: "0 0 84 14", "aria-hidden": "true" });
  bar.append(
    drawing("line", { class: "track", x1: 2, x2: 82, y1: 7, y2: 7, "stroke-width": 3 }),
    drawing("line", { class: "fill", x1: 2, x2: x(mean), y1: 7, y2: 7, "stroke-width": 3 }),
    drawing("line", { class: "whisker", x1: x(mean - half), x2: x(mean + half), y1: 7, y2: 7, "stroke-width": 1.2 }),
    drawing("line", { class: "whisker", x1: x(mean - half), x2: x(mean - half), y1: 3, y2: 11, "stroke-width": 1.2 }),
    drawing("line", { class: "whisker", x1: x(mean + half), x2: x(mean + half), y1: 3, y2: 11, "stroke-width": 1.2 }),
    drawing("circle", { class: "dot", cx: x(mean), cy: 7, r: 3.4 }),
  );
  return bar;
}
