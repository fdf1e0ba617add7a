// The map in space: a flat sheet seen from above, or the terrain as it stands, with the camera that looks at it.

const MESH_PX = 512;  // vertices along the longer side

class Terrain {
  constructor(renderer, head, page, relighter) {
    Object.assign(this, { renderer, head, page, relighter });
    this.ground = new Ground(head, page, relighter.base);
    this.step = Math.max(1, Math.ceil(Math.max(head.width, head.height) / MESH_PX));
    this.clearance = 3 * this.step * head.gsd;  // m of the camera above ground: more than the mesh smooths away
    this.scale = 2 / (Math.max(head.height, head.width) * head.gsd);  // scene units per m
    this.material = new THREE.RawShaderMaterial({
      glslVersion: THREE.GLSL3,
      vertexShader: head.shaders.draw_vertex,
      fragmentShader: head.shaders.draw,
      uniforms: {
        layer: { value: relighter.shown.texture },
        colours: { value: colourTable(head.colours) },
        colour_row: { value: -1 },
        limits: { value: new THREE.Vector2(0, 1) },
        outline: { value: [0, 0, 0, 0] },
        outline_colour: { value: new THREE.Vector3(1, 0.72, 0.2) },
        photograph: { value: texture(new Uint8Array(4), 1, 1, THREE.RGBAFormat, THREE.UnsignedByteType) },
        swipe: { value: 0 },
        picking: { value: false },
      },
      side: 2,
      transparent: true,
      premultipliedAlpha: true,
    });
    this.scenes = { map: scene(this.flat(), this.material), space: scene(this.relief(this.step), this.material) };
    this.coarse = { ...this.scenes, space: scene(this.relief(8 * this.step), this.material) };
    this.cameras = { map: new THREE.OrthographicCamera(-1, 1, 1, -1, -100, 100), space: new THREE.PerspectiveCamera(30, 1, (this.clearance * this.scale) / 4, 50) };
    this.controls = {};
    const element = renderer.domElement;
    for (const view of ["map", "space"]) {
      this.cameras[view].up.set(0, view === "map" ? 1 : 0, view === "map" ? 0 : 1);
      const controls = (this.controls[view] = new THREE.OrbitControls(this.cameras[view], element));
      Object.assign(controls, { enableDamping: false, enabled: false, zoomToCursor: true, screenSpacePanning: view === "map" });
    }
    this.controls.map.enableRotate = false;
    this.controls.map.mouseButtons = { LEFT: 2, MIDDLE: 1, RIGHT: 2 };
    this.controls.map.touches = { ONE: 1, TWO: 2 };
    this.controls.space.maxPolarAngle = Math.PI / 2 - 0.02;
    this.controls.space.minDistance = 4 * this.clearance * this.scale;
    this.controls.space.maxDistance = 12;
    this.controls.space.addEventListener("start", () => this.aim());
    this.controls.map.minZoom = 0.5;
    this.controls.map.maxZoom = Math.max(head.height, head.width) / 8;
    this.share = 0.5;  // of a photograph that lies over the rendering
    this.pixel = target(1, 1, THREE.RGBAFormat, THREE.FloatType, { depthBuffer: true });
    this.reset("map");
    this.reset("space");
    this.setView("map");
  }

  setView(view) {
    this.view = view;
    for (const [name, controls] of Object.entries(this.controls)) controls.enabled = name === view;
  }

  reset(view = this.view) {
    const camera = this.cameras[view], controls = this.controls[view];
    if (view === "map") {
      camera.position.set(0, 0, 10);
      camera.zoom = 1;
      controls.target.set(0, 0, 0);
    } else {
      const floor = this.middleHeight * this.scale;
      controls.target.set(0, 0, floor);
      camera.position.set(0.5, -3.1, floor + 2.1);
    }
    camera.updateProjectionMatrix();
    controls.update();
  }

  /** What the camera looks at stays on the map, and the camera above ground. */
  keep() {
    const camera = this.cameras[this.view], { target } = this.controls[this.view], { head, ground } = this;
    const x = head.width / Math.max(head.width, head.height), y = head.height / Math.max(head.width, head.height), before = target.clone();
    target.clamp(new THREE.Vector3(-x, -y, -Infinity), new THREE.Vector3(x, y, Infinity));
    camera.position.add(target).sub(before);
    if (this.view === "map") return;
    const place = this.cameraPlace(), { row, col } = ground.place(place), lowest = ground.point(row, col, ground.height(row, col) + this.clearance);
    const up = place.clone().setZ(place.z + head.radius), missing = lowest.setZ(lowest.z + head.radius).length() - up.length();
    if (missing > 0) camera.position.addScaledVector(up.normalize(), missing * this.scale);
    camera.lookAt(target);
  }

  /** The camera turns about, and comes near to, the ground in the middle of the picture. */
  aim() {
    const { target } = this.controls.space, place = this.cameraPlace(), direction = target.clone().divideScalar(this.scale).sub(place);
    const found = this.ground.hit(place, direction, 2 * direction.length());
    if (found) target.copy(found.multiplyScalar(this.scale));
  }

