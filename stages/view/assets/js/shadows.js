// Cast shadows with the Sun's disc, on the map's own pixels.
//
// Parallel lines of sight cover the map, one per pixel across. Along each, the highest ray that grazes the terrain is
// found by doubling: after n passes it knows the next 8 x 2^n rows. Four rays per line, from the Sun's lower edge to
// its upper one, give the horizon within the disc.

const SUN_RADIUS = (0.2666 * Math.PI) / 180;

const GRAIN = 8;  // as in lattice.glsl

class Shadows {
  constructor(renderer, passes, head, relief) {
    Object.assign(this, { renderer, passes, head, relief });
    this.sunlight = target(head.width, head.height, THREE.RedFormat, THREE.HalfFloatType);
    this.lines = [];
  }

  /** sun: unit vector in the axes of the map's middle */
  update(sun) {
    const { head } = this, east = sun.x, south = -sun.y;
    const byRows = Math.abs(south) >= Math.abs(east), major = byRows ? south : east, minor = byRows ? east : south;
    const count = byRows ? head.height : head.width, across = byRows ? head.width : head.height;
    const shear = major === 0 ? 0 : Math.max(-1, Math.min(1, minor / Math.abs(major)));
    const spacing = head.gsd * Math.hypot(1, shear), elevation = Math.asin(Math.min(1, sun.z));
    const edge = (angle) => spacing * Math.tan(Math.min(angle, 1.5533));  // 89 degrees: nothing casts shadows there
    const drop = new THREE.Vector4(...[-1, -1 / 3, 1 / 3, 1].map((k) => edge(elevation + k * SUN_RADIUS)));
    const first = shear > 0 ? Math.ceil(shear * (count - 1)) : 0;
    const lines = across + Math.ceil(Math.abs(shear) * (count - 1)) + 2;
    const uniforms = { by_rows: byRows, backwards: major < 0, count, first, shear, spacing, radius: head.radius, drop };
    let [from, to] = this.targets(lines, Math.ceil(count / GRAIN));
    this.passes.run("spread", { ...uniforms, reach: 0, rays: null }, to);
    const sink = (count * spacing) ** 2 / (8 * head.radius);
    const needed = drop.x > 0 ? Math.min(count, Math.ceil((this.relief + sink) / drop.x) + 1) : count;
    for (let reach = 1; reach * GRAIN < needed; reach *= 2) {
      [from, to] = [to, from];
      this.passes.run("spread", { ...uniforms, reach, rays: from.texture }, to);
    }
    this.passes.run("visible", { ...uniforms, rays: to.texture }, this.sunlight);
  }

  /** Two targets of this size, made anew only where they must grow */
  targets(lines, rows) {
    const [a] = this.lines;
    if (!a || a.width < lines || a.height < rows) {
      this.lines.forEach((old) => old.dispose());
      const width = Math.max(lines, a ? a.width : 0), height = Math.max(rows, a ? a.height : 0);
      this.lines = [0, 1].map(() => target(width, height, THREE.RGBAFormat, THREE.FloatType));
    }
    return this.lines;
  }
}

function target(width, height, format, type, options = {}) {
  const nearest = { minFilter: THREE.NearestFilter, magFilter: THREE.NearestFilter, depthBuffer: false };
  return new THREE.WebGLRenderTarget(width, height, { ...nearest, format, type, ...options });
}
