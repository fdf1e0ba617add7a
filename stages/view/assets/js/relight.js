// The map under one Sun: from heights and coefficients to I/F and angles, on the map's own pixels.

const QUANTITIES = [
  { name: "image", label: "Image", camera: true },  // in the map's own brightness; camera: hangs on where the camera is
  { name: "sunlight", label: "Sunlight", unit: "share of the Sun that is seen" },
  { name: "incidence", label: "Incidence", unit: "deg", colours: "cividis" },
  { name: "emission", label: "Emission", camera: true, unit: "deg", colours: "cividis" },
  { name: "phase", label: "Phase", camera: true, unit: "deg", colours: "cividis" },
  { name: "slope", label: "Slope", unit: "deg", colours: "cividis" },
  { name: "elevation", label: "Height", unit: "m", colours: "viridis" },
];
const NOTHING = -1e30;

/** Full-screen passes into render targets, each compiled once. */
class Passes {
  constructor(renderer, sources, shared) {
    Object.assign(this, { renderer, sources, shared, materials: {} });
    this.scene = new THREE.Scene();
    this.camera = new THREE.Camera();
    this.mesh = new THREE.Mesh(new THREE.PlaneGeometry(2, 2));
    this.mesh.frustumCulled = false;
    this.scene.add(this.mesh);
  }

  run(name, values, into) {
    const material = (this.materials[name] ??= new THREE.RawShaderMaterial({
      glslVersion: THREE.GLSL3,
      vertexShader: "in vec3 position; void main() { gl_Position = vec4(position.xy, 0.0, 1.0); }",
      fragmentShader: this.sources[name],
      uniforms: {},
      depthTest: false,
      depthWrite: false,
    }));
    for (const [key, value] of Object.entries({ ...this.shared, ...values })) {
      if (material.uniforms[key]) material.uniforms[key].value = value;
      else material.uniforms[key] = { value };
    }
    material.uniformsNeedUpdate = true;
    this.mesh.material = material;
    this.renderer.setRenderTarget(into);
    this.renderer.render(this.scene, this.camera);
    this.renderer.setRenderTarget(null);
  }
}

class Relighter {
  /** coarse: drawn fast rather than sharp */
  constructor(renderer, head, page, coarse = false) {
    Object.assign(this, { renderer, head, page });
    const [low, high] = range(page.elevation);
    this.base = (low + high) / 2;
    this.relief = high - low;
    this.layers = [{ ...QUANTITIES[0], unit: head.brightness }, ...QUANTITIES.slice(1), ...page.fields.map((f) => ({ ...f, colours: f.coefficient ? "viridis" : "magma" }))];
    const heights = Float32Array.from(page.elevation, (z) => (Number.isFinite(z) ? z - this.base : NOTHING));
    const fields = this.fieldTexture(), mapped = texture(page.mapped, head.width, head.height, THREE.RedFormat, THREE.UnsignedByteType);
    const shared = {
      heights: texture(heights, head.width, head.height, THREE.RedFormat, THREE.FloatType),
      size: new THREE.Vector2(head.width, head.height),
    };
    this.passes = new Passes(renderer, sources(head, page.fields), shared);
    this.shadows = new Shadows(renderer, this.passes, head, this.relief);
    this.shown = target(head.width, head.height, THREE.RGFormat, THREE.HalfFloatType, {
      generateMipmaps: true,
      minFilter: THREE.LinearMipmapLinearFilter,
      magFilter: THREE.LinearFilter,
      anisotropy: coarse ? 1 : renderer.capabilities.getMaxAnisotropy(),
    });
    this.fixed = { fields, mapped, frames: this.frameTexture(), base: this.base, radius: head.radius, scales: this.scales };
  }

  /** Coefficients and other maps as half floats about their median, which keeps them finer than they were packed. */
  fieldTexture() {
    const { head, page } = this, pixels = head.width * head.height, count = Math.max(1, page.fields.length), data = new Uint16Array(pixels * count);
    const missing = THREE.DataUtils.toHalfFloat(65504);
    this.scales = page.fields.map((field, k) => {
      const [first, middle, last] = percentiles(field.values, [0.01, 0.5, 0.99]);
      const scale = last - first || Math.abs(middle) || 1;
      for (let i = 0, out = k * pixels; i < pixels; i++, out++) {
        const value = (field.values[i] - middle) / scale;
        data[out] = Number.isFinite(value) ? THREE.DataUtils.toHalfFloat(Math.max(-5e4, Math.min(5e4, value))) : missing;
      }
      return new THREE.Vector2(middle, scale);
    });
    if (!this.scales.length) this.scales.push(new THREE.Vector2(0, 1));  // a shader has no empty list
    const array = new THREE.DataArrayTexture(data, head.width, head.height, count);
    return Object.assign(array, { format: THREE.RedFormat, type: THREE.HalfFloatType, unpackAlignment: 2, needsUpdate: true });
  }

  frameTexture() {
    const { nodes, axes, pixel_size } = this.head, data = new Float32Array(nodes * nodes * 12);
    for (let node = 0; node < nodes * nodes; node++) {
      for (let k = 0; k < 3; k++) data.set(axes.slice(node * 9 + 3 * k, node * 9 + 3 * k + 3), node * 12 + 4 * k);
      data[node * 12 + 3] = pixel_size[2 * node + 1];
      data[node * 12 + 7] = pixel_size[2 * node];
    }
    return texture(data, 3 * nodes, nodes, THREE.RGBAFormat, THREE.FloatType);
  }

