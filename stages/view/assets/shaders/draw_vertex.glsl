precision highp float;
uniform mat4 projectionMatrix, modelViewMatrix;
in vec3 position;
in vec2 uv;
out vec2 place;

void main() {
  place = uv;
  gl_Position = projectionMatrix * modelViewMatrix * vec4(position, 1.0);
}
