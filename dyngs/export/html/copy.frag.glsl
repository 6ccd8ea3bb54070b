#version 300 es
precision highp float;

in vec2 vAt;
uniform sampler2D uImage;
out vec4 color;

void main() { color = texture(uImage, vAt); }
