#version 300 es
// One Gaussian a vertex, in the order of drawing: moved to the time, projected, coloured. What comes out are the
// corners of its square: transform feedback captures them for splat.vert.glsl, so that a Gaussian is computed once and
// not four times.
precision highp float;
precision highp int;
precision highp sampler2D;
precision highp usampler2D;

in uint aIndex;

// Lists, in textures ROW texels wide. Of each Gaussian:
uniform sampler2D uGaussians;    // 4 texels: place, logit; quaternion wxyz; log scales, 3D filter; base harmonic
uniform sampler2D uHarmonics;    // HARMONIC_TEXELS: the other harmonics, three colours a term
uniform usampler2D uBoned;       // 2: its bones
uniform sampler2D uBonedShares;  // 2: their shares
// Of each Gaussian that moves:
uniform usampler2D uDriven;      // its drivers
uniform sampler2D uDrivenShares; // their shares
uniform sampler2D uWindows;      // half of one: when its window in time begins and ends
uniform sampler2D uLines;        // 2: velocity, mean time; log of the standard deviation of its opacity over time
uniform sampler2D uWaves;        // WAVES times WAVE_TEXELS: the harmonics of each cosine in time
// Of each driver, each bone, and the network:
uniform sampler2D uDrivers;      // 6: rows of the affine map; changes of quaternion; of log scales and logit; of colour
uniform sampler2D uBones;        // 3: rows of the affine map
uniform sampler2D uNetwork;      // rows of the layers' weights, four a texel, then the biases

uniform mat4 uCamFromWorld;
uniform vec4 uIntrinsics;  // fx fy cx cy, px
uniform vec2 uSize;        // px
uniform vec3 uEye;
uniform vec4 uLimits;      // eps2d px^2, near, least alpha, 1 where opacities are compensated for eps2d
uniform float uTime;
uniform vec4 uBody;        // translation and scale of a body, applied after its bones
uniform mat3 uTurn;        // of a body from rest to the world
uniform vec3 uBox[2];      // centre and half sides of the network's box

// Corners: place in clip space, and in standard deviations from the centre. Outside the image where nothing is seen.
out vec4 vCorner0;
out vec4 vColor0;  // rgb, opacity
out vec4 vCorner1;
out vec4 vColor1;
out vec4 vCorner2;
out vec4 vColor2;
out vec4 vCorner3;
out vec4 vColor3;

const float FARTHEST = 1e10;

vec4 at(sampler2D list, int place) { return texelFetch(list, ivec2(place & (ROW - 1), place / ROW), 0); }
uvec4 at(usampler2D list, int place) { return texelFetch(list, ivec2(place & (ROW - 1), place / ROW), 0); }

mat3 matrixOf(vec4 q) {
  float size = length(q);
  q = size > 0.0 ? q / size : vec4(1.0, 0.0, 0.0, 0.0);
  float w = q.x, x = q.y, y = q.z, z = q.w;
  return mat3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y),
              2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x),
              2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y));
}

vec4 product(vec4 a, vec4 b) {
  return vec4(a.x * b.x - dot(a.yzw, b.yzw), a.x * b.yzw + b.x * a.yzw + cross(a.yzw, b.yzw));
}

// The rotation nearest to a matrix: Newton's iteration for its polar factor (Higham 1986).
mat3 nearestRotation(mat3 m) {
  for (int i = 0; i < 4; ++i) m = 0.5 * (m + transpose(inverse(m)));
  return m;
}

struct Gaussian {
  vec3 mean;
  float logit;
  vec4 quat;
  vec3 logScales;
  float filterStd;
  vec3 base;
  vec3 rest;  // place before anything moves
  mat3 map;   // that its axes go through
  mat3 turn;  // that its colours follow
};

Gaussian stored(int i) {
  vec4 a = at(uGaussians, 4 * i), b = at(uGaussians, 4 * i + 1), c = at(uGaussians, 4 * i + 2);
  return Gaussian(a.xyz, a.w, b, c.xyz, c.w, at(uGaussians, 4 * i + 3).rgb, a.xyz, mat3(1.0), mat3(1.0));
}

#if WINDOWED
// Log opacity of a window in time that begins and ends so.
float windowAt(vec2 window) {
  return -log(1.0 + exp((window.x - uTime) / EDGE)) - log(1.0 + exp((uTime - window.y) / EDGE));
}
#endif

