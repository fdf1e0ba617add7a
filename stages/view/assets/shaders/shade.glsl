// What is shown, on the map's own pixels: I/F by the model's formula, angles, terrain or one of the maps.
uniform sampler2DArray fields;   // coefficients that vary, then the other maps, as (value - offset) / scale
uniform sampler2D mapped;        // 1: every coefficient is known
uniform vec2 scales[FIELDS];     // offset, scale
uniform sampler2D frames;        // local axes and pixel sizes at the nodes
uniform sampler2D sunlight;      // the Sun's visible share
uniform bool shadows;
uniform vec3 sun;                // unit vector, in the axes of the map's middle
uniform bool from_above;         // every pixel is seen from straight above, else from
uniform vec3 camera;             // m, from the middle's point on the sphere
uniform float radius, base;      // m; base: the page's base height
uniform int layer_index;         // of QUANTITIES in relight.js, from FIRST_FIELD on of the maps
uniform vec2 range;              // the value that becomes 0, and the one that becomes 1
uniform ivec2 origin;
uniform int form;                // 0: (value, known); 1, 2: four numbers of a pixel
out vec4 result;
const float UNKNOWN = 60000.0;

float phase_angle(float cosine) { return acos(clamp(cosine, -1.0 + 1e-7, 1.0 - 1e-7)); }

//MODEL

struct Frame { vec3 east, north, up; vec2 pixel; };  // pixel: m along east and north

Frame frame_at(ivec2 place) {
  vec2 at = vec2(place) / vec2(size - 1) * float(NODES - 1);
  ivec2 node = clamp(ivec2(at), ivec2(0), ivec2(NODES - 2));
  vec2 f = at - vec2(node);
  vec4 v[3];
  for (int k = 0; k < 3; k++) {
    vec4 a = texelFetch(frames, ivec2(3 * node.x + k, node.y), 0), b = texelFetch(frames, ivec2(3 * node.x + 3 + k, node.y), 0);
    vec4 c = texelFetch(frames, ivec2(3 * node.x + k, node.y + 1), 0), d = texelFetch(frames, ivec2(3 * node.x + 3 + k, node.y + 1), 0);
    v[k] = mix(mix(a, b, f.x), mix(c, d, f.x), f.y);
  }
  return Frame(normalize(v[0].xyz), normalize(v[1].xyz), normalize(v[2].xyz), vec2(v[0].w, v[1].w));
}

float difference(float before, float here, float after) {
  bool b = is_known(before), a = is_known(after);
  return a && b ? 0.5 * (after - before) : a ? after - here : b ? here - before : 0.0;
}

bool field(ivec2 place, int k, out float value) {
  float stored = texelFetch(fields, ivec3(place, k), 0).r;
  value = scales[k].x + scales[k].y * stored;
  return stored < UNKNOWN;
}

void main() {
  ivec2 place = ivec2(gl_FragCoord.xy) + origin;
  float here = height_at(place);
  Frame frame = frame_at(place);
  vec2 pixel = frame.pixel * (radius + base + here) / radius;  // a pixel is wider at height
  vec2 slopes = vec2(
    difference(height_at(place - ivec2(1, 0)), here, height_at(place + ivec2(1, 0))),
    difference(height_at(place + ivec2(0, 1)), here, height_at(place - ivec2(0, 1)))) / pixel;
  vec3 normal = normalize(frame.up - slopes.x * frame.east - slopes.y * frame.north);
  vec3 view = frame.up;
  if (!from_above) view = normalize(camera - radius * (frame.up - vec3(0.0, 0.0, 1.0)) - (base + here) * frame.up);
  float mu0 = dot(normal, sun), mu = dot(normal, view), cos_g = clamp(dot(sun, view), -1.0, 1.0);
  float visible = shadows ? texelFetch(sunlight, place, 0).r : 1.0;

  bool known = is_known(here) && texelFetch(mapped, place, 0).r > 0.0;
  float p[COUNT];
  //COEFFICIENTS
  float image = 0.0;
  if (known && mu0 > 1e-7 && mu > 1e-7) image = max(radiance_factor(p, mu0, mu, cos_g) * visible, 0.0);
  vec4 angles = degrees(vec4(acos(clamp(mu0, -1.0, 1.0)), acos(clamp(mu, -1.0, 1.0)), acos(cos_g), atan(length(slopes))));

  if (form == 1) { result = vec4(known ? image : -1.0, angles.xyz); return; }
  if (form == 2) { result = vec4(mu0 > 0.0 ? visible : 0.0, angles.w, is_known(here) ? base + here : NOTHING, 0.0); return; }
  float value = image;
  if (layer_index > 0) known = is_known(here);
  if (layer_index == 1) value = mu0 > 0.0 ? visible : 0.0;
  else if (layer_index == 2) value = angles.x;
  else if (layer_index == 3) value = angles.y;
  else if (layer_index == 4) value = angles.z;
  else if (layer_index == 5) value = angles.w;
  else if (layer_index == 6) value = base + here;
  else if (layer_index >= FIRST_FIELD) known = field(place, layer_index - FIRST_FIELD, value);
  float alpha = known ? 1.0 : 0.0;
  result = vec4((value - range.x) / (range.y - range.x) * alpha, alpha, 0.0, 1.0);
}
