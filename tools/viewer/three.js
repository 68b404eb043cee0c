// What the viewer uses of three.js; `python tools/bundle_viewer.py` makes one file of it.
export {
  BufferAttribute,
  BufferGeometry,
  DoubleSide,
  GLSL3,
  LinearFilter,
  Matrix3,
  Mesh,
  NearestFilter,
  OrthographicCamera,
  PerspectiveCamera,
  RawShaderMaterial,
  Scene,
  Spherical,
  Texture,
  Vector3,
  WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
