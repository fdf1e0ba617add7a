precision highp float;
precision highp sampler2D;
uniform sampler2D layer;     // value x known, known; with means at every scale
uniform sampler2D colours;   // one colour map per row
uniform float colour_row;    // below 0: grey with display gamma
uniform vec2 limits;         // black and white
uniform vec4 outline;        // of a photograph: left, top, right, bottom
uniform vec3 outline_colour;
uniform sampler2D photograph; // value x known, known
uniform float swipe;         // the share of its width that is shown instead of the layer
uniform bool picking;        // write the place instead
in vec2 place;
out vec4 result;

void main() {
  vec2 found = texture(layer, place).rg;
  if (picking) { result = vec4(place, 1.0, 1.0); return; }
  vec2 within = (place - outline.xy) / (outline.zw - outline.xy);
  bool inside = all(greaterThan(within, vec2(0.0))) && all(lessThan(within, vec2(1.0)));
  vec2 measured = texture(photograph, clamp(within, 0.0, 1.0)).rg;
  if (inside && within.x < swipe && measured.g > 0.5) found = measured;
  if (found.g < 0.05) discard;
  float t = clamp((found.r / found.g - limits.x) / (limits.y - limits.x), 0.0, 1.0);
  vec3 colour = colour_row < 0.0 ? vec3(pow(t, 1.0 / 2.2)) : texture(colours, vec2((t * 255.0 + 0.5) / 256.0, colour_row)).rgb;
  vec2 width = 1.25 * fwidth(place);
  vec2 outside = max(outline.xy - place, place - outline.zw);
  float edge = max(outside.x / width.x, outside.y / width.y);
  bool divider = inside && abs(place.x - mix(outline.x, outline.z, swipe)) < 0.5 * width.x;
  if (outline.z > outline.x && (abs(edge) < 1.0 || divider && swipe > 0.0)) colour = outline_colour;
  float alpha = min(1.0, found.g * 1.5);
  result = vec4(colour * alpha, alpha);
}