#if MOVING
// Changes by the four drivers, and by the window in time, of a Gaussian that moves.
void drive(int i, inout Gaussian g) {
  uvec4 drivers = at(uDriven, i);
  vec4 shares = at(uDrivenShares, i), point = vec4(g.mean, 1.0), quat = vec4(0.0), sizes = vec4(0.0);
  vec3 moved = vec3(0.0), color = vec3(0.0);
  for (int k = 0; k < 4; ++k) {
    int d = 6 * int(drivers[k]);
    float share = shares[k];
    for (int row = 0; row < 3; ++row) moved[row] += share * dot(at(uDrivers, d + row), point);
    quat += share * at(uDrivers, d + 3);
    sizes += share * at(uDrivers, d + 4);
    color += share * at(uDrivers, d + 5).rgb;
  }
  g.mean = moved;
  g.quat = product(quat, g.quat);
  g.logScales += sizes.xyz;
  g.logit += sizes.w;
  g.base += color;
#if WINDOWED
  vec4 two = at(uWindows, i >> 1);
  vec2 window = (i & 1) == 0 ? two.xy : two.zw;
  g.logit += windowAt(window) - windowAt(vec2(OPEN));
#endif
}
#endif

#if BONES
void bend(int i, inout Gaussian g) {
  vec4 rows[3] = vec4[3](vec4(0.0), vec4(0.0), vec4(0.0));
  for (int s = 0; s < 2; ++s) {
    uvec4 bones = at(uBoned, 2 * i + s);
    vec4 shares = at(uBonedShares, 2 * i + s);
    for (int k = 0; k < 4; ++k)
      for (int row = 0; row < 3; ++row) rows[row] += shares[k] * at(uBones, 3 * int(bones[k]) + row);
  }
  vec4 point = vec4(g.mean, 1.0);
  g.mean = uBody.w * vec3(dot(rows[0], point), dot(rows[1], point), dot(rows[2], point)) + uBody.xyz;
  g.map = transpose(mat3(rows[0].xyz, rows[1].xyz, rows[2].xyz));
#if DEGREE || LAYERS
  g.turn = nearestRotation(g.map);
#endif
  g.map *= uBody.w;
}
#endif

#if LINES
#if WAVE_TEXELS
float waves[4 * WAVE_TEXELS];  // what the cosines in time add to the harmonics
#endif

// Moves a 4D Gaussian along its line and changes its colour. Returns the factor of its opacity.
float advance(int i, inout Gaussian g) {
  vec4 line = at(uLines, 2 * i);
  float elapsed = uTime - line.w, spans = elapsed * exp(-at(uLines, 2 * i + 1).x);
  g.mean += elapsed * line.xyz;
#if WAVE_TEXELS
  for (int k = 0; k < 4 * WAVE_TEXELS; ++k) waves[k] = 0.0;
  for (int n = 0; n < WAVES; ++n) {
    float amplitude = cos(6.283185307179586 * float(n + 1) * elapsed);
    for (int t = 0; t < WAVE_TEXELS; ++t) {
      vec4 texel = at(uWaves, (WAVES * i + n) * WAVE_TEXELS + t);
      for (int k = 0; k < 4; ++k) waves[4 * t + k] += amplitude * texel[k];
    }
  }
  g.base += vec3(waves[0], waves[1], waves[2]);
#endif
  return exp(-0.5 * spans * spans);
}
#endif

#include "harmonics.glsl"

#if LAYERS
// What the colour network adds to the base colour; see dyngs/ops/shading.py and dyngs/colour/network.py.
vec3 shaded(Gaussian g, vec3 d) {
  vec3 base = 0.5 + 0.28209479177387814 * g.base;
  vec3 place = g.mean, normal;
  mat3 axes = g.turn * matrixOf(g.quat);
  normal = axes[0];
  float least = g.logScales.x;
  if (g.logScales.y < least) { least = g.logScales.y; normal = axes[1]; }
  if (g.logScales.z < least) normal = axes[2];
#if BONES
  place = g.rest;
  d = d * uTurn;
  normal = normal * uTurn;
#endif
  place = (place - uBox[0]) / uBox[1];
  float far = max(1.0, length(place));
  place *= (2.0 - 1.0 / far) / far;
  float now[WIDTH], next[WIDTH];
  for (int k = 0; k < WIDTH; ++k) now[k] = 0.0;
  for (int k = 0; k < 3; ++k) { now[k] = place[k]; now[3 + k] = d[k]; }
  int count = 6;
#if SEES_NORMALS
  float cosine = dot(normal, d);
  now[count++] = abs(cosine);
  vec3 mirrored = d - 2.0 * cosine * normal;
  for (int k = 0; k < 3; ++k) now[count++] = mirrored[k];
#endif
  for (int k = 0; k < 3; ++k) now[count++] = base[k] - 0.5;
#if SEES_TIME
  now[count] = 2.0 * uTime - 1.0;
#endif
  int place4 = 0;  // texel of the network
  for (int layer = 0; layer < LAYERS; ++layer) {
    int columns = layer == 0 ? FIRST : WIDTH, rows = layer == LAYERS - 1 ? 3 : WIDTH;
    for (int row = 0; row < rows; ++row) {
      vec4 sum = vec4(0.0);
      for (int k = 0; k < columns; k += 4)
        sum += at(uNetwork, place4++) * vec4(now[k], now[k + 1], now[k + 2], now[k + 3]);
      next[row] = sum.x + sum.y + sum.z + sum.w;
    }
    for (int row = 0; row < rows; ++row) {
      float value = next[row] + at(uNetwork, place4 + row / 4)[row & 3];
      now[row] = layer == LAYERS - 1 ? value : max(value, 0.0);
    }
    place4 += (rows + 3) / 4;
  }
  return max(base + vec3(now[0], now[1], now[2]), 0.0);
}
#endif

