#version 300 es
// A corner of a splat's square, as project.glsl found it.
precision highp float;

in vec4 aCorner;
in vec4 aColor;
out vec2 vAt;  // standard deviations from the centre
flat out vec4 vColor;

void main() {
  vAt = aCorner.zw;
  vColor = aColor;
  gl_Position = vec4(aCorner.xy, 0.0, 1.0);
}
