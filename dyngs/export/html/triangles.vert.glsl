#version 300 es
// A point of the lattice of flat faces that a Bezier triangle is drawn as.
precision highp float;
precision highp int;
precision highp sampler2D;

in vec2 aPlace;  // u, v
in uint aTriangle;

// Lists, in textures ROW texels wide. Of each triangle:
uniform sampler2D uPoints;     // 6 texels: its control points 200, 110, 101, 020, 011, 002
uniform sampler2D uHarmonics;  // HARMONIC_TEXELS: those of its colours, three colours a term
uniform mat4 uCamFromWorld;
uniform vec4 uIntrinsics;      // fx fy cx cy, px
uniform vec2 uSize;            // px
uniform vec2 uRange;           // depths of what is drawn, world units
uniform vec3 uEye;

centroid out vec2 vPlace;
flat out int vTriangle;
flat out vec3 vByDirection;

vec4 at(sampler2D list, int place) { return texelFetch(list, ivec2(place & (ROW - 1), place / ROW), 0); }

#include "harmonics.glsl"

void main() {
  int i = int(aTriangle);
  float u = aPlace.x, v = aPlace.y, w = 1.0 - u - v;
  float weights[6] = float[](u * u, 2.0 * u * v, 2.0 * u * w, v * v, 2.0 * v * w, w * w);
  vec3 point = vec3(0.0);
  for (int k = 0; k < 6; ++k) point += weights[k] * at(uPoints, 6 * i + k).xyz;
  vec3 middle = (at(uPoints, 6 * i).xyz + at(uPoints, 6 * i + 3).xyz + at(uPoints, 6 * i + 5).xyz) / 3.0;
  vec3 local = (uCamFromWorld * vec4(point, 1.0)).xyz;
  vec2 image = 2.0 * (uIntrinsics.xy * local.xy + uIntrinsics.zw * local.z) / uSize - local.z;
  float depth = ((uRange.y + uRange.x) * local.z - 2.0 * uRange.y * uRange.x) / (uRange.y - uRange.x);
  gl_Position = vec4(image.x, -image.y, depth, local.z);
  vPlace = aPlace;
  vTriangle = i;
  vByDirection = harmonics(i, normalize(middle - uEye));
}
