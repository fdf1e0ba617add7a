precision highp float;
precision highp int;
precision highp sampler2D;
precision highp sampler2DArray;
#define PI 3.141592653589793
const float NOTHING = -1e30;
uniform sampler2D heights;  // m above the page's base height; NOTHING where unknown
uniform ivec2 size;         // columns, rows

bool is_known(float height) { return height > -1e29; }

float height_at(ivec2 place) {
  if (any(lessThan(place, ivec2(0))) || any(greaterThanEqual(place, size))) return NOTHING;
  return texelFetch(heights, place, 0).r;
}

float blend(float a, float b, float share) {
  if (share <= 0.0) return a;
  return is_known(a) && is_known(b) ? mix(a, b, share) : NOTHING;
}
