"use strict";
(async () => {
  const byId = (id) => document.getElementById(id);
  const data = JSON.parse(byId("data").textContent);
  const blocks = [...document.querySelectorAll("script.sweep")];
  const [SWEEP, X, Y, Z, LENGTH, WIDTH, HEIGHT, YAW, VX, VY, SCORE, , SEEN] = Array(13).keys();
  const TAIL_S = 2;
  const NAMES_WITHIN_M = 90;
  const MARK = [1, 0.72, 0.3];
  const state = { sweep: -1, track: null, isPlaying: false, time_s: 0 };

  // ------------------------------------------------------------------------------------------------------- the data

  const trackOfNumber = new Map(data.tracks.map((track) => [track.number, track]));
  for (const track of data.tracks) {
    track.boxOf = new Map(track.boxes.map((box) => [box[SWEEP], box]));
  }
  const topSpeed = Math.max(5, ...data.tracks.filter((t) => t.mean_score >= data.min_score).map((t) => t.top_speed_mps));
  const decoded = new Map();

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

  // ----------------------------------------------------------------------------------------------------- the colours

  const clamp = (value) => Math.min(1, Math.max(0, value));

  function hsv(hue, saturation, value) {
    const channel = (shift) => {
      const k = (shift + hue * 6) % 6;
      return value - value * saturation * Math.max(0, Math.min(k, 4 - k, 1));
    };
    return [channel(5), channel(3), channel(1)];
  }

  /** The hue is the direction, brightness and saturation the speed; as in the pictures of `render`. */
  function colourOfVelocity(vx, vy) {
    const share = clamp(Math.hypot(vx, vy) / topSpeed) ** 0.6;
    return hsv((Math.atan2(vy, vx) / (2 * Math.PI) + 1) % 1, 0.15 + 0.75 * share, 0.6 + 0.4 * share);
  }

  const RAMP = [[0.19, 0.25, 0.5], [0.17, 0.53, 0.66], [0.29, 0.75, 0.54], [0.79, 0.85, 0.33], [0.96, 0.63, 0.29]];

  function colourOfHeight(share) {
    const at = clamp(share) * (RAMP.length - 1);
    const low = Math.min(Math.floor(at), RAMP.length - 2);
    return RAMP[low].map((value, channel) => value + (at - low) * (RAMP[low + 1][channel] - value));
  }

  const colourOfTrack = (track) => hsv((track.number * 0.381966) % 1, 0.6, 0.95);
  const colourOfScore = (score) => hsv(clamp(score) / 3, 0.75, 0.95);

  function colourOfBox(track, box) {
    switch (byId("colour").value) {
      case "track": return colourOfTrack(track);
      case "score": return colourOfScore(box[SCORE]);
      default: return colourOfVelocity(box[VX], box[VY]);
    }
  }

  function colourPoints(points, header, sweep) {
    const by = byId("colour").value;
    const [low, high] = data.height_m;
    const numPoints = points.places.length / 3;
    const colours = new Uint8Array(3 * numPoints);
    const UNKNOWN = [0.85, 0.85, 0.85];
    for (let row = 0; row < numPoints; row++) {
      const height = clamp((points.places[3 * row + 2] - low) / (high - low));
      const moving = row - header.num_static;
      let colour;
      if (by === "height") {
        colour = colourOfHeight(height);
      } else if (moving < 0) {
        colour = [0.3 + 0.3 * height, 0.35 + 0.3 * height, 0.43 + 0.27 * height];
      } else if (by === "flow") {
        const isKnown = points.vx[moving] !== data.no_flow;
        colour = isKnown ? colourOfVelocity(points.vx[moving] * data.grid_mps, points.vy[moving] * data.grid_mps) : UNKNOWN;
      } else {
        const track = trackOfNumber.get(points.track[moving]);
        const box = track && track.boxOf.get(sweep);
        colour = !track ? UNKNOWN : by === "track" ? colourOfTrack(track) : box ? colourOfScore(box[SCORE]) : UNKNOWN;
      }
      for (let channel = 0; channel < 3; channel++) colours[3 * row + channel] = 255 * colour[channel];
    }
    return colours;
  }

  // ------------------------------------------------------------------------------------------------------- the scene

  const EDGES = [[0, 1], [1, 3], [3, 2], [2, 0], [4, 5], [5, 7], [7, 6], [6, 4], [0, 4], [1, 5], [2, 6], [3, 7]];
  const FACES = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]];

  const canvas = byId("canvas");
  let renderer;
  try {
    renderer = new THREE.WebGLRenderer({ canvas, antialias: true });
  } catch {
    byId("trouble").hidden = false;
    byId("trouble").textContent = "This browser gives no WebGL, which the 3D view needs.";
    return;
  }
  renderer.outputColorSpace = "srgb-linear"; // colours above are those of the screen
  renderer.setClearColor(new THREE.Color(0.043, 0.055, 0.078));
  const scene = new THREE.Scene();
  const camera = new THREE.PerspectiveCamera(50, 1, 0.3, 2000);
  camera.up.set(0, 0, 1);
  const controls = new THREE.OrbitControls(camera, canvas);
  controls.maxPolarAngle = Math.PI * 0.495;
  controls.addEventListener("change", draw);

  const cloudMaterial = new THREE.ShaderMaterial({
    uniforms: { pixels: { value: 1 } },
    vertexShader: `
      attribute vec3 colour;
      varying vec3 shade;
      uniform float pixels;
      void main() {
        vec4 seen = modelViewMatrix * vec4(position, 1.0);
        gl_Position = projectionMatrix * seen;
        gl_PointSize = clamp(0.07 * pixels / -seen.z, 1.3, 5.0);
        shade = colour;
      }`,
    fragmentShader: "varying vec3 shade; void main() { gl_FragColor = vec4(shade, 1.0); }",
  });
  const cloud = new THREE.Points(new THREE.BufferGeometry(), cloudMaterial);
  const vehicle = new THREE.Group();
  const edges = new THREE.LineSegments(new THREE.BufferGeometry(), new THREE.LineBasicMaterial({ vertexColors: true }));
  const faces = new THREE.Mesh(
    new THREE.BufferGeometry(),
    new THREE.MeshBasicMaterial({ vertexColors: true, transparent: true, opacity: 0.16, depthWrite: false, side: THREE.DoubleSide }),
  );
  vehicle.matrixAutoUpdate = false;
  vehicle.add(cloud, outlineOfVehicle());
  for (const part of [cloud, edges, faces]) part.frustumCulled = false;
  scene.add(vehicle, faces, edges);

  function setAttribute(geometry, name, values, isNormalized = false) {
    geometry.setAttribute(name, new THREE.BufferAttribute(values, 3, isNormalized));
  }

  /** Rings every 10 m, and where the vehicle is. */
  function outlineOfVehicle() {
    const places = [];
    const ground = data.height_m[0];
    for (let radius = 10; radius <= 80; radius += 10) {
      for (let step = 0; step < 96; step++) {
        for (const at of [step, step + 1]) {
          const angle = (at * Math.PI) / 48;
          places.push(radius * Math.cos(angle), radius * Math.sin(angle), ground);
        }
      }
    }
    const rings = new THREE.BufferGeometry();
    setAttribute(rings, "position", new Float32Array(places));
    const body = { places: [], colours: [], faces: [], shades: [] };
    addBox(body, [0, 0, 0, ground + 0.8, 4.6, 1.9, 1.6, 0], [0.85, 0.87, 0.92], true);
    const [lines, sides] = [new THREE.BufferGeometry(), new THREE.BufferGeometry()];
    setAttribute(lines, "position", new Float32Array(body.places));
    setAttribute(sides, "position", new Float32Array(body.faces));
    const group = new THREE.Group();
    group.add(
      new THREE.Mesh(sides, new THREE.MeshBasicMaterial({ color: new THREE.Color(0.17, 0.21, 0.27), side: THREE.DoubleSide })),
      new THREE.LineSegments(rings, new THREE.LineBasicMaterial({ color: new THREE.Color(0.14, 0.18, 0.24) })),
      new THREE.LineSegments(lines, new THREE.LineBasicMaterial({ color: new THREE.Color(0.85, 0.87, 0.92) })),
    );
    return group;
  }

  /** Add a box's edges, a line ahead from its middle, and its faces if asked. */
  function addBox(into, box, colour, isFilled) {
    const [cos, sin] = [Math.cos(box[YAW]), Math.sin(box[YAW])];
    const place = (ahead, left, up) => [
      box[X] + (ahead * box[LENGTH] * cos - left * box[WIDTH] * sin) / 2,
      box[Y] + (ahead * box[LENGTH] * sin + left * box[WIDTH] * cos) / 2,
      box[Z] + (up * box[HEIGHT]) / 2,
    ];
    const corners = Array.from({ length: 8 }, (_, i) => place(i & 1 ? 1 : -1, i & 2 ? 1 : -1, i & 4 ? 1 : -1));
    const line = (from, to) => {
      into.places.push(...from, ...to);
      into.colours.push(...colour, ...colour);
    };
    for (const [from, to] of EDGES) line(corners[from], corners[to]);
    line(place(0, 0, -1), place(1 + 1.2 / box[LENGTH], 0, -1));
    if (isFilled) {
      for (const [a, b, c, d] of FACES) {
        for (const corner of [a, b, c, a, c, d]) {
          into.faces.push(...corners[corner]);
          into.shades.push(...colour);
        }
      }
    }
  }

  function addTail(into, track, sweep, colour) {
    const start_s = data.sweeps[sweep].time_s - TAIL_S;
    const past = track.boxes.filter((box) => box[SWEEP] <= sweep && data.sweeps[box[SWEEP]].time_s >= start_s);
    for (let i = 1; i < past.length; i++) {
      for (const box of [past[i - 1], past[i]]) {
        into.places.push(box[X], box[Y], box[Z] - box[HEIGHT] / 2 + 0.1);
        into.colours.push(...colour.map((value) => (value * i) / past.length));
      }
    }
  }

  const isShown = (track) => track === state.track || track.mean_score >= Number(byId("cut").value);

  function shownBoxes(sweep) {
    return data.tracks.filter((track) => isShown(track) && track.boxOf.has(sweep)).map((track) => [track, track.boxOf.get(sweep)]);
  }

  function buildBoxes() {
    const into = { places: [], colours: [], faces: [], shades: [] };
    if (byId("boxes").checked) {
      for (const [track, box] of shownBoxes(state.sweep)) {
        const colour = track === state.track ? MARK : colourOfBox(track, box);
        const strength = box[SEEN] ? 1 : 0.55;
        addBox(into, box, colour.map((value) => value * strength), box[SEEN] || track === state.track);
        addTail(into, track, state.sweep, colour);
      }
    }
    if (byId("truth").checked) {
      for (const truth of data.sweeps[state.sweep].truth) addBox(into, [0, ...truth.box], [0.55, 0.57, 0.6], false);
    }
    edges.geometry.dispose();
    faces.geometry.dispose();
    edges.geometry = new THREE.BufferGeometry();
    faces.geometry = new THREE.BufferGeometry();
    setAttribute(edges.geometry, "position", new Float32Array(into.places));
    setAttribute(edges.geometry, "color", new Float32Array(into.colours));
    setAttribute(faces.geometry, "position", new Float32Array(into.faces));
    setAttribute(faces.geometry, "color", new Float32Array(into.shades));
  }

  // ---------------------------------------------------------------------------------------------- drawing and camera

  let isAsked = false;

  function draw() {
    if (isAsked) return;
    isAsked = true;
    requestAnimationFrame(() => {
      isAsked = false;
      renderer.render(scene, camera);
      placeNames();
      document.body.dataset.drawn = state.sweep;
    });
  }

  function placeNames() {
    const { clientWidth, clientHeight } = canvas;
    const names = byId("boxes").checked && state.sweep >= 0 ? shownBoxes(state.sweep) : [];
    const shown = [];
    for (const [track, box] of names) {
      const place = new THREE.Vector3(box[X], box[Y], box[Z] + box[HEIGHT] / 2 + 0.4);
      const isNear = place.distanceTo(controls.target) < NAMES_WITHIN_M || track === state.track;
      place.project(camera);
      if (!isNear || place.z > 1 || Math.abs(place.x) > 1 || Math.abs(place.y) > 1) continue;
      const name = document.createElement("span");
      name.textContent = `#${track.number}  ${Math.hypot(box[VX], box[VY]).toFixed(1)} m/s`;
      name.className = track === state.track ? "chosen" : "";
      const [left, top] = [((place.x + 1) / 2) * clientWidth, ((1 - place.y) / 2) * clientHeight];
      name.style.transform = `translate(${left}px, ${top}px) translate(-50%, -100%)`;
      shown.push(name);
    }
    byId("names").replaceChildren(...shown);
  }

  function poseOf(sweep) {
    return new THREE.Matrix4().set(...data.sweeps[sweep].world_from_ego);
  }

  /** Where what the camera goes with is: the track while it has a box, else the vehicle; nothing where it stands. */
  function anchorOf(sweep) {
    const mode = byId("camera").value;
    const box = mode === "track" && state.track && state.track.boxOf.get(sweep);
    if (box) return new THREE.Vector3(box[X], box[Y], box[Z]);
    return mode === "vehicle" ? new THREE.Vector3().setFromMatrixPosition(poseOf(sweep)) : null;
  }

  function moveCamera(shift) {
    camera.position.add(shift);
    controls.target.add(shift);
    controls.update();
  }

  function lookAtStart() {
    const pose = poseOf(0);
    camera.position.set(-26, 10, 20).applyMatrix4(pose);
    controls.target.set(9, 0, 0).applyMatrix4(pose);
    controls.update();
  }

  function resize() {
    const { clientWidth, clientHeight } = byId("view");
    renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    renderer.setSize(clientWidth, clientHeight, false);
    camera.aspect = clientWidth / Math.max(clientHeight, 1);
    camera.updateProjectionMatrix();
    cloudMaterial.uniforms.pixels.value = (clientHeight * renderer.getPixelRatio()) / (2 * Math.tan((camera.fov * Math.PI) / 360));
    draw();
  }

  // ------------------------------------------------------------------------------------------------- time and choice

  let asked = -1;

  async function show(sweep, isForced = false) {
    sweep = Math.min(Math.max(sweep, 0), data.sweeps.length - 1);
    asked = sweep;
    if (sweep === state.sweep && !isForced) return;
    const points = await pointsOf(sweep);
    if (asked !== sweep) return; // another was asked for meanwhile
    const [before, after] = [state.sweep < 0 ? null : anchorOf(state.sweep), anchorOf(sweep)];
    const header = data.sweeps[sweep];
    state.sweep = sweep;
    cloud.geometry.dispose();
    cloud.geometry = new THREE.BufferGeometry();
    setAttribute(cloud.geometry, "position", points.places);
    setAttribute(cloud.geometry, "colour", colourPoints(points, header, sweep), true);
    cloud.geometry.setDrawRange(byId("static").checked ? 0 : header.num_static, Infinity);
    vehicle.matrix.copy(poseOf(sweep));
    buildBoxes();
    if (before && after) moveCamera(after.sub(before));
    byId("time").value = sweep;
    byId("clock").textContent =
      `${header.time_s.toFixed(2)} s   sweep ${header.index}   ${(header.num_static + header.num_moving).toLocaleString("en")} points`;
    document.body.dataset.sweep = sweep;
    for (const row of byId("tracks").rows) row.classList.toggle("absent", !trackOfNumber.get(Number(row.dataset.number)).boxOf.has(sweep));
    draw();
    if (sweep + 1 < data.sweeps.length) pointsOf(sweep + 1);
  }

  const refresh = () => show(state.sweep, true);

  function play(isPlaying) {
    state.isPlaying = isPlaying;
    byId("play").textContent = isPlaying ? "Pause" : "Play";
    document.body.dataset.playing = isPlaying;
    if (!isPlaying) return;
    const last = data.sweeps.length - 1;
    state.time_s = data.sweeps[state.sweep === last ? 0 : state.sweep].time_s;
    let before_ms = null;
    requestAnimationFrame(async function step(now_ms) {
      if (!state.isPlaying) return;
      state.time_s += before_ms === null ? 0 : ((now_ms - before_ms) / 1000) * Number(byId("speed").value);
      before_ms = now_ms;
      const upcoming = data.sweeps.findIndex((sweep) => sweep.time_s > state.time_s);
      await show(upcoming < 0 ? last : Math.max(upcoming - 1, 0));
      if (upcoming < 0) play(false);
      else requestAnimationFrame(step);
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
      row.setAttribute("aria-selected", isChosen);
      if (isChosen) row.scrollIntoView({ block: "nearest" });
    }
    if (track === null) {
      byId("camera").value = "vehicle";
      const here = new THREE.Vector3().setFromMatrixPosition(poseOf(state.sweep));
      moveCamera(here.sub(controls.target));
      return refresh();
    }
    byId("camera").value = "track";
    if (!track.boxOf.has(state.sweep)) await go(track.boxes.find((box) => box[SEEN])?.[SWEEP] ?? track.boxes[0][SWEEP]);
    followNow();
    return refresh();
  }

  function followNow() {
    const anchor = anchorOf(state.sweep);
    if (!anchor) return;
    const shift = anchor.sub(controls.target);
    const reach = camera.position.clone().sub(controls.target);
    moveCamera(shift);
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

  // -------------------------------------------------------------------------------------------- the table and the rest

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
      flow: ["direction; bright:", `${topSpeed.toFixed(0)} m/s`],
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
      `${data.dataset}: ${data.sweeps.length} sweeps, ${data.tracks.length} tracks.`,
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
    " ": () => play(!state.isPlaying),
    ArrowLeft: () => go(state.sweep - 1),
    ArrowRight: () => go(state.sweep + 1),
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

  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey || event.target.tagName === "SELECT") return;
    if (event.target.id === "cut" && event.key.startsWith("Arrow")) return;
    const act = KEYS[event.key];
    if (!act) return;
    event.preventDefault();
    act();
  });
  byId("play").addEventListener("keyup", (event) => event.key === " " && event.preventDefault());
  byId("play").addEventListener("click", () => play(!state.isPlaying));
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
  await show(0);
  document.body.dataset.ready = "true";
})();