vec4 cornerAt(vec2 place, vec2 from) {
  vec2 clip = place / uSize * 2.0 - 1.0;
  return vec4(clip.x, -clip.y, from);
}

void main() {
  gl_Position = vec4(0.0);
  vCorner0 = vCorner1 = vCorner2 = vCorner3 = vec4(2.0, 2.0, 0.0, 0.0);
  vColor0 = vColor1 = vColor2 = vColor3 = vec4(0.0);
  int i = int(aIndex);
  Gaussian g = stored(i);
#if MOVING
  if (i < MOVING) drive(i, g);
#endif
#if BONES
  bend(i, g);
#endif
  float weight = 1.0;
#if LINES
  if (i < LINES) weight = advance(i, g);
#endif
  vec3 p = (uCamFromWorld * vec4(g.mean, 1.0)).xyz;
  if (!(p.z > uLimits.y && p.z < FARTHEST)) return;
  vec3 scales = exp(g.logScales);
  float opacity = weight / (1.0 + exp(-g.logit));
#if FILTERED
  vec3 wider = sqrt(scales * scales + g.filterStd * g.filterStd);
  vec3 shares = scales / wider;
  opacity *= shares.x * shares.y * shares.z;
  scales = wider;
#endif
  vec2 f = uIntrinsics.xy, c = uIntrinsics.zw, margin = 0.15 * uSize / f;
  vec2 tangent = clamp(p.xy / p.z, -c / f - margin, (uSize - c) / f + margin);
  mat3 half3 = mat3(uCamFromWorld) * g.map * matrixOf(g.quat);
  half3 = mat3(half3[0] * scales.x, half3[1] * scales.y, half3[2] * scales.z);
  mat3 rows = transpose(half3);
  vec3 u = f.x / p.z * (rows[0] - tangent.x * rows[2]), v = f.y / p.z * (rows[1] - tangent.y * rows[2]);
  vec3 across = cross(u, v);
  float bare = dot(across, across), a = dot(u, u), b = dot(u, v), d = dot(v, v), eps = uLimits.x;
  float det = bare + eps * (a + d) + eps * eps;
  if (uLimits.w > 0.5) opacity *= sqrt(bare / det);
  if (!(opacity > uLimits.z)) return;
  a += eps; d += eps;
  float reach = 2.0 * log(opacity / uLimits.z);
  vec2 center = f * p.xy / p.z + c, extent = ceil(sqrt(reach * vec2(a, d)));
  if (any(lessThanEqual(center + extent, vec2(0.0))) || any(greaterThanEqual(center - extent, uSize))) return;
  float longer = 0.5 * (a + d) + length(vec2(0.5 * (a - d), b));
  vec2 along = abs(b) > 1e-6 * longer ? normalize(vec2(b, longer - a)) : (a >= d ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
  vec3 toward = normalize(g.mean - uEye);
#if LAYERS
  vec3 color = shaded(g, toward);
#else
  vec3 color = max(0.5 + 0.28209479177387814 * g.base + harmonics(i, toward * g.turn), 0.0);
#endif
  float radius = sqrt(reach);
  vec2 far = radius * along * sqrt(longer), aside = radius * vec2(-along.y, along.x) * sqrt(det / longer);
  vCorner0 = cornerAt(center - far - aside, vec2(-radius, -radius));
  vCorner1 = cornerAt(center + far - aside, vec2(radius, -radius));
  vCorner2 = cornerAt(center - far + aside, vec2(-radius, radius));
  vCorner3 = cornerAt(center + far + aside, vec2(radius, radius));
  vColor0 = vColor1 = vColor2 = vColor3 = vec4(color, opacity);
}
