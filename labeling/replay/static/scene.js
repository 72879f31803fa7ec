// The 3D view: the points of a sweep in the frame of the vehicle, boxes in that of the world, and the camera.

const TAIL_S = 2;
const NAMES_WITHIN_M = 90;
const MARK = [1, 0.72, 0.3];

const EDGES = [[0, 1], [1, 3], [3, 2], [2, 0], [4, 5], [5, 7], [7, 6], [6, 4], [0, 4], [1, 5], [2, 6], [3, 7]];
const FACES = [[0, 1, 3, 2], [4, 5, 7, 6], [0, 1, 5, 4], [2, 3, 7, 6], [0, 2, 6, 4], [1, 3, 7, 5]];

const canvas = byId("canvas");
const renderer = makeRenderer();
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

/** Whether a processor draws, as on a machine without a graphics card: smooth edges halve its frames a second. */
function isDrawnInSoftware() {
  const context = document.createElement("canvas").getContext("webgl2");
  const names = context?.getExtension("WEBGL_debug_renderer_info");
  const name = context?.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : context.RENDERER) ?? "";
  context?.getExtension("WEBGL_lose_context")?.loseContext();
  return /SwiftShader|llvmpipe|softpipe|Software|Basic Render/i.test(name);
}

function makeRenderer() {
  try {
    return new THREE.WebGLRenderer({ canvas, antialias: !isDrawnInSoftware() });
  } catch (error) {
    tellTrouble("This browser gives no WebGL, which the 3D view needs.");
    throw error;
  }
}

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
  const paint = new THREE.MeshBasicMaterial({ color: new THREE.Color(0.17, 0.21, 0.27), side: THREE.DoubleSide });
  Object.assign(paint, { polygonOffset: true, polygonOffsetFactor: 2, polygonOffsetUnits: 2 }); // behind its edges
  const group = new THREE.Group();
  group.add(
    new THREE.Mesh(sides, paint),
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

/** Where what the camera goes with is; nothing when the camera stands, or the track has no box. */
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

/** Move the camera as what it goes with has moved since it was last seen. */
function keepBeside(anchor) {
  if (!anchor) return;
  if (state.anchor) moveCamera(anchor.clone().sub(state.anchor));
  state.anchor = anchor;
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
