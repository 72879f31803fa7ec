// What the page holds: sweeps, tracks, and the points of each sweep, unpacked when they are first shown.

const byId = (id) => document.getElementById(id);
const data = JSON.parse(byId("data").textContent);
const blocks = [...document.querySelectorAll("script.sweep")];
const [SWEEP, X, Y, Z, LENGTH, WIDTH, HEIGHT, YAW, VX, VY, SCORE, , SEEN] = Array(13).keys();
const state = { sweep: -1, track: null, run: null, time_s: 0, anchor: null };

const trackOfNumber = new Map(data.tracks.map((track) => [track.number, track]));
for (const track of data.tracks) {
  track.boxOf = new Map(track.boxes.map((box) => [box[SWEEP], box]));
}
const topSpeed = Math.max(5, ...data.tracks.filter((t) => t.mean_score >= data.min_score).map((t) => t.top_speed_mps));
const decoded = new Map();

/** Say what keeps the page from working. */
function tellTrouble(text) {
  byId("trouble").hidden = false;
  byId("trouble").textContent = text;
}

function pointsOf(sweep) {
  if (!decoded.has(sweep)) decoded.set(sweep, decode(blocks[sweep], data.sweeps[sweep]));
  return decoded.get(sweep);
}

/** Undo what labeling/replay/points.py does: deflate, byte planes, differences. */
async function decode(block, header) {
  const packed = Uint8Array.from(atob(block.textContent), (letter) => letter.charCodeAt(0));
  block.textContent = "";
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const bytes = new Uint8Array(await new Response(stream).arrayBuffer());
  const numPoints = header.num_static + header.num_moving;
  let offset = 0;
  function column(rows) {
    const values = new Int16Array(rows);
    for (let row = 0, value = 0; row < rows; row++) {
      value += bytes[offset + row] | (bytes[offset + rows + row] << 8);
      values[row] = value;
    }
    offset += 2 * rows;
    return values;
  }
  const axes = [column(numPoints), column(numPoints), column(numPoints)];
  const places = new Float32Array(3 * numPoints);
  axes.forEach((values, axis) => values.forEach((value, row) => { places[3 * row + axis] = value * data.grid_m; }));
  const [vx, vy, track] = [column(header.num_moving), column(header.num_moving), column(header.num_moving)];
  return { places, vx, vy, track };
}
