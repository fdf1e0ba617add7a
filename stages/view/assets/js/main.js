// The page's state, what changes it, and the one loop that draws it.

const SLOW_MS = 100, STILL_MS = 250;

const state = { azimuth: 0, elevation: 0, shadows: true, layer: 0, view: "map", auto: true, limits: [0, 1], photograph: null };

/** The Sun's direction in the axes of the map's middle */
function sunVector(head, azimuth, elevation) {
  const a = ((azimuth + head.convergence_deg) * Math.PI) / 180, e = (elevation * Math.PI) / 180;
  return new THREE.Vector3(Math.sin(a) * Math.cos(e), Math.cos(a) * Math.cos(e), Math.sin(e));
}

function makeRenderer() {
  const canvas = byId("canvas"), context = canvas.getContext("webgl2", { antialias: true, alpha: true, premultipliedAlpha: true });
  if (!context) return null;
  if (!context.getExtension("EXT_color_buffer_float")) return null;
  const renderer = new THREE.WebGLRenderer({ canvas, context, antialias: true, alpha: true });
  renderer.outputColorSpace = "srgb-linear";  // the page's shaders write display values
  renderer.setClearColor(0x000000, 0);
  renderer.debug.onShaderError = (gl, program, vertex, fragment) => {
    throw new Error(`the graphics driver refuses a shader: ${gl.getShaderInfoLog(fragment) || gl.getProgramInfoLog(program)}`);
  };
  return renderer;
}

async function main() {
  const head = JSON.parse(byId("head").textContent), renderer = makeRenderer();
  if (!renderer || typeof DecompressionStream === "undefined") {
    window.lunargr = { able: false };
    return;
  }
  document.body.classList.add("able");
  await new Promise((resolve) => setTimeout(resolve, 20));  // let the message show
  const page = await unpackPage(head), relighter = new Relighter(renderer, head, page);
  Object.assign(state, head.start);
  const terrain = new Terrain(renderer, head, page, relighter), app = new App(head, page, relighter, terrain);
  document.body.classList.add("ready");
  app.resize();
  relighter.setLight(app.light());
  relighter.read(0, 0, 1, 1);  // shaders are made now: how long a picture takes is measured next
  app.drawNow();
  window.lunargr = { able: true, state, head, ...makeHooks(app) };
  document.documentElement.dataset.lunargr = "ready";
}

class App {
  constructor(head, page, relighter, terrain) {
    Object.assign(this, { head, page, relighter, terrain, state, dirty: false, playing: false, frames: { whole: 0, coarse: 0 } });
    this.canvas = terrain.renderer.domElement;
    this.panel = new Panel(head, relighter.layers, this);
    this.overlay = new Overlay(head, page, terrain);
    this.photographs = new Photographs(head, page, relighter, terrain, this);
    for (const controls of Object.values(terrain.controls)) {
      controls.addEventListener("change", () => (terrain.keep(), this.ask()));
      controls.addEventListener("end", () => this.sayInAddress());
    }
    window.addEventListener("resize", () => this.resize());
    for (const kind of ["pointerdown", "pointerup", "pointercancel"]) window.addEventListener(kind, (event) => (this.pressed = event.buttons > 0), true);
    window.addEventListener("hashchange", () => this.open());
    this.wirePointer();
    this.panel.values(this.rows());
    this.open();
  }

  /** What the address says */
  open() {
    const { photograph = null, pose, azimuth, elevation, ...parts } = readAddress(this.relighter.layers, this.page.photographs.length);
    const sun = Object.entries({ azimuth, elevation }).filter(([, value]) => value !== undefined);
    if (photograph !== null) this.photograph(photograph, false);  // with its own Sun
    else this.letGo(), Object.assign(state, Object.fromEntries(sun));
    this.change({ auto: true, ...parts }, false);
    if (pose) this.terrain.setPose(pose);
  }

  /** Change parts of the state and draw. */
  change(parts, say = true) {
    if ("layer" in parts && parts.layer !== state.layer && !parts.limits) state.auto = true;
    Object.assign(state, parts);
    this.terrain.setView(state.view);
    this.panel.refresh(state);
    this.ask();
    if (say) this.sayInAddress();
  }

