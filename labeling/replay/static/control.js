// What the person does: time, the choice of a track, the table, options and keys.

let asked = -1;

async function show(sweep, isForced = false) {
  sweep = Math.min(Math.max(sweep, 0), data.sweeps.length - 1);
  asked = sweep;
  if (sweep === state.sweep && !isForced) return;
  const points = await pointsOf(sweep);
  if (asked !== sweep) return; // another was asked for meanwhile
  const header = data.sweeps[sweep];
  state.sweep = sweep;
  cloud.geometry.dispose();
  cloud.geometry = new THREE.BufferGeometry();
  setAttribute(cloud.geometry, "position", points.places);
  setAttribute(cloud.geometry, "colour", colourPoints(points, header, sweep), true);
  cloud.geometry.setDrawRange(byId("static").checked ? 0 : header.num_static, Infinity);
  vehicle.matrix.copy(poseOf(sweep));
  buildBoxes();
  keepBeside(anchorOf(sweep));
  byId("time").value = sweep;
  byId("clock").textContent =
    `${header.time_s.toFixed(2)} s, sweep ${header.index}, ${(header.num_static + header.num_moving).toLocaleString("en")} points`;
  document.body.dataset.sweep = sweep;
  for (const row of byId("tracks").rows) row.classList.toggle("absent", !trackOfNumber.get(Number(row.dataset.number)).boxOf.has(sweep));
  draw();
  if (sweep + 1 < data.sweeps.length) pointsOf(sweep + 1);
}

const refresh = () => show(asked, true);

function play(isPlaying) {
  const run = isPlaying ? Symbol("run") : null;
  state.run = run;
  byId("play").textContent = isPlaying ? "Pause" : "Play";
  document.body.dataset.playing = isPlaying;
  if (!isPlaying) return;
  const last = data.sweeps.length - 1;
  state.time_s = data.sweeps[state.sweep === last ? 0 : state.sweep].time_s;
  let before_ms = null;
  requestAnimationFrame(async function step(now_ms) {
    if (state.run !== run) return;
    state.time_s += before_ms === null ? 0 : ((now_ms - before_ms) / 1000) * Number(byId("speed").value);
    before_ms = now_ms;
    const upcoming = data.sweeps.findIndex((sweep) => sweep.time_s > state.time_s);
    await show(upcoming < 0 ? last : Math.max(upcoming - 1, 0));
    if (upcoming >= 0) requestAnimationFrame(step);
    else if (state.run === run) play(false);
  });
}

function go(sweep) {
  play(false);
  return show(sweep);
}

/** Choose a track, or none: the time goes to where it has a box, the camera to it. */
async function choose(track) {
  state.track = track;
  document.body.dataset.track = track ? track.track_id : "";
  for (const row of byId("tracks").rows) {
    const isChosen = track !== null && Number(row.dataset.number) === track.number;
    row.classList.toggle("chosen", isChosen);
    row.setAttribute("aria-current", isChosen);
    if (isChosen) row.scrollIntoView({ block: "nearest" });
  }
  if (track === null) {
    byId("camera").value = "vehicle";
    followNow();
    return refresh();
  }
  byId("camera").value = "track";
  if (!track.boxOf.has(state.sweep)) await go(nearestSweepOf(track));
  followNow();
  return refresh();
}

function nearestSweepOf(track) {
  const distance = (box) => Math.abs(box[SWEEP] - state.sweep);
  return track.boxes.reduce((nearest, box) => (distance(box) < distance(nearest) ? box : nearest))[SWEEP];
}

function followNow() {
  const anchor = anchorOf(state.sweep);
  state.anchor = anchor;
  if (!anchor) return;
  const reach = camera.position.clone().sub(controls.target);
  moveCamera(anchor.clone().sub(controls.target));
  const wanted_m = byId("camera").value === "track" ? 16 : 34;
  if (reach.length() > wanted_m) camera.position.copy(controls.target).addScaledVector(reach.normalize(), wanted_m);
  controls.update();
  draw();
}

function chooseBeside(step) {
  const shown = data.tracks.filter(isShown);
  if (!shown.length) return;
  const at = shown.indexOf(state.track);
  choose(shown[at < 0 ? (step > 0 ? 0 : shown.length - 1) : (at + step + shown.length) % shown.length]);
}

function cell(row, text, isDoubtful = false) {
  const it = row.insertCell();
  it.textContent = text;
  it.className = isDoubtful ? "doubtful" : "";
  return it;
}