  /** The camera as a few numbers in m: what it looks at and its zoom, or where it stands and what it looks at */
  pose() {
    const camera = this.cameras[this.view], { target } = this.controls[this.view], metres = (v) => v.toArray().map((c) => c / this.scale);
    return this.view === "map" ? [...metres(target).slice(0, 2), camera.zoom] : [...metres(camera.position), ...metres(target)];
  }

  /** Take up what pose() gave in this view. */
  setPose(numbers) {
    const camera = this.cameras[this.view], controls = this.controls[this.view], n = numbers.map((v) => v * this.scale);
    if (this.view === "map") {
      controls.target.set(n[0], n[1], 0);
      camera.position.set(n[0], n[1], 10);
      camera.zoom = numbers[2];
    } else {
      camera.position.set(...n.slice(0, 3));
      controls.target.set(...n.slice(3));
    }
    camera.updateProjectionMatrix();
    controls.update();
    this.keep();
  }

  /** {row, col} -> [x, y] in CSS pixels of the canvas, or null behind the camera */
  screen({ row, col }) {
    const { clientWidth, clientHeight } = this.renderer.domElement, { x, y, z } = this.inScene(row, col).project(this.cameras[this.view]);
    return z < 1 ? [((x + 1) / 2) * clientWidth, ((1 - y) / 2) * clientHeight] : null;
  }

  /** Of the view that is shown */
  inScene(row, col) {
    const { head } = this, side = Math.max(head.height, head.width);
    if (this.view === "space") return this.ground.point(row, col).multiplyScalar(this.scale);
    return new THREE.Vector3(((col + 0.5 - head.width / 2) * 2) / side, ((head.height / 2 - row - 0.5) * 2) / side, 0);
  }

  /** Bring a place into the middle of the picture. */
  goTo({ row, col }) {
    const { target } = this.controls[this.view], there = this.inScene(row, col);
    this.cameras[this.view].position.add(there).sub(target);
    target.copy(there);
    this.controls[this.view].update();
    this.keep();
  }

  /** Look at a window of the map from above. */
  frame(row, col, height, width) {
    const { head } = this, side = Math.max(head.height, head.width), camera = this.cameras.map;
    const x = ((col + width / 2 - head.width / 2) * 2) / side, y = ((head.height / 2 - row - height / 2) * 2) / side;
    camera.position.set(x, y, 10);
    camera.zoom = (0.7 * side) / Math.max(height, width);
    camera.updateProjectionMatrix();
    this.controls.map.target.set(x, y, 0);
    this.controls.map.update();
  }

  resize(width, height) {
    const { map, space } = this.cameras, aspect = width / height;
    const reach = 1.04 * Math.max(this.head.width / Math.max(this.head.width, this.head.height) / aspect, this.head.height / Math.max(this.head.width, this.head.height));
    Object.assign(map, { left: -reach * aspect, right: reach * aspect, top: reach, bottom: -reach });
    space.aspect = aspect;
    space.fov = aspect < 1 ? 30 / Math.max(aspect, 0.5) : 30;
    map.updateProjectionMatrix();
    space.updateProjectionMatrix();
  }

  /** Where the camera of the view in space stands, m, in the axes of the map's middle */
  cameraPlace() {
    return this.cameras.space.position.clone().divideScalar(this.scale);
  }

  /** Scene units per pixel of the screen; in space, at what the camera looks at */
  unitsPerPixel() {
    const { map: camera, space } = this.cameras, away = space.position.distanceTo(this.controls.space.target);
    if (this.view === "space") return (2 * away * Math.tan((space.fov * Math.PI) / 360)) / this.renderer.domElement.clientHeight;
    return (camera.right - camera.left) / camera.zoom / this.renderer.domElement.clientWidth;
  }

  /** layer: the texture that shows it; coarse: with fewer facets; measurable: a photograph may lie over it */
  draw(layer, span, colours, limits, coarse, measurable) {
    const { uniforms } = this.material, names = Object.keys(this.head.colours);
    uniforms.colour_row.value = colours ? (names.indexOf(colours) + 0.5) / names.length : -1;
    uniforms.limits.value.set((limits[0] - span[0]) / (span[1] - span[0]), (limits[1] - span[0]) / (span[1] - span[0]));
    uniforms.layer.value = layer;
    uniforms.swipe.value = this.overlay && measurable ? this.share : 0;
    uniforms.picking.value = false;
    this.renderer.render((coarse ? this.coarse : this.scenes)[this.view], this.cameras[this.view]);
  }

  /** Until what was asked for is drawn */
  wait() {
    const context = this.renderer.getContext();
    context.readPixels(0, 0, 1, 1, context.RGBA, context.UNSIGNED_BYTE, new Uint8Array(4));
  }

  setOutline(photograph) {
    const { width, height } = this.head, p = photograph;
    const box = p ? [p.col / width, p.row / height, (p.col + p.width) / width, (p.row + p.height) / height] : [0, 0, 0, 0];
    this.material.uniforms.outline.value = box;
  }