  sun(azimuth, elevation) {
    const parts = { photograph: null };
    if (azimuth !== null && Number.isFinite(azimuth)) parts.azimuth = ((azimuth % 360) + 360) % 360;
    if (elevation !== null && Number.isFinite(elevation)) parts.elevation = Math.min(90, Math.max(0.1, elevation));
    this.letGo();
    this.change(parts);
  }

  photograph(k, say = true) {
    this.stop();
    if (k === null) return this.letGo(), this.change({ photograph: null });
    const p = this.page.photographs[k];
    this.terrain.setOutline(p);
    this.terrain.frame(p.row, p.col, p.height, p.width);
    this.change({ photograph: k, azimuth: p.azimuth, elevation: p.elevation, view: "map", layer: 0 }, say);
  }

  /** The photograph's Sun or camera no longer hold */
  letGo() {
    if (state.photograph === null) return;
    state.photograph = null;
    this.terrain.setOutline(null);
    this.photographs.refresh(null);
  }

  reset() {
    this.terrain.reset();
    this.change({});
  }

  showGrid(shown) {
    this.overlay.showGrid(shown);
    this.overlay.draw();
  }

  /** Whether a click or tap takes up an end of what is measured */
  measuring(on) {
    this.measures = on;
    Object.assign(this.overlay, { ends: [] });
    byId("profile").hidden = true;
    this.overlay.draw();
  }

  /** Whether the map holds this place, which is then in the middle */
  goTo(lon, lat) {
    const place = this.terrain.ground.placeOf(lon, lat);
    if (!this.terrain.ground.holds(place)) return false;
    this.overlay.mark = place;
    this.terrain.goTo(place);
    this.change({});
    return true;
  }

  play() {
    if (this.playing) return this.stop();
    this.playing = true;
    byId("play").setAttribute("aria-pressed", "true");
    byId("play").textContent = "❚❚ Stop";
    let before = performance.now();
    const turn = (now) => {
      if (!this.playing) return;
      this.sun(state.azimuth + (now - before) * 0.03, null);
      before = now;
      requestAnimationFrame(turn);
    };
    requestAnimationFrame(turn);
  }

  stop() {
    this.playing = false;
    byId("play").setAttribute("aria-pressed", "false");
    byId("play").textContent = "▶ Let it turn";
  }