function buildTable() {
  byId("tracks").replaceChildren();
  for (const track of data.tracks.filter(isShown)) {
    const row = byId("tracks").insertRow();
    row.dataset.number = track.number;
    row.title = track.track_id;
    const mark = document.createElement("i");
    mark.style.background = `rgb(${colourOfTrack(track).map((value) => Math.round(255 * value))})`;
    cell(row, `#${track.number}`).prepend(mark);
    cell(row, track.mean_score.toFixed(2), track.mean_score < data.min_score);
    cell(row, track.jump_m.toFixed(2), track.jump_m > 1);
    cell(row, `${Math.round(100 * track.size_change)}%`, track.size_change > 0.2);
    cell(row, track.top_speed_mps.toFixed(1));
    cell(row, track.num_boxes);
    row.addEventListener("click", () => choose(track));
    row.classList.toggle("chosen", track === state.track);
  }
}

function tellLegend() {
  const by = byId("colour").value;
  const [low, high] = {
    flow: ["hue: direction; bright:", `${topSpeed.toFixed(0)} m/s`],
    height: data.height_m.map((limit) => `${limit.toFixed(1)} m`),
    track: ["a colour a track", ""],
    score: ["score 0", "1"],
  }[by];
  byId("legend-low").textContent = low;
  byId("legend-high").textContent = high;
  byId("legend-bar").className = by;
}

function tellSegment() {
  const sum = (name) => data.sweeps.reduce((total, sweep) => total + sweep[name], 0);
  const [kept, recorded, far] = [sum("num_static") + sum("num_moving"), sum("num_recorded"), sum("num_far")];
  const voxel_m = Math.max(...data.sweeps.map((sweep) => sweep.voxel_m));
  document.title = `${data.segment} - replay`;
  byId("segment").textContent = data.segment;
  byId("told").textContent = [
    `${data.dataset}; sweeps: ${data.sweeps.length}, tracks: ${data.tracks.length}.`,
    `${kept.toLocaleString("en")} of ${recorded.toLocaleString("en")} points` +
      (voxel_m ? `: of those that stand still, one a voxel of up to ${voxel_m.toFixed(2)} m.` : "."),
    far ? `${far} points were too far to be shown.` : "",
    data.rejected.length ? `Rejected sweeps: ${data.rejected.join(", ")}.` : "",
  ].filter(Boolean).join(" ");
}

function cutTracks() {
  byId("cut-told").textContent = Number(byId("cut").value).toFixed(2);
  buildTable();
}

function cycle(select) {
  select.selectedIndex = (select.selectedIndex + 1) % select.options.length;
  select.dispatchEvent(new Event("change"));
}

const KEYS = {
  " ": () => play(state.run === null),
  ArrowLeft: () => go(asked - 1),
  ArrowRight: () => go(asked + 1),
  Home: () => go(0),
  End: () => go(data.sweeps.length - 1),
  n: () => chooseBeside(1),
  p: () => chooseBeside(-1),
  f: () => cycle(byId("camera")),
  c: () => cycle(byId("colour")),
  s: () => byId("static").click(),
  b: () => byId("boxes").click(),
  t: () => byId("truth").click(),
  Escape: () => choose(null),
};

/** Whether a key means something to the element that has the focus. */
function isForItself({ key, target }) {
  if (target.tagName === "SELECT") return key !== "Escape";
  if (target.tagName === "BUTTON" || target.type === "checkbox") return key === " ";
  return target.id === "cut" && /^(Arrow|Home|End)/.test(key);
}

document.addEventListener("keydown", (event) => {
  if (event.ctrlKey || event.metaKey || event.altKey || isForItself(event)) return;
  const act = KEYS[event.key];
  if (!act) return;
  event.preventDefault();
  act();
});

// An option that was set with the mouse gives the keys back to the page.
let isByPointer = false;
document.addEventListener("pointerdown", () => { isByPointer = true; }, true);
document.addEventListener("keydown", () => { isByPointer = false; }, true);
document.addEventListener("change", (event) => { if (isByPointer) event.target.blur(); });

byId("play").addEventListener("click", () => play(state.run === null));
byId("time").addEventListener("input", () => go(Number(byId("time").value)));
byId("camera").addEventListener("change", followNow);
byId("colour").addEventListener("change", () => { tellLegend(); refresh(); });
byId("cut").addEventListener("input", () => { cutTracks(); refresh(); });
for (const id of ["static", "boxes", "truth"]) byId(id).addEventListener("change", refresh);
new ResizeObserver(resize).observe(byId("view"));

byId("time").max = data.sweeps.length - 1;
byId("cut").value = data.min_score;
byId("truth-option").hidden = !data.sweeps.some((sweep) => sweep.truth.length);
tellSegment();
tellLegend();
cutTracks();
resize();
lookAtStart();
show(0).then(
  () => { document.body.dataset.ready = "true"; },
  () => tellTrouble("The points cannot be unpacked: is this file whole, and the browser of 2023 or later?"),
);
