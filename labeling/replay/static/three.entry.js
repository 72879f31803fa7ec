// What three.min.js holds: these names of three 0.187.0 (npm pack three), bundled with its LICENSE beside it by
// npx esbuild@0.25.0 three.entry.js --bundle --minify --format=iife --global-name=THREE --legal-comments=none
export {
  BufferAttribute,
  BufferGeometry,
  Color,
  DoubleSide,
  Group,
  LineBasicMaterial,
  LineSegments,
  Matrix4,
  Mesh,
  MeshBasicMaterial,
  PerspectiveCamera,
  Points,
  Raycaster,
  Scene,
  ShaderMaterial,
  Vector2,
  Vector3,
  WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