  save() {
    this.drawNow();
    this.canvas.toBlob((blob) => {
      const link = document.createElement("a"), layer = this.relighter.layers[state.layer].name;
      link.href = URL.createObjectURL(blob);
      link.download = `${this.head.title}_${layer}_sun_${state.azimuth.toFixed(1)}_${state.elevation.toFixed(1)}.png`;
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 10000);
    });
  }

  async copyLink(button) {
    this.sayNow();
    const before = button.textContent;
    try {
      await navigator.clipboard.writeText(location.href);
      button.textContent = "Copied";
    } catch {
      button.textContent = "See the address bar";
    }
    setTimeout(() => (button.textContent = before), 1500);
  }

  sayInAddress() {
    clearTimeout(this.saying);
    this.saying = setTimeout(() => this.sayNow(), 200);
  }

  sayNow() {
    clearTimeout(this.saying);
    writeAddress(state, this.relighter.layers, this.terrain.pose());
  }

  /** Draw soon. Where a picture takes long, a coarse one comes first, and the whole one once nothing moves. */
  ask() {
    if (this.dirty) return;
    this.dirty = true;
    requestAnimationFrame(() => this.drawNow(this.slow && this.key() !== this.drawn));
  }

  refineSoon() {
    this.finer = setTimeout(() => (this.pressed ? this.refineSoon() : this.drawNow()), STILL_MS);
  }

  /** The light as the state says; where the light goes to follows the view */
  light() {
    const camera = state.photograph !== null ? this.photographs.camera(state.photograph) : state.view === "space" ? this.terrain.cameraPlace() : null;
    return { sun: sunVector(this.head, state.azimuth, state.elevation), shadows: state.shadows, camera };
  }

  /** All that the map's pixels hang on; else only its place on the screen changes */
  key() {
    const { sun, shadows, camera } = this.light(), moves = this.relighter.layers[state.layer].camera;
    return JSON.stringify([sun, shadows, state.layer, moves && camera]);
  }

  drawNow(coarse = false) {
    this.dirty = false;
    clearTimeout(this.finer);
    if (coarse) this.refineSoon();
    const { terrain } = this, relighter = coarse ? (this.coarse ??= new Relighter(terrain.renderer, ...coarseMap(this.head, this.page), true)) : this.relighter;
    const layer = this.relighter.layers[state.layer], span = this.span(layer), key = this.key(), start = performance.now();
    relighter.setLight(this.light());
    if (key !== this.drawn) {
      relighter.show(state.layer, span);
      this.found = relighter.contrast(state.layer, span);
      this.frames[coarse ? "coarse" : "whole"]++;
    }
    if (state.auto) state.limits = this.found;
    terrain.draw(relighter.shown.texture, span, layer.colours, state.limits, coarse, state.layer === 0);
    if (coarse) this.drawn = null;
    else if (key !== this.drawn) {
      this.drawn = key;
      terrain.wait();
      this.slow = performance.now() - start > SLOW_MS && Math.max(this.head.width, this.head.height) > 2 * COARSE_PX;
    }
    this.panel.contrast(state.limits, layer.colours);
    this.panel.scaleBar(terrain.unitsPerPixel(), state.view === "space");
    this.overlay.draw();
    this.panel.needle(state.view === "space" ? terrain.controls.space.getAzimuthalAngle() : 0);
    if (coarse) return;
    const compared = `${state.photograph} ${state.shadows}`;
    if (compared !== this.compared) {
      this.compared = compared;
      this.photographs.refresh(state.photograph);
      this.ask();  // the photograph now lies over the map
    }
    if (this.pointer) this.readPointer();
  }

  /** Values that half floats keep best as 0 and 1 */
  span(layer) {
    if (layer.name === "elevation" && !layer.map) return spread(this.page.elevation, 0);
    if (layer.map) return spread(layer.values, 0.005);
    return [0, layer.unit === "deg" ? 90 : 1];
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = byId("stage");
    this.terrain.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.terrain.renderer.setSize(width, height, false);
    this.terrain.resize(width, height);
    this.ask();
  }

  wirePointer() {
    const canvas = this.canvas, place = (event) => {
      const box = canvas.getBoundingClientRect();
      return { x: event.clientX - box.left, y: event.clientY - box.top };
    };
    let grabbed = null, pressedAt = null;
    canvas.addEventListener("pointerdown", (event) => {
      if (!event.shiftKey) return;
      grabbed = { ...place(event), azimuth: state.azimuth, elevation: state.elevation };
      canvas.setPointerCapture(event.pointerId);
      event.stopImmediatePropagation();
    }, { capture: true });
    canvas.addEventListener("pointermove", (event) => {
      this.pointer = place(event);
      if (grabbed && event.buttons) this.sun(grabbed.azimuth + (this.pointer.x - grabbed.x) * 0.4, grabbed.elevation - (this.pointer.y - grabbed.y) * 0.2);
      else if (!event.buttons) this.readSoon();
    });
    canvas.addEventListener("pointerdown", (event) => (pressedAt = place(event)));
    canvas.addEventListener("pointerup", (event) => {
      grabbed = null;
      this.pointer = place(event);
      const still = pressedAt && Math.hypot(this.pointer.x - pressedAt.x, this.pointer.y - pressedAt.y) < 5;
      const found = this.measures && still && this.terrain.pick(this.pointer.x, this.pointer.y);
      if (found) this.overlay.measure(found), this.overlay.draw();
      this.readSoon();
    });
    canvas.addEventListener("pointerleave", (event) => {
      if (event.pointerType !== "mouse") return;  // a tap's values stay
      this.pointer = null;
      this.panel.values(this.rows());
    });
  }

  readSoon() {
    if (this.reading) return;
    this.reading = true;
    requestAnimationFrame(() => {
      this.reading = false;
      if (this.pointer) this.readPointer();
    });
  }

  readPointer() {
    if (this.drawn === null) return;  // a coarse picture holds no values
    const found = this.terrain.pick(this.pointer.x, this.pointer.y);
    this.panel.values(found ? this.rows(found.row, found.col) : this.rows());
  }

  rows(row, col) {
    const found = pixelRows(this.head, this.page, this.relighter, this.terrain.ground, row, col), measured = this.photographs.at(row, col);
    return measured > -Infinity ? [...found, ["Measured", short(measured)]] : found;
  }
}

main().catch((error) => {
  document.body.classList.remove("able", "ready");
  byId("why").textContent = `This page could not relight the map here (${error.message}). Below is one still picture of it.`;
  window.lunargr = { able: false, error: String(error) };
  throw error;
});
