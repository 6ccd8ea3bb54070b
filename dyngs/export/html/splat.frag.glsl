#version 300 es
precision highp float;

in vec2 vAt;
flat in vec4 vColor;
uniform float uLeast;  // alpha
out vec4 color;

void main() {
  float alpha = min(0.99, vColor.a * exp(-0.5 * dot(vAt, vAt)));
  if (alpha < uLeast) discard;
  color = vec4(vColor.rgb * alpha, alpha);
}
