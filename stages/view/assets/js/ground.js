// Where pixels of the map are: their points in m, in the axes of the map's middle, and back.

class Ground {
  /** base: the height, m, of ground that is unknown */
  constructor(head, page, base) {
    Object.assign(this, { head, elevation: page.elevation, base });
  }

  height(row, col) {
    const { width, height } = this.head, within = (v, last) => Math.min(last, Math.max(0, Math.round(v)));
    const z = this.elevation[within(row, height - 1) * width + within(col, width - 1)];
    return Number.isFinite(z) ? z : this.base;
  }

  up(row, col) {
    return upAt(this.head.axes, this.head.nodes, row / (this.head.height - 1), col / (this.head.width - 1));
  }

  /** m from the middle's point on the sphere */
  point(row, col, height = this.height(row, col)) {
    const [x, y, z] = this.up(row, col), { radius } = this.head, r = radius + height;
    return new THREE.Vector3(r * x, r * y, r * z - radius);
  }

  /** {row, col} beneath a point, as fractions of pixels; beyond the map's border, too */
  place(point) {
    const { head } = this, d = point.clone().setZ(point.z + head.radius).normalize();
    let row = (head.height - 1) / 2, col = (head.width - 1) / 2;
    for (let k = 0; k < 6; k++) {  // Newton's method, with steps of a pixel
      const [x, y] = this.up(row, col), [xr, yr] = this.up(row + 1, col), [xc, yc] = this.up(row, col + 1);
      const [a, b, c, e, u, v] = [xr - x, xc - x, yr - y, yc - y, d.x - x, d.y - y], area = a * e - b * c;
      row += (u * e - b * v) / area;
      col += (a * v - u * c) / area;
    }
    return { row, col };
  }

  /** Where a ray from a point first meets the ground, or null; looked at in steps of 1/400 of ``reach`` m */
  hit(origin, direction, reach) {
    const { radius } = this.head, at = origin.clone(), step = direction.clone().setLength(reach / 400);
    for (let k = 0; k < 400; k++) {
      const place = this.place(at.add(step));
      if (this.holds(place) && at.clone().setZ(at.z + radius).length() - radius <= this.height(place.row, place.col)) return at;
    }
    return null;
  }

  holds({ row, col }) {
    return row >= 0 && col >= 0 && row <= this.head.height - 1 && col <= this.head.width - 1;
  }

  /** {row, col} of a longitude and latitude in degrees */
  placeOf(lon, lat) {
    const l = (lon * Math.PI) / 180, b = (lat * Math.PI) / 180, body = [Math.cos(b) * Math.cos(l), Math.cos(b) * Math.sin(l), Math.sin(b)];
    const [x, y, z] = this.head.middle.map((axis) => axis[0] * body[0] + axis[1] * body[1] + axis[2] * body[2]), { radius } = this.head;
    return z > 0 ? this.place(new THREE.Vector3(x * radius, y * radius, (z - 1) * radius)) : { row: NaN, col: NaN };
  }

  /** [longitude, latitude], degrees, the longitude from 0 to 360 */
  lonLat(row, col) {
    const up = this.up(row, col), [east, north, above] = this.head.middle;
    const [x, y, z] = [0, 1, 2].map((i) => up[0] * east[i] + up[1] * north[i] + up[2] * above[i]);
    return [((Math.atan2(y, x) * 180) / Math.PI + 360) % 360, (Math.asin(z) * 180) / Math.PI];
  }
}

/** Unit vector up at shares of the map's height and width, interpolated between nodes */
function upAt(axes, nodes, down, across) {
  const v = down * (nodes - 1), u = across * (nodes - 1), node = (at) => Math.min(nodes - 2, Math.max(0, Math.floor(at)));
  const j = node(v), i = node(u), f = u - i, g = v - j, at = (row, col, k) => axes[9 * (row * nodes + col) + 6 + k];
  const up = [0, 1, 2].map((k) => (1 - g) * ((1 - f) * at(j, i, k) + f * at(j, i + 1, k)) + g * ((1 - f) * at(j + 1, i, k) + f * at(j + 1, i + 1, k)));
  const length = Math.hypot(...up);
  return up.map((c) => c / length);
}
