#version 300 es
precision highp float;

in vec2 vAt;
uniform sampler2D uPicture;
out vec4 color;

void main() { color = vec4(texture(uPicture, vAt).rgb, 1.0); }
