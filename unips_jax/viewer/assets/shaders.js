// One program draws every layer, on the flat picture and on the surface.

const KINDS = { lit: 0, environment: 1, normals: 2, depth: 3, confidence: 4, picture: 5 };

const VERTEX = `
precision highp float;
uniform mat4 projectionMatrix, modelViewMatrix;
in vec3 position;
in vec2 uv;
out vec2 place;
void main() {
  place = uv;
  gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
}`;

const FRAGMENT = `
precision highp float;
uniform int kind;
uniform sampler2D normalMap, colorMap, pictureMap, depthMap, errorMap, aroundMap;
uniform vec4 part;           // of the picture that the first three show: corner, 1 / size
uniform float detail;        // how much normals differ more from those around them
uniform mat3 turn;           // from the normals' frame to the viewer's
uniform vec3 light;          // towards the light, in the viewer's frame
uniform float gloss;
uniform bool colored;
uniform vec3 harmonics[9];
uniform vec3 depthColors[16], errorColors[16];
in vec2 place;
out vec4 shown;

const float AMBIENT = 0.04;

vec3 linear(vec3 c) {
  return mix(c / 12.92, pow((c + 0.055) / 1.055, vec3(2.4)), step(0.04045, c));
}

vec3 encoded(vec3 c) {
  c = clamp(c, 0.0, 1.0);
  return mix(12.92 * c, 1.055 * pow(c, vec3(1.0 / 2.4)) - 0.055, step(0.0031308, c));
}

vec3 ramp(vec3 colors[16], float share) {
  float at = clamp(share, 0.0, 1.0) * 15.0;
  int i = int(min(floor(at), 14.0));
  return mix(colors[i], colors[i + 1], at - float(i));
}

vec3 irradiance(vec3 n) {
  return harmonics[0] + harmonics[1] * n.y + harmonics[2] * n.z + harmonics[3] * n.x
    + harmonics[4] * n.x * n.y + harmonics[5] * n.y * n.z
    + harmonics[6] * (3.0 * n.z * n.z - 1.0) + harmonics[7] * n.z * n.x
    + harmonics[8] * (n.x * n.x - n.y * n.y);
}

void main() {
  vec2 own = (place - part.xy) * part.zw;
  vec3 stored = texture(normalMap, own).rgb * (255.0 / 127.5) - 1.0;
  float size = length(stored);
  bool inside = size > 0.5;
  vec3 raw = stored / max(size, 1e-4);
  vec3 n = raw;
  if (detail > 0.0) n = normalize(raw + detail * (raw - texture(aroundMap, place).xyz));
  n = turn * n;
  if (!gl_FrontFacing) n = -n;  // the back is lit as well
  vec3 albedo = colored ? linear(texture(colorMap, own).rgb) : vec3(0.75);
  vec3 result = vec3(18.0 / 255.0);
  if (kind == 5) result = texture(pictureMap, own).rgb;
  if (inside) {
    if (kind == 0) {
      vec3 halfway = normalize(light + vec3(0.0, 0.0, 1.0));
      float shine = pow(max(dot(n, halfway), 0.0), mix(12.0, 160.0, gloss));
      float facing = max(dot(n, light), 0.0);
      vec3 sum = albedo * (AMBIENT + (1.0 - AMBIENT) * facing);
      result = encoded(sum + 0.6 * gloss * shine * step(0.001, facing));
    } else if (kind == 1) {
      result = encoded(albedo * max(irradiance(n), 0.0));
    } else if (kind == 2) {
      result = 0.5 * raw + 0.5;
    } else if (kind == 3) {
      vec2 packed = texture(depthMap, place).rg * 255.0;
      float level = 256.0 * packed.x + packed.y;
      if (level > 0.5) result = ramp(depthColors, 1.0 - (level - 1.0) / 65534.0);
    } else if (kind == 4) {
      result = ramp(errorColors, texture(errorMap, place).r);
    }
  }
  shown = vec4(result, 1.0);
}`;

const WHOLE = new THREE.Vector4(0, 0, 1, 1);

/** Textures and everything else that both halves of the picture share. */
function sharedUniforms(textures) {
  const colors = (name) => data.palettes[name].map((rgb) => new THREE.Vector3(...rgb));
  return {
    normalMap: { value: textures.normals },
    colorMap: { value: textures.color },
    depthMap: { value: textures.depth },
    errorMap: { value: textures.confidence },
    turn: { value: new THREE.Matrix3() },
    light: { value: new THREE.Vector3(0, 0, 1) },
    aroundMap: { value: textures.normals },
    detail: { value: 0 },
    gloss: { value: 0.15 },
    colored: { value: true },
    harmonics: { value: Array.from({ length: 9 }, () => new THREE.Vector3()) },
    depthColors: { value: colors("depth") },
    errorColors: { value: colors("confidence") },
  };
}

/** A material for one half: its kind of layer is its own, the rest is shared. Those of
 * tiles have `more` of their own. */
function layerMaterial(shared, blank, more = {}) {
  const own = { kind: { value: KINDS.lit }, pictureMap: { value: blank }, part: { value: WHOLE } };
  return new THREE.RawShaderMaterial({
    glslVersion: THREE.GLSL3,
    vertexShader: VERTEX,
    fragmentShader: FRAGMENT,
    side: THREE.DoubleSide,
    uniforms: { ...shared, ...own, ...more },
  });
}
