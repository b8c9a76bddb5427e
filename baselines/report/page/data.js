// The report as it stands in the page, and the flights' series out of their quantised form.

const report = JSON.parse(document.getElementById("data").textContent);
const MOST = 32767;
const loaded = new Map();

async function inflate(text) {
  const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** A channel as one Float32Array per vehicle and component: table[vehicle][component][row]. */
async function decodeChannel(channel) {
  const bytes = await inflate(report.blobs[channel.blob]);
  const view = new DataView(bytes.buffer, bytes.byteOffset);
  const scale = (channel.high - channel.low) / (2 * MOST);
  let place = 0;
  const series = () => {
    const out = new Float32Array(channel.rows);
    let whole = 0;
    for (let row = 0; row < channel.rows; row++, place += 2) {
      whole = (whole + view.getUint16(place, true)) & 0xffff;
      const signed = whole > MOST ? whole - 0x10000 : whole;
      const value = signed === -MOST - 1 ? NaN : channel.low + (signed + MOST) * scale;
      out[row] = channel.log ? 10 ** value : value;
    }
    return out;
  };
  return Array.from({ length: channel.vehicles }, () => Array.from({ length: channel.components }, series));
}

/** A flight with its tables by name; decoded once. */
function loadFlight(flight) {
  if (!loaded.has(flight)) {
    const work = flight.channels.map(async (channel) => [channel.name, await decodeChannel(channel)]);
    loaded.set(flight, Promise.all(work).then((pairs) => ({ ...flight, tables: Object.fromEntries(pairs) })));
  }
  return loaded.get(flight);
}

/** Number at a time between two rows; what is per step keeps the value of its step. */
function sample(series, row) {
  const low = Math.max(0, Math.min(series.length - 1, Math.floor(row)));
  const high = Math.min(series.length - 1, low + 1);
  return series[low] + (series[high] - series[low]) * Math.max(0, Math.min(1, row - low));
}

function samplePoint(table, row) {
  return [sample(table[0], row), sample(table[1], row), sample(table[2], row)];
}

/** Distance of a vehicle to its reference in each row; null where it has none. */
function distances(flight, vehicle) {
  const [p, wanted] = [flight.tables.p[vehicle], flight.tables.reference?.[vehicle]];
  if (!wanted) return null;
  return p[0].map((_, k) => Math.hypot(p[0][k] - wanted[0][k], p[1][k] - wanted[1][k], p[2][k] - wanted[2][k]));
}

/** The last row that a vehicle reached: it stays there after a crash. */
function lastRow(flight, vehicle) {
  return flight.lengths[vehicle];
}

function duration(flight) {
  return Math.max(...flight.lengths) * flight.dt;
}
