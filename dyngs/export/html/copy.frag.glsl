#version 300 es
precision highp float;

in vec2 vAt;
uniform sampler2D uImage;
out vec4 color;

void main() { color = vec4(texture(uImage, vAt).rgb, 1.0); }
