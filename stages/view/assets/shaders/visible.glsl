// The Sun's visible share at every pixel: the terrain horizon against the Sun's limb-darkened disc.
uniform sampler2D rays;
const int NEAR = 6;  // rows at least that are looked at along the pixel's own ray
out vec4 result;

float disc_share(float t) {  // of a limb-darkened disc above a line t radii above its centre (u = 0.6)
  t = clamp(t, -1.0, 1.0);
  float uniform_disc = 0.5 - (t * sqrt(1.0 - t * t) + asin(t)) / PI;
  float darkened = 0.5 - 0.75 * (t - t * t * t / 3.0);
  return mix(uniform_disc, darkened, 0.5);
}

// where the horizon cuts the disc, in radii above its centre, between two of its heights
float crossing(float lower, float above, float below) { return lower + 2.0 / 3.0 * above / max(above - below, 1e-20); }

vec4 ray_between(float line, int i) {
  if (i * GRAIN >= count) return vec4(NOTHING);
  int whole = int(floor(line));
  vec4 a = texelFetch(rays, ivec2(whole, i), 0), b = texelFetch(rays, ivec2(whole + 1, i), 0);
  float share = line - floor(line);
  return vec4(blend(a.x, b.x, share), blend(a.y, b.y, share), blend(a.z, b.z, share), blend(a.w, b.w, share));
}

void main() {
  ivec2 here = ivec2(gl_FragCoord.xy);
  float own = height_at(here);
  int i = by_rows ? here.y : here.x, column = by_rows ? here.x : here.y;
  if (backwards) i = count - 1 - i;
  own = sunk(own, float(i));
  vec4 top = vec4(NOTHING);
  int next = (i + NEAR + GRAIN - 1) / GRAIN, rows = next * GRAIN - i;  // row of the lattice to go on from
  for (int d = 0; d < rows; d++) {
    float at = float(column) + shear * float(d), share;
    float crossed = between_rows(i + d, at, share);
    if (is_known(crossed)) top = max(top, crossed - (float(d) + share) * drop);
    if (d > 0 && i + d < count) {
      float ground = on_row(i + d, at);
      if (is_known(ground)) top = max(top, ground - float(d) * drop);
    }
  }
  vec4 far = ray_between(float(column + first) - shear * float(i), next);
  top = max(top, far - float(rows) * drop);
  vec4 over = top - own;  // m by which the horizon stands over four heights on the disc
  float share = 1.0;
  if (is_known(own) && over.x > 0.0) {
    if (over.w >= 0.0) share = 0.0;
    else if (over.y <= 0.0) share = disc_share(crossing(-1.0, over.x, over.y));
    else if (over.z <= 0.0) share = disc_share(crossing(-1.0 / 3.0, over.y, over.z));
    else share = disc_share(crossing(1.0 / 3.0, over.z, over.w));
  }
  result = vec4(share, 0.0, 0.0, 1.0);
}
