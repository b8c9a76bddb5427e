// The flights of one environment: what is chosen, the clock, and who draws it.

const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];
const MOMENT = [1.5, 1.0]; // s before and after the largest difference that are played again and again
const LEAST_LOOK = 0.5; // m, half width of the closest look
const byId = (id) => document.getElementById(id);

const viewer = {
  environment: null, board: null, camera: new Camera(), scenes: [], plots: [], shown: [],
  seed: null, chosen: new Set(), layout: "overlay", focus: null, follow: "",
  time: 0, length: 1, speed: 1, playing: false, hovered: null, hoveredPlot: null, turn: 0,
  loop: null, // [begin, end] in s that is played again and again

  /** board: the table of the environment whose policies are shown; null for all of them. */
  async open(environment, board, opened) {
    this.environment = environment;
    this.board = board ?? null;
    this.stop();
    const seeds = this.seeds();
    const any = seeds.length > 0;
    for (const part of document.querySelectorAll(".viewer, #choices")) part.hidden = !any;
    byId("flight-lede").textContent = any ? "" : "No flight of this environment is stored in the results folder.";
    if (!any) return;
    this.seed = opened?.seed ?? seeds[0];
    this.focus = null;
    this.chosen = new Set(this.firstChoice(opened?.policy));
    this.time = 0;
    this.camera.home();
    this.follow = "";
    this.loop = null;
    await this.refresh(true);
    if (!opened && environment === this.environment) this.showMoment();
  },

  /** Look closely at the moment at which the flights differ most, and play around it. */
  showMoment() {
    const moment = this.findMoment();
    if (!moment) return;
    const [before, after] = MOMENT;
    this.follow = "reference";
    this.camera.follow(Math.max(LEAST_LOOK, 0.9 * moment.reach));
    this.show(moment.time);
    this.drawChoices();
    if (window.matchMedia("(prefers-reduced-motion: reduce)").matches) return;
    this.loop = [Math.max(0, moment.time - before), Math.min(this.length, moment.time + after)];
    this.show(this.loop[0]);
    this.start();
  },

  /** When the distances of two flights to the reference differ most, and the larger one; of one, its largest. */
  findMoment() {
    if (this.environment.task.mission !== "tracking") return null;
    const errors = this.shown.slice(0, 2).map(({ flight }) => distances(flight, 0)).filter(Boolean);
    if (!errors.length) return null;
    const [one, other] = errors;
    let [most, at] = [-1, 0];
    for (let k = 0; k < Math.min(...errors.map((values) => values.length)); k++) {
      const difference = other ? Math.abs(one[k] - other[k]) : one[k];
      if (difference > most) [most, at] = [difference, k];
    }
    return { time: at * this.shown[0].flight.dt, reach: Math.max(...errors.map((values) => values[at])) };
  },

  /** The whole scene again, and the whole time. */
  leaveMoment() {
    this.loop = null;
    this.follow = "";
    this.camera.follow(null);
    this.drawChoices();
    this.drawScenes();
  },

  seeds() {
    return [...new Set(this.environment.flights.map((flight) => flight.seed))].sort((a, b) => a - b);
  },

  flightsHere() {
    const here = this.environment.flights.filter((flight) => flight.seed === this.seed);
    const known = here.filter((flight) => this.board && flight.policy in this.board.names);
    return known.length ? known : here;
  },

  /** Those of the answer, else whoever did best and the base, unless a policy was asked for. */
  firstChoice(wanted) {
    const here = this.flightsHere().map((flight) => flight.policy);
    if (wanted && here.includes(wanted)) return [wanted];
    const { pair } = (this.board ?? this.environment).answer;
    if (pair.length && pair.every((policy) => here.includes(policy))) return pair;
    const [best, second] = [...this.flightsHere()].sort((a, b) => b.score - a.score).map((flight) => flight.policy);
    const { base } = this.environment;
    return [best, here.includes(base) && base !== best ? base : second].filter(Boolean);
  },

  colourIndex(policy) {
    if (this.board) return this.board.rows.findIndex((row) => row.policy === this.board.names[policy]);
    return this.environment.rows.findIndex((row) => row.policy === policy);
  },

  /** Load what is chosen and lay everything out anew. */
  async refresh(refit = false) {
    const turn = ++this.turn;
    const wanted = this.flightsHere().filter((flight) => this.chosen.has(flight.policy));
    const flights = await Promise.all(wanted.map(loadFlight));
    if (turn !== this.turn) return; // another choice was made meanwhile
    const alone = flights.length === 1 && flights[0].lengths.length > 1;
    this.shown = flights.map((flight) => ({
      flight,
      label: flight.policy,
      colourOf: (vehicle) => css(colourName(alone ? vehicle : this.colourIndex(flight.policy))),
    }));
    this.length = Math.max(...flights.map(duration), this.environment.task.dt);
    this.time = Math.min(this.time, this.length);
    this.drawChoices();
    this.layPanes(refit);
    this.layPlots();
    this.drawLegend();
    byId("scrub").max = this.length;
    this.draw();
  },

  layPanes(refit) {
    const groups = this.layout === "overlay" || this.shown.length < 2 ? [this.shown] : this.shown.map((entry) => [entry]);
    const flights = this.shown.map(({ flight }) => flight);
    const bounds = flights.length ? extent(flights, this.environment.task) : null;
    if (refit && bounds) this.camera.fit(bounds.low, bounds.high);
    this.scenes = groups.filter((group) => group.length).map((group) => this.pane(group, bounds));
    byId("panes").classList.toggle("many", this.scenes.length > 2);
    byId("panes").replaceChildren(...this.scenes.map(({ root }) => root));
  },

  pane(group, bounds) {
    const names = group.map(({ label, colourOf, flight }) => {
      const colour = flight.lengths.length > 1 && this.shown.length === 1 ? css("--ink") : colourOf(0);
      const name = element("span", { own: colour }, label);
      name.style.color = colour;
      return name;
    });
    const canvas = element("canvas", {
      tabindex: "0", role: "img",
      "aria-label": `Flight in space: ${group.map(({ label }) => label).join(", ")}. Shift and arrows orbit, plus and minus zoom.`,
    });
    const scene = new Scene(canvas, this.camera, this.environment);
    scene.show(group, bounds);
    scene.root = element("div", { class: "pane" }, canvas, element("div", { class: "name" }, ...names));
    attachCamera(canvas, this.camera, () => this.drawScenes());
    return scene;
  },

  layPlots() {
    const watch = {
      seek: (time) => this.seek(time),
      hover: (time, plot) => {
        this.hovered = time;
        this.hoveredPlot = plot;
        this.mark();
      },
    };
    this.plots = plotsOf(this.shown, this.environment, this.focus).map((spec) => new Plot(spec, this.length, watch));
    byId("plots").replaceChildren(...this.plots.map(({ root }) => root));
    this.plots.forEach((plot) => plot.draw());
  },

  drawChoices() {
    const seeds = this.seeds().map((seed) => [seed, `seed ${seed}`]);
    const start = element("label", {}, "Start", selectOf("Start", seeds, this.seed, (seed) => {
      this.seed = Number(seed);
      this.keepChoice();
      this.refresh();
    }));
    const chips = element("div", { class: "chips", role: "group", "aria-label": "Policies" });
    for (const flight of this.flightsHere()) chips.append(this.chip(flight));
    const layout = switchOf("Layout", [["overlay", "Overlay"], ["beside", "Side by side"]], this.layout, (value) => {
      this.layout = value;
      this.refresh();
    });
    layout.hidden = this.shown.length < 2;
    const size = Math.max(...this.flightsHere().map((flight) => flight.lengths.length));
    const vehicles = [["", "all vehicles"], ...Array.from({ length: size }, (_, i) => [i, `vehicle ${i + 1}`])];
    const focus = element("label", {}, "Plots of", selectOf("Plots of", vehicles, this.focus ?? "", (value) => {
      this.focus = value === "" ? null : Number(value);
      this.refresh();
    }));
    focus.hidden = size < 2;
    const view = selectOf("View", this.views(size), this.follow, (value) => {
      this.follow = value;
      this.loop = null;
      this.camera.follow(value === "target" ? 0.3 : value ? 1.6 : null);
      this.drawScenes();
    });
    const active = document.activeElement?.closest("#choices") && document.activeElement.dataset.name;
    byId("choices").replaceChildren(start, chips, layout, element("label", {}, "View", view), focus);
    if (active) [...chips.children].find((chip) => chip.dataset.name === active)?.focus();
  },

  views(size) {
    const vehicles = Array.from({ length: size }, (_, i) => [String(i), size > 1 ? `follow vehicle ${i + 1}` : "follow the vehicle"]);
    const target = this.shown.some(({ flight }) => flight.tables.target) ? [["target", "follow the target"]] : [];
    const reference = this.environment.task.mission === "tracking" ? [["reference", "vehicles and reference"]] : [];
    return [["", "whole scene"], ...reference, ...vehicles, ...target];
  },

  /** What the camera looks at, where it follows something. */
  anchor(scene) {
    const { flight } = scene.shown[0];
    if (this.follow === "reference") return this.closely(scene);
    const table = this.follow === "target" ? flight.tables.target?.[0] : flight.tables.p[Number(this.follow)];
    if (this.follow === "" || !table) return null;
    return samplePoint(table, Math.min(this.time / flight.dt, table[0].length - 1));
  },

  /** Middle of the vehicles and of where they should be. */
  closely(scene) {
    const places = scene.shown.flatMap(({ flight }) => {
      const row = Math.min(this.time / flight.dt, lastRow(flight, 0));
      const tables = [flight.tables.p[0], flight.tables.reference?.[0]].filter(Boolean);
      return tables.map((table) => samplePoint(table, Math.min(row, table[0].length - 1)));
    });
    return [0, 1, 2].map((axis) => places.reduce((sum, place) => sum + place[axis] / places.length, 0));
  },

  chip(flight) {
    const on = this.chosen.has(flight.policy);
    const score = flight.crashed.some(Boolean) ? "crashed" : number(flight.score, 3);
    const chip = element(
      "button",
      { type: "button", "aria-pressed": String(on), own: `var(${colourName(this.colourIndex(flight.policy))})`, "data-name": flight.policy },
      element("span", { class: "swatch" }), flight.policy, element("small", {}, score),
    );
    chip.addEventListener("click", () => {
      if (on && this.chosen.size === 1) return; // something has to be shown
      if (on) this.chosen.delete(flight.policy);
      else this.chosen.add(flight.policy);
      this.refresh();
    });
    return chip;
  },

  /** Policies whose flight from this start is not stored cannot stay chosen. */
  keepChoice() {
    const here = new Set(this.flightsHere().map((flight) => flight.policy));
    this.chosen = new Set([...this.chosen].filter((policy) => here.has(policy)));
    if (!this.chosen.size) this.chosen = new Set(this.firstChoice());
  },

  drawLegend() {
    const { task } = this.environment;
    const team = task.mission !== "tracking";
    const parts = [];
    if (task.mission !== "estimation") parts.push(team ? "dashed: wanted ways, cross: where each should be now" : "dashed: reference, cross: where the vehicle should be now");
    if (!team) parts.push("dotted: error, from the vehicle to there");
    if (task.mission !== "estimation") parts.push("filled rotor: front, strokes: thrust");
    if (team) parts.push("grey lines: who hears whom, dot nearer the hearer");
    if (this.shown.some(({ flight }) => flight.tables.target)) parts.push("diamond: target");
    if (this.shown.some(({ flight }) => flight.tables.root)) parts.push("ellipsoids: 95 % of each estimate");
    if (task.constraint_names?.length) parts.push("red: a limit is exceeded");
    byId("legend").textContent = parts.join(" · ");
  },

  draw() {
    this.drawScenes();
    this.mark();
    byId("scrub").value = this.time;
    byId("scrub").setAttribute("aria-valuetext", `${this.time.toFixed(2)} seconds`);
    byId("clock").textContent = `${this.time.toFixed(2)} / ${this.length.toFixed(2)} s`;
  },

  drawScenes() {
    for (const scene of this.scenes) {
      this.camera.anchor = this.anchor(scene);
      scene.draw(this.time);
    }
  },

  mark() {
    this.plots.forEach((plot) => plot.mark(this.time, this.hovered, plot === this.hoveredPlot));
  },

  /** Go to a time that a person chose. */
  seek(time) {
    this.loop = null;
    this.show(time);
  },

  show(time) {
    this.time = Math.max(0, Math.min(this.length, time));
    this.draw();
  },

  step(rows) {
    this.stop();
    const dt = this.shown[0]?.flight.dt ?? this.environment.task.dt;
    this.seek((Math.round(this.time / dt) + rows) * dt);
  },

  toggle() {
    if (this.playing) this.stop();
    else this.start();
  },

  start() {
    if (!this.shown.length) return;
    if (this.time >= this.length - 1e-6) this.time = 0;
    this.playing = true;
    this.showPlaying();
    let before = performance.now();
    const tick = (now) => {
      if (!this.playing) return;
      const [begin, end] = this.loop ?? [0, Infinity];
      const next = this.time + (this.speed * Math.max(0, now - before)) / 1000;
      this.show(next > end ? begin : next);
      before = now;
      if (this.time >= this.length) this.stop();
      else requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  },

  stop() {
    this.playing = false;
    this.showPlaying();
  },

  showPlaying() {
    byId("play").textContent = this.playing ? "❚❚" : "▶";
    byId("play").setAttribute("aria-label", this.playing ? "Pause" : "Play");
  },

  redraw() {
    this.plots.forEach((plot) => plot.draw());
    this.draw();
  },
};
