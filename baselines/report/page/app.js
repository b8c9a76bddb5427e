// The page around the flights: heading, environments, how to repeat the run, theme, pointer and keys.

const ORBIT = 0.008; // rad per pixel
const LONG = 12; // entries, beyond which a list is folded
const KEY_ORBIT = 0.12; // rad per key

function attachCamera(canvas, camera, redraw) {
  const pointers = new Map();
  const spread = () => {
    const [a, b] = [...pointers.values()];
    return Math.hypot(a.x - b.x, a.y - b.y);
  };
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  });
  canvas.addEventListener("pointermove", (event) => {
    const last = pointers.get(event.pointerId);
    if (!last) return;
    const [dx, dy, before] = [event.clientX - last.x, event.clientY - last.y, pointers.size === 2 ? spread() : 0];
    pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    if (pointers.size === 2) camera.zoomBy(spread() / Math.max(before, 1));
    else if (event.shiftKey || event.buttons === 2) camera.pan(dx, -dy, canvas.clientHeight);
    else camera.orbit(ORBIT * dx, ORBIT * dy);
    redraw();
  });
  for (const end of ["pointerup", "pointercancel"]) {
    canvas.addEventListener(end, (event) => pointers.delete(event.pointerId));
  }
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    camera.zoomBy(Math.exp(-0.0015 * Math.max(-200, Math.min(200, event.deltaY))));
    redraw();
  }, { passive: false });
}

function onKey(event) {
  const { target, key } = event;
  if (key === "Escape" && viewer.follow) return viewer.leaveMoment();
  const typing = target.matches("select, textarea, input:not([type=range])");
  const pressing = target.matches("button, a");
  if (typing || event.ctrlKey || event.metaKey || event.altKey || !viewer.shown.length) return;
  const orbit = { ArrowLeft: [-KEY_ORBIT, 0], ArrowRight: [KEY_ORBIT, 0], ArrowUp: [0, KEY_ORBIT], ArrowDown: [0, -KEY_ORBIT] };
  const inTable = target.closest(".scroll");
  if (event.shiftKey && orbit[key]) {
    viewer.camera.orbit(...orbit[key]);
    viewer.drawScenes();
  } else if (key === " " && !pressing) viewer.toggle();
  else if (key === "ArrowLeft" && !inTable) viewer.step(-1);
  else if (key === "ArrowRight" && !inTable) viewer.step(1);
  else if (key === "Home" && !inTable) viewer.seek(0);
  else if (key === "End" && !inTable) viewer.seek(viewer.length);
  else if (key === "+" || key === "=" || key === "-") {
    viewer.camera.zoomBy(key === "-" ? 1 / 1.15 : 1.15);
    viewer.drawScenes();
  } else return;
  event.preventDefault();
}

function showHeading() {
  const { run, environments } = report;
  const policies = Object.keys(run.policies).length;
  const many = (count, word) => `${count} ${word}${count === 1 ? "" : "s"}`;
  const seeds = run.episodes === 1 ? `seed ${run.first_seed}` : `seeds ${run.first_seed} to ${run.last_seed}`;
  const { protocol } = run;
  const places = new Set(environments.map(({ place }) => place));
  const conditions = new Set(environments.map(({ condition }) => condition));
  const version = protocol.version ? `${protocol.whole ? "" : "a part of "}protocol ${protocol.version}, definition ${protocol.definition} · ` : "";
  byId("facts").textContent =
    `${version}${many(places.size, "environment")} · ${conditions.size > 1 ? `${many(conditions.size, "condition")} · ` : ""}${policies === 1 ? "1 policy" : `${policies} policies`} · ` +
    `${many(run.episodes, "flight")} each, ${seeds}`;
  byId("answers").append(...report.answers.map((sentence) => element("p", {}, sentence)));
  byId("notes").append(...report.notes.map((note) => element("li", {}, note)));
}

/** An id without what all ids have in common; labels stay as they are. */
function shortTitle({ title }) {
  return title.replace(/^quad\/(\w+)-v\d+/, "$1");
}

/** One button per name in a row of tabs; the row is empty where there is nothing to choose. */
function showTabs(id, names, chosen, onchoose) {
  const tabs = names.map((name) =>
    element("button", { type: "button", "aria-current": String(name === chosen), onclick: () => onchoose(name) }, shortTitle({ title: name })),
  );
  byId(id).replaceChildren(...(tabs.length > 1 ? tabs : []));
}

function showEnvironments() {
  const distinct = (names) => [...new Set(names)];
  const choose = (environment, opened) => {
    const { place, condition } = environment;
    const here = report.environments.filter((other) => other.place === place);
    showTabs("environments", distinct(report.environments.map((other) => other.place)), place, (name) => {
      const there = report.environments.filter((other) => other.place === name);
      choose(there.find((other) => other.condition === condition) ?? there[0]);
    });
    showTabs("conditions", here.map((other) => other.condition), condition, (name) => choose(here.find((other) => other.condition === name)));
    showRun(environment);
    showTables(environment, byId("tables").dataset.chosen ?? environment.boards[0]?.title, opened);
  };
  const opened = report.open;
  choose(report.environments.find((environment) => environment.title === opened?.env) ?? report.environments[0], opened);
}

