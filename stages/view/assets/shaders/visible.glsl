// The Sun's visible share at every pixel: the terrain horizon against the Sun's limb-darkened disc.
uniform sampler2D rays;
const int NEAR = 8;  // rows looked at along the pixel's own ray
out vec4 result;

float disc_share(float t) {  // of a limb-darkened disc above a line t radii above its centre (u = 0.6)
  t = clamp(t, -1.0, 1.0);
  float uniform_disc = 0.5 - (t * sqrt(1.0 - t * t) + asin(t)) / PI;
  float darkened = 0.5 - 0.75 * (t - t * t * t / 3.0);
  return mix(uniform_disc, darkened, 0.5);
}

vec2 ray_between(float line, int i) {
  if (i >= count) return vec2(NOTHING);
  int whole = int(floor(line));
  vec2 a = texelFetch(rays, ivec2(whole, i), 0).rg, b = texelFetch(rays, ivec2(whole + 1, i), 0).rg;
  float share = line - floor(line);
  return vec2(blend(a.x, b.x, share), blend(a.y, b.y, share));
}

void main() {
  ivec2 here = ivec2(gl_FragCoord.xy);
  float own = height_at(here);
  int i = by_rows ? here.y : here.x, column = by_rows ? here.x : here.y;
  if (backwards) i = count - 1 - i;
  own = sunk(own, float(i));
  vec2 top = vec2(NOTHING);
  for (int d = 0; d < NEAR; d++) {
    float at = float(column) + shear * float(d), share;
    float crossed = between_rows(i + d, at, share);
    if (is_known(crossed)) top = max(top, crossed - (float(d) + share) * drop);
    if (d > 0 && i + d < count) {
      float ground = on_row(i + d, at);
      if (is_known(ground)) top = max(top, ground - float(d) * drop);
    }
  }
  vec2 far = ray_between(float(column + first) - shear * float(i), i + NEAR);
  top = max(top, far - float(NEAR) * drop);
  vec2 over = top - own;  // m by which the horizon stands over the Sun's lower and upper edge
  float share = 1.0;
  if (is_known(own) && over.x > 0.0) share = over.y >= 0.0 ? 0.0 : disc_share(2.0 * over.x / (over.x - over.y) - 1.0);
  result = vec4(share, 0.0, 0.0, 1.0);
}
