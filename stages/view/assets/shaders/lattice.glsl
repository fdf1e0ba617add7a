// Lines of sight towards the Sun over the map. Line k crosses row i of the sweep at the column k - first + shear i; rows
// count towards the Sun. Heights are those above the plane of the map's middle, so that the Sun's rays are straight.
const int GRAIN = 8;       // rows that one row of the lattice stands for: exact, as pixels look at the rows before it themselves
uniform bool by_rows;      // the sweep's rows are rows of the map, else its columns
uniform bool backwards;    // they count down
uniform int count;         // rows of the sweep
uniform int first;
uniform float shear;       // columns from row to row, -1..1
uniform float spacing;     // m from row to row along a ray
uniform float radius;      // of the body, m
uniform vec4 drop;         // m that a ray falls from row to row, of four heights on the Sun's disc, lower edge to upper

ivec2 place_of(int i, int column) {
  int row = backwards ? count - 1 - i : i;
  return by_rows ? ivec2(column, row) : ivec2(row, column);
}
float sweep_height(int i, int column) { return height_at(place_of(i, column)); }

float sunk(float height, float i) {
  float away = (i - 0.5 * float(count - 1)) * spacing;
  return is_known(height) ? height - away * away / (2.0 * radius) : NOTHING;
}

// the ground where a ray crosses row i at a column, and where it crosses a column before the next row
float on_row(int i, float column) {
  float whole = floor(column);
  return sunk(blend(sweep_height(i, int(whole)), sweep_height(i, int(whole) + 1), column - whole), float(i));
}
float between_rows(int i, float column, out float share) {
  share = 0.0;
  float crossed = shear > 0.0 ? floor(column) + 1.0 : ceil(column) - 1.0;
  if (shear == 0.0) return NOTHING;
  share = (crossed - column) / shear;
  if (share >= 1.0) return NOTHING;
  return sunk(blend(sweep_height(i, int(crossed)), sweep_height(i + 1, int(crossed)), share), float(i) + share);
}
