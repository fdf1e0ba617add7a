// The highest ray over every line: each pass looks twice as far towards the Sun as the one before.
uniform sampler2D rays;
uniform int reach;  // rows; 0: begin with the ground itself
out vec4 result;

void main() {
  ivec2 here = ivec2(gl_FragCoord.xy);  // line, row
  vec4 top;
  if (reach == 0) {
    float column = float(here.x - first) + shear * float(here.y), share;
    float crossed = between_rows(here.y, column, share);
    top = vec4(on_row(here.y, column));
    if (is_known(crossed)) top = max(top, crossed - share * drop);
  } else {
    top = texelFetch(rays, here, 0);
    if (here.y + reach < count) top = max(top, texelFetch(rays, here + ivec2(0, reach), 0) - float(reach) * drop);
  }
  result = max(top, NOTHING);
}