/** The tables of an environment, and the answer that stands in them. */
function showTables(environment, title, opened) {
  const { boards } = environment;
  const board = boards.find((other) => other.title === title) ?? boards[0];
  const shown = board ?? environment;
  viewer.open(environment, board, opened);
  byId("tables").dataset.chosen = board?.title ?? "";
  const labels = boards.map((other) => [other.title, other.title]);
  byId("tables").replaceChildren(...(boards.length > 1 ? [switchOf("Table", labels, board.title, (name) => showTables(environment, name))] : []));
  byId("answer").textContent = shown.answer.sentence;
  byId("board").replaceChildren(drawBoard(shown, shown.columns.filter((column) => column.main)));
  byId("board-more").replaceChildren(drawBoard(shown));
  byId("more").hidden = shown.columns.every((column) => column.main);
  showFrontier(board);
  byId("policies").hidden = !board;
  byId("policies-board").replaceChildren(...(board ? [drawBoard(environment)] : []));
  const flights = report.run.episodes;
  const intervals = flights < 5 ? `; no intervals, which ${flights === 1 ? "one flight does" : `${flights} flights do`} not give` : " with 95 % intervals, and rounded to them";
  const base = shown.base.replace(/ \([a-z-]+\)$/, "");
  const differences = shown.rows.length > 1 ? ` Δ: paired differences to ${base} on the same starts; ▲ better, ▼ worse, where the interval excludes zero.` : "";
  const note = environment.note ? ` Note: ${environment.note}.` : "";
  const about = board?.about ? ` ${board.title}: ${board.about}.` : "";
  byId("board-lede").textContent =
    `${environment.id}. Means over flights${intervals}; – where a crash leaves no honest mean.${differences}${about}${note}`;
}

function list(title, entries) {
  const out = element("dl");
  for (const [name, value] of entries) out.append(element("dt", {}, name), element("dd", {}, value));
  return element("div", {}, element("h3", {}, title), out);
}

function words(value) {
  if (value === null) return "none";
  if (typeof value === "number") return Math.abs(value) < 1e-12 ? "0" : String(Number(value.toPrecision(6)));
  if (Array.isArray(value)) return value.every((entry) => !Array.isArray(entry)) ? `(${value.map(words).join(", ")})` : value.map(words).join(" ");
  if (typeof value === "object") return Object.entries(value).map(([key, entry]) => `${key} ${words(entry)}`).join(", ") || "defaults";
  return String(value);
}

function policyWords(title, { name, ...options }) {
  const made = Object.entries(options).map(([key, value]) => `${key}=${words(value)}`).join(", ") || "defaults";
  return name === title ? made : `${name}: ${made}`;
}

function showRun(environment) {
  const { run } = report;
  const { params, limits, weights, ...rest } = environment.task;
  const shown = Object.entries(rest).filter(([name, value]) => name !== "env_id" && !(Array.isArray(value) && !value.length) && value !== "");
  const entries = (object) => Object.entries(object).map(([name, value]) => [name.replaceAll("_", " "), words(value)]);
  byId("run").replaceChildren(
    element("pre", { tabindex: "0" }, run.command || "(not recorded)"),
    element("div", { class: "facts-grid" },
      list("Run", [
        ...(run.protocol.version ? [["protocol", words(run.protocol)]] : []),
        ["git revision", run.revision ?? "not recorded"], ["seeds", `${run.first_seed} to ${run.last_seed}`],
        ...entries(run.versions), ["platform", run.platform],
      ]),
      list(`Task ${environment.id}`, [["arguments", words(environment.kwargs)], ...entries(Object.fromEntries(shown))]),
      list("Limits, SI", entries(limits)),
      list("Vehicle, SI", entries(params)),
      list("Weights", entries(weights)),
      many("Policies", environment.rows.map(({ policy }) => [policy, policyWords(policy, run.policies[policy])])),
    ),
  );
}

/** A list that is folded where it is long. */
function many(title, entries) {
  if (entries.length <= LONG) return list(title, entries);
  return element("details", {}, element("summary", {}, `${title}: ${entries.length}`), list(title, entries));
}

function useTheme(dark) {
  document.documentElement.classList.toggle("dark", dark);
  byId("theme").textContent = dark ? "Light" : "Dark";
  if (viewer.environment) viewer.refresh();
}

function start() {
  const dark = window.matchMedia("(prefers-color-scheme: dark)");
  useTheme(dark.matches);
  dark.addEventListener("change", () => useTheme(dark.matches));
  byId("theme").addEventListener("click", () => useTheme(!document.documentElement.classList.contains("dark")));
  byId("speed").replaceWith(Object.assign(selectOf("Speed", SPEEDS.map((speed) => [speed, `${speed}×`]), 1, (speed) => {
    viewer.speed = Number(speed);
  }), { id: "speed" }));
  byId("play").addEventListener("click", () => viewer.toggle());
  byId("scrub").addEventListener("input", (event) => viewer.seek(Number(event.target.value)));
  byId("reset").addEventListener("click", () => {
    viewer.leaveMoment();
    viewer.camera.home();
    viewer.drawScenes();
  });
  document.addEventListener("keydown", onKey);
  new ResizeObserver(() => viewer.redraw()).observe(byId("flights"));
  showHeading();
  showEnvironments();
}

start();