  /** A measured crop, in the image's unit, to be drawn over the left part of its outline; or null */
  setPhotograph(photograph) {
    const { uniforms } = this.material;
    if (this.overlay) this.overlay.dispose();
    this.overlay = null;
    if (!photograph) return;
    const { values, width, height } = photograph, half = THREE.DataUtils.toHalfFloat, data = new Uint16Array(2 * values.length);
    values.forEach((v, k) => Number.isNaN(v) || data.set([half(v), half(1)], 2 * k));
    this.overlay = texture(data, width, height, THREE.RGFormat, THREE.HalfFloatType);
    Object.assign(this.overlay, { magFilter: THREE.LinearFilter, minFilter: THREE.LinearMipmapLinearFilter, generateMipmaps: true });
    uniforms.photograph.value = this.overlay;
  }

  /** {row, col} under a place of the canvas (CSS pixels), or null */
  pick(x, y) {
    const canvas = this.renderer.domElement, camera = this.cameras[this.view];
    camera.setViewOffset(canvas.clientWidth, canvas.clientHeight, x, y, 1, 1);
    this.material.uniforms.picking.value = true;
    this.renderer.setRenderTarget(this.pixel);
    this.renderer.render(this.scenes[this.view], camera);
    this.renderer.setRenderTarget(null);
    camera.clearViewOffset();
    this.material.uniforms.picking.value = false;
    const found = new Float32Array(4);
    this.renderer.readRenderTargetPixels(this.pixel, 0, 0, 1, 1, found);
    if (found[2] < 0.5) return null;
    const row = Math.floor(found[1] * this.head.height), col = Math.floor(found[0] * this.head.width);
    const inside = row >= 0 && col >= 0 && row < this.head.height && col < this.head.width;
    return inside ? { row, col } : null;
  }

  flat() {
    const { width, height } = this.head, side = Math.max(width, height);
    const geometry = new THREE.PlaneGeometry((2 * width) / side, (2 * height) / side), uv = geometry.getAttribute("uv");
    for (let k = 0; k < uv.count; k++) uv.setY(k, 1 - uv.getY(k));
    return geometry;
  }

  /** The terrain as a mesh in the axes of the map's middle, body curvature included; holes stay open. */
  relief(step) {
    const { page, relighter, ground } = this, { width, height } = this.head;
    const columns = lattice(width, step), rows = lattice(height, step), count = columns.length * rows.length;
    const positions = new Float32Array(3 * count), uvs = new Float32Array(2 * count), known = new Uint8Array(count);
    this.middleHeight = relighter.base;
    for (let j = 0, k = 0; j < rows.length; j++) {
      for (let i = 0; i < columns.length; i++, k++) {
        const z = meanAround(page.elevation, width, height, rows[j], columns[i], step);
        known[k] = Number.isFinite(z) ? 1 : 0;
        ground.point(rows[j], columns[i], known[k] ? z : relighter.base).multiplyScalar(this.scale).toArray(positions, 3 * k);
        uvs[2 * k] = (columns[i] + 0.5) / width;
        uvs[2 * k + 1] = (rows[j] + 0.5) / height;
      }
    }
    const faces = [];
    for (let j = 0; j + 1 < rows.length; j++) {
      for (let i = 0; i + 1 < columns.length; i++) {
        const a = j * columns.length + i, b = a + 1, c = a + columns.length, d = c + 1;
        if (known[a] && known[b] && known[c] && known[d]) faces.push(a, c, b, b, c, d);
      }
    }
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
    geometry.setAttribute("uv", new THREE.BufferAttribute(uvs, 2));
    geometry.setIndex(new THREE.BufferAttribute(Uint32Array.from(faces), 1));
    return geometry;
  }
}

function scene(geometry, material) {
  const made = new THREE.Scene(), mesh = new THREE.Mesh(geometry, material);
  mesh.frustumCulled = false;
  made.add(mesh);
  return made;
}

function lattice(length, step) {
  const places = [];
  for (let k = 0; k < length - 1; k += step) places.push(k);
  return [...places, length - 1];
}

function meanAround(values, width, height, row, col, step) {
  const reach = step >> 1;
  let sum = 0, count = 0;
  for (let r = Math.max(0, row - reach); r <= Math.min(height - 1, row + reach); r++) {
    for (let c = Math.max(0, col - reach); c <= Math.min(width - 1, col + reach); c++) {
      const v = values[r * width + c];
      if (v === v) {
        sum += v;
        count++;
      }
    }
  }
  return count ? sum / count : NaN;
}

function colourTable(colours) {
  const tables = Object.values(colours).map((text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)));
  const data = new Uint8Array(256 * 4 * tables.length);
  tables.forEach((table, row) => {
    for (let k = 0; k < 256; k++) data.set([table[3 * k], table[3 * k + 1], table[3 * k + 2], 255], 4 * (256 * row + k));
  });
  const made = texture(data, 256, tables.length, THREE.RGBAFormat, THREE.UnsignedByteType);
  return Object.assign(made, { magFilter: THREE.LinearFilter, minFilter: THREE.LinearFilter });
}
