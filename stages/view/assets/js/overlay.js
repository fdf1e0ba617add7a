// Lines over the picture: longitudes and latitudes, what is measured, where one went.

class Overlay {
  constructor(head, page, terrain) {
    Object.assign(this, { head, page, terrain, ground: terrain.ground, svg: byId("overlay"), ends: [], mark: null, grid: null });
  }

  draw() {
    const parts = [];
    for (const { name, places } of this.grid ?? []) parts.push(this.line(places, "grid"), this.text(name, places));
    if (this.ends.length === 2) parts.push(this.line(this.along(96), "measured"));
    for (const at of this.ends) parts.push(this.symbol(at, "M0 0", "measured end"));
    if (this.mark) parts.push(this.symbol(this.mark, "M-12 0H-4M4 0H12M0-12V-4M0 4V12", "measured"));
    this.svg.replaceChildren(...parts.filter(Boolean));
  }

  line(places, kind) {
    const points = places.map((at) => this.terrain.screen(at)).filter(Boolean);
    return points.length > 1 && element("polyline", { points: points.map((p) => p.map((v) => v.toFixed(1)).join()).join(" "), class: kind });
  }

  symbol(at, d, kind) {
    const place = this.terrain.screen(at);
    return place && element("path", { d, class: kind, transform: `translate(${place})` });
  }

  /** Where a line first is well inside the picture */
  text(name, places) {
    const { clientWidth, clientHeight } = this.svg, inside = ([x, y]) => x > 8 && y > 60 && x < clientWidth - 70 && y < clientHeight - 60;
    const place = places.map((at) => this.terrain.screen(at)).find((p) => p && inside(p));
    return place && Object.assign(element("text", { x: place[0] + 4, y: place[1] - 4 }), { textContent: name });
  }

  /** Round longitudes and latitudes, about five of each */
  showGrid(shown) {
    this.grid = null;
    if (!shown) return;
    const { head, ground } = this, { width, height } = head, [middle] = ground.lonLat((height - 1) / 2, (width - 1) / 2), seen = [];
    for (let j = 0; j <= 8; j++) for (let i = 0; i <= 8; i++) seen.push(ground.lonLat(((height - 1) * j) / 8, ((width - 1) * i) / 8));
    const ranges = [range(seen.map(([lon]) => near(lon, middle))), range(seen.map(([, lat]) => lat))];
    const steps = ranges.map(([low, high]) => roundBelow((high - low) / 4)), lines = [0, 1].flatMap((axis) => {
      const [low, high] = ranges[axis], [from, to] = ranges[1 - axis], found = [];
      for (let k = Math.ceil(low / steps[axis]); k * steps[axis] <= high; k++) {
        const fixed = k * steps[axis], places = [...Array(49)].map((_, n) => from + ((to - from) * n) / 48).map((v) => ground.placeOf(axis ? v : fixed, axis ? fixed : v));
        found.push({ name: angleName(fixed, steps[axis], axis), places: places.filter((at) => ground.holds(at)) });
      }
      return found;
    });
    this.grid = lines;
  }

  /** Places from end to end */
  along(count) {
    const [a, b] = this.ends;
    return [...Array(count + 1)].map((_, n) => ({ row: a.row + ((b.row - a.row) * n) / count, col: a.col + ((b.col - a.col) * n) / count }));
  }

  /** Take up a place; with the second one the panel shows distance and profile. */
  measure(at) {
    this.ends = this.ends.length === 2 ? [at] : [...this.ends, at];
    byId("profile").hidden = this.ends.length < 2;
    if (this.ends.length < 2) return;
    const { ground, head, page } = this, ups = this.ends.map(({ row, col }) => new THREE.Vector3(...ground.up(row, col)));
    const distance = 2 * head.radius * Math.asin(Math.min(1, ups[0].distanceTo(ups[1]) / 2));
    const heights = this.along(200).map(({ row, col }) => page.elevation[Math.round(row) * head.width + Math.round(col)]);
    const [low, high] = range(heights), rise = heights[200] - heights[0], x = (k) => (k / 200) * 300, y = (z) => 76 - (72 * (z - low)) / (high - low || 1);
    const d = heights.map((z, k) => (Number.isNaN(z) ? "" : `${k && !Number.isNaN(heights[k - 1]) ? "L" : "M"}${x(k).toFixed(1)} ${y(z).toFixed(1)}`)).join("");
    byId("profile-line").setAttribute("d", d);
    byId("profile-text").textContent = `${metres(distance)}, ${rise < 0 ? "down" : "up"} ${metres(Math.abs(rise))}: ${((Math.atan2(rise, distance) * 180) / Math.PI).toFixed(1)}° on average. Heights from ${low.toFixed(1)} to ${high.toFixed(1)} m.`;
  }
}

function element(name, attributes) {
  const made = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}

/** The longitude that is the same and nearest to another */
const near = (lon, other) => other + ((((lon - other + 180) % 360) + 360) % 360) - 180;

/** 1, 2 or 5 times a power of ten */
function roundBelow(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return [5, 2, 1].map((k) => k * power).find((v) => v <= value * 1.0001);
}

function angleName(value, step, latitude) {
  const digits = Math.max(0, -Math.floor(Math.log10(step) + 1e-9));
  return latitude ? `${Math.abs(value).toFixed(digits)}° ${value < 0 ? "S" : "N"}` : `${(((value % 360) + 360) % 360).toFixed(digits)}° E`;
}

const metres = (length) => (length >= 1000 ? `${short(length / 1000)} km` : `${short(length)} m`);
