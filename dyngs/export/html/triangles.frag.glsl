#version 300 es
// The colour of a place on a triangle: linear between the points of a lattice, or quadratic.
precision highp float;
precision highp int;
precision highp sampler2D;

centroid in vec2 vPlace;
flat in int vTriangle;
flat in vec3 vByDirection;
uniform sampler2D uColours;  // COLOURS texels of each triangle
out vec4 color;

vec3 colourAt(int k) {
  int place = COLOURS * vTriangle + k;
  return texelFetch(uColours, ivec2(place & (ROW - 1), place / ROW), 0).rgb;
}

#if TEXTURE
vec3 corner(int i, int j) {
  int row = TEXTURE - i;
  return colourAt(row * (row + 1) / 2 + row - j);
}

vec3 colour(vec2 place) {
  place *= float(TEXTURE);
  int i = min(int(place.x), TEXTURE - 1), j = min(int(place.y), TEXTURE - 1 - i);
  vec2 f = place - vec2(i, j);
  if (f.x + f.y <= 1.0 || i + j + 2 > TEXTURE)
    return (1.0 - f.x - f.y) * corner(i, j) + f.x * corner(i + 1, j) + f.y * corner(i, j + 1);
  return (f.x + f.y - 1.0) * corner(i + 1, j + 1) + (1.0 - f.x) * corner(i, j + 1) + (1.0 - f.y) * corner(i + 1, j);
}
#else
vec3 colour(vec2 place) {
  float u = place.x, v = place.y, w = 1.0 - u - v;
  return u * u * colourAt(0) + 2.0 * (u * v * colourAt(1) + u * w * colourAt(2) + v * w * colourAt(4)) +
         v * v * colourAt(3) + w * w * colourAt(5);
}
#endif

void main() {
  vec2 place = max(vPlace, 0.0);
  place /= max(place.x + place.y, 1.0);
  color = vec4(max(colour(place) + vByDirection, 0.0), 1.0);
}