  /** light: {sun, shadows, camera (Vector3 in m, or null: straight above)} */
  setLight(light) {
    const moved = !this.light || !this.light.sun.equals(light.sun) || (light.shadows && !this.light.shadows);
    this.light = { ...light, sun: light.sun.clone() };
    if (moved && light.shadows) this.shadows.update(light.sun);
  }

  uniforms(more) {
    const { sun, shadows, camera } = this.light;
    const from = { from_above: !camera, camera: camera ?? new THREE.Vector3() };
    return { ...this.fixed, sun, shadows, ...from, sunlight: this.shadows.sunlight.texture, ...more };
  }

  /** Shade the layer into ``shown``; span: the values that become 0 and 1 there */
  show(index, span) {
    const origin = new THREE.Vector2(0, 0), limits = new THREE.Vector2(...span);
    this.passes.run("shade", this.uniforms({ layer_index: index, form: 0, origin, range: limits }), this.shown);
  }

  /** Four numbers of each pixel of a window; form 1: I/F (-1: unknown), incidence, emission, phase; 2: sunlight, slope, height */
  read(row, col, height, width, form = 1) {
    const into = target(width, height, THREE.RGBAFormat, THREE.FloatType), out = new Float32Array(4 * width * height);
    const values = this.uniforms({ layer_index: 0, form, origin: new THREE.Vector2(col, row), range: new THREE.Vector2(0, 1) });
    this.passes.run("shade", values, into);
    this.renderer.readRenderTargetPixels(into, 0, 0, width, height, out);
    into.dispose();
    return out;
  }

  /** I/F of the map as (height x width) float32, NaN where unknown, rows from the north */
  image(row = 0, col = 0, height = this.head.height, width = this.head.width) {
    const four = this.read(row, col, height, width), out = new Float32Array(height * width);
    for (let k = 0; k < out.length; k++) out[k] = four[4 * k] < 0 ? NaN : four[4 * k];
    return out;
  }

  /** Values that black and white stand for, from a few thousand pixels of the map; span: as it was shown with */
  contrast(index, span) {
    const layer = this.layers[index];
    if (index >= QUANTITIES.length) return spread(layer.values, 0.005);
    if (layer.name === "elevation") return spread(this.page.elevation, 0);
    if (layer.name === "sunlight") return [0, 1];
    const size = 96, into = (this.sample ??= target(size, size, THREE.RGBAFormat, THREE.FloatType));
    this.passes.run("sample", { layer: this.shown.texture }, into);
    const four = new Float32Array(4 * size * size), found = [];
    this.renderer.readRenderTargetPixels(into, 0, 0, size, size, four);
    for (let k = 0; k < size * size; k++) if (four[4 * k + 1] > 0.5) found.push(span[0] + four[4 * k] * (span[1] - span[0]));
    found.sort((a, b) => a - b);
    if (!found.length) return [0, 1];
    const low = found[Math.floor(0.002 * found.length)], high = found[Math.floor(0.995 * (found.length - 1))];
    if (index === 0) return [Math.min(0.9 * low, high / 2), Math.max(1.05 * high - 0.05 * low, 1e-4)];
    return high > low ? [low, high] : [low - 0.5, low + 0.5];
  }
}

function sources(head, fields) {
  const { shaders } = head, constants = `#define COUNT ${head.count}\n#define FIELDS ${Math.max(1, fields.length)}\n#define NODES ${head.nodes}\n`;
  const first = `#define FIRST_FIELD ${QUANTITIES.length}\n`;
  return {
    spread: shaders.common + shaders.lattice + shaders.spread,
    visible: shaders.common + shaders.lattice + shaders.visible,
    shade: constants + first + shaders.common + shaders.shade.replace("//MODEL", () => shaders.model).replace("//COEFFICIENTS", () => coefficients(head, fields)),
    sample: `precision highp float; uniform sampler2D layer; out vec4 result;
      void main() { vec2 v = textureLod(layer, gl_FragCoord.xy / 96.0, 0.0).rg; result = vec4(v, 0.0, 1.0); }`,
  };
}

/** The model's coefficients at a place: from maps, or the same everywhere */
function coefficients(head, fields) {
  return head.fields.slice(0, head.count).map((given, k) => {
    const slot = fields.findIndex((field) => field.name === given.name);
    return slot < 0 ? `p[${k}] = ${given.constant.toExponential(9)};` : `known = field(place, ${slot}, p[${k}]) && known;`;
  }).join("\n  ");
}

function texture(data, width, height, format, type) {
  const made = new THREE.DataTexture(data, width, height, format, type);
  return Object.assign(made, { unpackAlignment: 1, needsUpdate: true });
}

function range(values) {
  let low = Infinity, high = -Infinity;
  for (const v of values) {
    if (v < low) low = v;
    if (v > high) high = v;
  }
  return [low, high];
}

function spread(values, share) {
  const [low, high] = share ? percentiles(values, [share, 1 - share]) : range(values);
  return high > low ? [low, high] : [low - (Math.abs(low) * 0.01 || 0.5), low + (Math.abs(low) * 0.01 || 0.5)];
}
