// Which plots a choice of flights has, as data: groups of lines in one colour, limits, bands. Nothing here draws.

const DEGREES = 180 / Math.PI;
const NEES_BAND = [0.2158, 9.3484]; // 95 % of chi-square with 3 degrees of freedom
const SOLID = [];
const DASHES = [SOLID, [6, 3], [2, 3], [8, 3, 2, 3]];

/** shown: [{ flight, label, colourOf(vehicle) }]; focus: number of a vehicle, or null for all. */
function plotsOf(shown, environment, focus) {
  const { task } = environment;
  const context = { shown, task, focus };
  const plots = [
    distancePlot(context),
    slotPlot(context),
    separationPlot(context),
    estimatePlot(context),
    neesPlot(context),
    forcePlot(context),
    attitudePlot(context),
    ...(task.constraint_names ?? []).map((name, i) => constraintPlot(context, name, i)),
    decisionPlot(context),
  ];
  return plots.filter((plot) => plot && plot.groups.some((group) => group.series.length));
}

/** One group per flight; of a team one per vehicle where a single flight is shown. */
function groupsOf({ shown, focus }, name, linesOf) {
  const out = [];
  for (const { flight, label, colourOf } of shown) {
    const tables = flight.tables[name];
    if (!tables) continue;
    const vehicles = tables.map((_, i) => i).filter((i) => focus === null || i === focus || tables.length === 1);
    const alone = shown.length === 1 && vehicles.length > 1;
    const apart = alone && vehicles.length <= VEHICLE_COLOURS; // more would be more than one can tell apart
    const parts = apart ? vehicles.map((vehicle) => [vehicle]) : [vehicles];
    for (const part of parts) {
      const series = part.flatMap((vehicle) =>
        linesOf(tables[vehicle], flight, vehicle).map((line) => ({
          ...line,
          dt: flight.dt,
          end: flight.lengths[vehicle],
          name: [part.length > 1 || alone ? `vehicle ${vehicle + 1}` : "", line.name ?? ""].filter(Boolean).join(" "),
        })),
      );
      out.push({ label: apart ? `${part[0] + 1}` : label, colour: colourOf(part[0]), series });
    }
  }
  return out;
}

const plain = (table) => [{ values: table[0], dash: SOLID }];
const isTeam = ({ task }) => task.mission !== "tracking";

function distancePlot(context) {
  if (isTeam(context)) return null;
  const groups = groupsOf(context, "p", (_, flight, vehicle) => {
    const values = distances(flight, vehicle);
    return values ? [{ values, dash: SOLID }] : [];
  });
  return { title: "Position error", unit: "m", places: 3, groups, zero: true, limits: [] };
}

function slotPlot(context) {
  if (context.task.mission === "estimation") return null; // there it is the error of the estimate
  return { title: "Formation error", unit: "m, to the own slot", places: 3, groups: groupsOf(context, "slot_error", plain), zero: true, limits: [] };
}

function separationPlot(context) {
  const { task } = context;
  if (task.mission === "estimation") return null;
  const limits = [
    { value: task.separation, text: "d_s" },
    { value: task.crash_distance, text: "crash" },
  ].filter(({ value }) => value);
  return { title: "Nearest vehicle", unit: "m", places: 3, groups: groupsOf(context, "separation", plain), zero: true, limits };
}

function estimatePlot(context) {
  const groups = groupsOf(context, "estimate", (table, flight) => {
    const target = flight.tables.target[0];
    const values = table[0].map((_, k) => Math.hypot(...[0, 1, 2].map((axis) => table[axis][k] - target[axis][k])));
    return [{ values, dash: SOLID }];
  });
  return { title: "Error of the estimated position", unit: "m", places: 3, groups, zero: true, limits: [] };
}

function neesPlot(context) {
  const groups = groupsOf(context, "nees", plain);
  const [low, high] = NEES_BAND;
  return { title: "NEES", unit: "χ²(3), band: 95 %", places: 2, groups, log: true, band: [low, high], limits: [] };
}

function forcePlot(context) {
  const groups = groupsOf(context, "forces", (table) => {
    if (isTeam(context) && context.focus === null) return [
      { values: table[0].map((_, k) => Math.max(...table.map((rotor) => rotor[k]))), dash: SOLID, name: "largest" },
      { values: table[0].map((_, k) => Math.min(...table.map((rotor) => rotor[k]))), dash: DASHES[2], name: "smallest" },
    ];
    return table.map((values, rotor) => ({ values, dash: DASHES[rotor], name: `rotor ${rotor + 1}` }));
  });
  const limits = [...new Set(context.task.force_max)].map((value) => ({ value, text: "max" }));
  limits.push({ value: 0, text: "" });
  const unit = isTeam(context) && context.focus === null ? "N, largest and smallest of a vehicle" : "N, four rotors";
  return { title: "Rotor forces", unit, places: 2, groups, limits, zero: true, fine: true };
}

function attitudePlot(context) {
  const tilt = context.task.limits.tilt;
  const limits = tilt === null ? [] : [{ value: tilt * DEGREES, text: "limit" }, { value: -tilt * DEGREES, text: "" }];
  const all = isTeam(context) && context.focus === null;
  const groups = groupsOf(context, "attitude", (table) => {
    if (all) return [{ values: table[0].map((roll, k) => DEGREES * Math.max(Math.abs(roll), Math.abs(table[1][k]))), dash: SOLID }];
    return ["roll", "pitch", "yaw"].map((name, i) => ({ values: table[i].map((angle) => DEGREES * angle), dash: DASHES[i], name }));
  });
  if (all) return { title: "Tilt", unit: "°, larger of |roll| and |pitch|", places: 1, groups, limits: limits.slice(0, 1), zero: true };
  return { title: "Attitude", unit: "°, roll, pitch (dashed), yaw (dotted)", places: 1, groups, limits, fine: true };
}

function constraintPlot(context, name, index) {
  const groups = groupsOf(context, "constraints", (table) => [{ values: table[index], dash: SOLID }]);
  const unit = `${context.task.constraint_units?.[index] ?? "SI"}, value minus limit; above 0 is violated`;
  return { title: `Limit: ${name.replaceAll("_", " ")}`, unit, places: 3, groups, limits: [{ value: 0, text: "limit" }], above: 0 };
}

function decisionPlot(context) {
  return { title: "Decision time", unit: "ms per vehicle", places: 3, groups: groupsOf(context, "decision", plain), log: true, limits: [] };
}
