// The frontier: score against quadratic cost. The family of an MPC is a line, every contender a point with its intervals.

const PLANE = { width: 900, height: 440, left: 56, right: 20, top: 14, bottom: 46 };
const LINE = 15; // px, between two names

function drawFrontier(board) {
  const known = board.frontier.filter(({ score, cost }) => score[0] !== null && cost[0] !== null && cost[0] > 0);
  const family = known.filter(({ trace }) => trace);
  const contenders = known.filter(({ trace }) => !trace);
  const plane = planeOf(family, contenders);
  const picture = drawing("svg", { class: "frontier", viewBox: `0 0 ${PLANE.width} ${PLANE.height}`, role: "img", "aria-label": "Score against quadratic cost" });
  drawPlane(picture, plane);
  for (const trace of new Set(family.map((point) => point.trace))) {
    const points = family.filter((point) => point.trace === trace).sort((a, b) => a.cost[0] - b.cost[0]);
    drawTrace(picture, plane, trace, points);
  }
  const shown = contenders.filter((point) => plane.holds(point));
  drawContenders(picture, plane, board, shown);
  const away = board.frontier.filter((point) => !point.trace && !shown.includes(point)).map(({ name }) => name);
  const note = away.length ? element("p", { class: "legend" }, `Not in the picture, since they crash or lie far below: ${away.join(", ")}.`) : null;
  return element("div", {}, picture, ...(note ? [note] : []));
}

/** Axes that hold the family, and what is near it: one contender far away does not flatten the others. */
function planeOf(family, contenders) {
  const scores = family.map(({ score }) => score[0]);
  const costs = family.map(({ cost }) => cost[0]);
  const room = Math.max(...scores) - Math.min(...scores) + 0.02;
  const near = contenders.filter(({ score, cost }) => score[0] > Math.min(...scores) - 2 * room && cost[0] < 2.5 * Math.max(...costs));
  const all = [...family, ...near];
  const value = (interval, i) => interval[i] ?? interval[0];
  const range = (pick, map) => {
    const low = Math.min(...all.map((point) => map(value(pick(point), 1))));
    const high = Math.max(...all.map((point) => map(value(pick(point), 2))));
    return [low - 0.05 * (high - low), high + 0.05 * (high - low)];
  };
  const [left, right] = range(({ cost }) => cost, Math.log);
  const [low, high] = range(({ score }) => score, (x) => x);
  const inner = { width: PLANE.width - PLANE.left - PLANE.right, height: PLANE.height - PLANE.top - PLANE.bottom };
  return {
    costs: [Math.exp(left), Math.exp(right)],
    scores: [low, high],
    x: (cost) => PLANE.left + (inner.width * (Math.log(cost) - left)) / (right - left),
    y: (score) => PLANE.top + inner.height * (1 - (score - low) / (high - low)),
    holds: (point) => near.includes(point),
  };
}

function labelled(picture, x, y, anchor, text, kind = "") {
  const label = drawing("text", { x, y, "text-anchor": anchor, class: kind });
  label.textContent = text;
  picture.append(label);
  return label;
}

function drawPlane(picture, plane) {
  const bottom = PLANE.height - PLANE.bottom;
  for (const score of ticks(...plane.scores, 6)) {
    picture.append(drawing("line", { class: "axis", x1: PLANE.left, x2: PLANE.width - PLANE.right, y1: plane.y(score), y2: plane.y(score) }));
    labelled(picture, PLANE.left - 8, plane.y(score) + 4, "end", tickLabel(score));
  }
  for (const cost of ticks(...plane.costs, 7)) {
    picture.append(drawing("line", { class: "axis", x1: plane.x(cost), x2: plane.x(cost), y1: PLANE.top, y2: bottom }));
    labelled(picture, plane.x(cost), bottom + 18, "middle", tickLabel(cost));
  }
  labelled(picture, PLANE.width - PLANE.right, PLANE.height - 8, "end", "quadratic cost, less is better");
  labelled(picture, PLANE.left, PLANE.height - 8, "start", "↑ score, more is better");
}

function drawTrace(picture, plane, trace, points) {
  const places = points.map(({ cost, score }) => `${plane.x(cost[0])},${plane.y(score[0])}`);
  picture.append(drawing("polyline", { class: "trace", points: places.join(" ") }));
  for (const { name, cost, score } of points) {
    const step = drawing("circle", { class: "step", cx: plane.x(cost[0]), cy: plane.y(score[0]), r: 3 });
    step.append(titleOf(name, score, cost));
    picture.append(step);
  }
  const last = points.at(-1);
  labelled(picture, plane.x(last.cost[0]), plane.y(last.score[0]) - 9, "end", trace);
}

/** Points, and their names beside them, moved down where two would stand on each other. */
function drawContenders(picture, plane, board, points) {
  const taken = [];
  for (const point of [...points].sort((a, b) => b.score[0] - a.score[0])) {
    const own = `var(${colourName(board.rows.findIndex((row) => row.policy === `${point.name} (${point.kind})`))})`;
    const { name, cost, score } = point;
    const [x, y] = [plane.x(cost[0]), plane.y(score[0])];
    const group = drawing("g", {});
    group.style.setProperty("--own", own);
    if (cost[1] !== null) group.append(drawing("line", { class: "spread", x1: plane.x(cost[1]), x2: plane.x(cost[2]), y1: y, y2: y }));
    if (score[1] !== null) group.append(drawing("line", { class: "spread", x1: x, x2: x, y1: plane.y(score[1]), y2: plane.y(score[2]) }));
    const dot = drawing("circle", { class: "point", cx: x, cy: y, r: 5 });
    dot.append(titleOf(name, score, cost));
    group.append(dot);
    picture.append(group);
    const left = x > 0.75 * PLANE.width;
    let height = y - 6;
    while (taken.some(([u, v]) => Math.abs(u - x) < 170 && Math.abs(v - height) < LINE)) height += LINE;
    taken.push([x, height]);
    labelled(picture, x + (left ? -9 : 9), height, left ? "end" : "start", name, "name");
  }
}

function titleOf(name, score, cost) {
  const half = ([, low, high]) => (low === null || high === null ? null : 0.5 * (high - low));
  const said = (interval) => rounded(interval[0], half(interval)).filter((text) => text !== null).join(" ± ");
  const title = drawing("title", {});
  title.textContent = `${name}: score ${said(score)}, quadratic cost ${said(cost)}`;
  return title;
}
