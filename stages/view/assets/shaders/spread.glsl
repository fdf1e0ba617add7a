// The highest ray over every line: each pass looks twice as far towards the Sun as the one before.
uniform sampler2D rays;
uniform int reach;  // rows of the lattice; 0: begin with the ground itself
out vec4 result;

void main() {
  ivec2 here = ivec2(gl_FragCoord.xy);  // line, row
  vec4 top = vec4(NOTHING);
  if (reach == 0) {
    for (int d = 0; d < GRAIN; d++) {
      int i = here.y * GRAIN + d;
      if (i >= count) break;
      float column = float(here.x - first) + shear * float(i), share;
      float crossed = between_rows(i, column, share), ground = on_row(i, column);
      if (is_known(ground)) top = max(top, ground - float(d) * drop);
      if (is_known(crossed)) top = max(top, crossed - (float(d) + share) * drop);
    }
  } else {
    top = texelFetch(rays, here, 0);
    if ((here.y + reach) * GRAIN < count) {
      top = max(top, texelFetch(rays, here + ivec2(0, reach), 0) - float(reach * GRAIN) * drop);
    }
  }
  result = max(top, NOTHING);
}
