// Controls and read-outs beside the map.

const byId = (id) => document.getElementById(id);

class Panel {
  /** act: {sun(azimuth, elevation), layer(k), view(name), change(part), ...} as main.js has it */
  constructor(head, layers, act) {
    Object.assign(this, { head, layers, act });
    this.wireSun();
    this.wireLayers();
    for (const button of document.querySelectorAll("[data-view]")) button.onclick = () => act.change({ view: button.dataset.view });
    byId("shadows").onchange = (event) => act.change({ shadows: event.target.checked });
    byId("play").onclick = () => act.play();
    byId("reset").onclick = () => act.reset();
    byId("save").onclick = () => act.save();
    byId("link").onclick = () => act.copyLink(byId("link"));
    byId("grid").onchange = (event) => act.showGrid(event.target.checked);
    byId("measure").onchange = (event) => act.measuring(event.target.checked);
    byId("go").onchange = (event) => this.go(event.target);
    byId("auto").onchange = (event) => act.change({ auto: event.target.checked });
    for (const id of ["black", "white"]) byId(id).onchange = () => this.typedContrast();
    const means = head.factor > 1 ? `, each the mean of ${head.factor} × ${head.factor} of the file's` : "";
    byId("about").textContent = `${head.width} × ${head.height} pixels of ${short(head.gsd)} m${means}. Radiance factor (${head.brightness}), with cos(incidence) in it; negative values are shown as 0. Coefficients are kept to 1/${2 * head.levels} of their range, which leaves I/F to ${short(100 * head.error)} % (RMS); other maps are means of ${head.block} × ${head.block} pixels. Made by ${document.querySelector("meta[name=generator]").content}.`;
    window.addEventListener("keydown", (event) => this.key(event));
  }

  wireSun() {
    const dial = byId("dial"), { act } = this;
    const drag = (event) => {
      const box = dial.getBoundingClientRect(), x = ((event.clientX - box.left) / box.width) * 120 - 60, y = ((event.clientY - box.top) / box.height) * 120 - 60;
      act.sun((Math.atan2(x, -y) * 180) / Math.PI, 90 - (90 * Math.min(50, Math.hypot(x, y))) / 50);
    };
    dial.onpointerdown = (event) => {
      dial.setPointerCapture(event.pointerId);
      drag(event);
    };
    dial.onpointermove = (event) => event.buttons && drag(event);
    // what was typed goes to the nearest that there is, or back
    for (const id of ["azimuth", "elevation"]) byId(id).onchange = () => setValue(id, act.state[id], true);
    for (const id of ["azimuth", "azimuth-slider"]) byId(id).oninput = (event) => event.target.value !== "" && act.sun(Number(event.target.value), null);
    for (const id of ["elevation", "elevation-slider"]) byId(id).oninput = (event) => event.target.value !== "" && act.sun(null, Number(event.target.value));
  }

  typedContrast() {
    const { act } = this, limits = ["black", "white"].map((id) => (byId(id).value === "" ? NaN : Number(byId(id).value)));
    if (limits[0] < limits[1]) return act.change({ auto: false, limits });
    this.contrast(act.state.limits, this.layers[act.state.layer].colours, true);
  }

  /** To what was typed: longitude, latitude */
  go(field) {
    const [lon, lat, more] = field.value.split(",").map((text) => (text.trim() === "" ? NaN : Number(text))), right = more === undefined && Math.abs(lat) <= 90;
    field.setCustomValidity(right && this.act.goTo(lon, lat) ? "" : "Give a longitude and a latitude on this map, in degrees: 20.5, -4.2");
    field.reportValidity();
  }

  wireLayers() {
    const same = this.head.fields.filter((field) => "constant" in field).map((field) => `${field.name} ${short(field.constant)}`);
    byId("constants").textContent = same.length ? `The same everywhere: ${same.join(", ")}.` : "";
    this.layers.forEach((layer, k) => {
      const button = document.createElement("button");
      Object.assign(button, { type: "button", textContent: layer.label, title: layer.title });
      button.setAttribute("role", "radio");
      button.onclick = () => this.act.change({ layer: k });
      byId("layers").append(button);
    });
  }

  key(event) {
    if (event.target.matches("input, select, textarea") || event.ctrlKey || event.metaKey || event.altKey) return;
    const { act } = this, step = event.shiftKey ? 10 : 1, { azimuth, elevation } = act.state;
    const turns = {
      ArrowLeft: () => act.sun(azimuth - step, null),
      ArrowRight: () => act.sun(azimuth + step, null),
      ArrowUp: () => act.sun(null, elevation + step),
      ArrowDown: () => act.sun(null, elevation - step),
      m: () => act.change({ view: act.state.view === "map" ? "space" : "map" }),
      c: () => act.change({ shadows: !act.state.shadows }),
      r: () => act.reset(),
      s: () => act.save(),
      " ": () => act.play(),
    };
    const number = Number(event.key);
    if (number >= 1 && number <= this.layers.length) act.change({ layer: number - 1 });
    else if (turns[event.key]) {
      if (event.key === " " && event.target.matches("button")) return;
      turns[event.key]();
      event.preventDefault();
    }
  }

  /** Everything that shows the state */
  refresh(state) {
    const { azimuth, elevation } = state, r = (50 * (90 - elevation)) / 90, a = (azimuth * Math.PI) / 180;
    const x = r * Math.sin(a), y = -r * Math.cos(a);
    byId("sun").setAttribute("transform", `translate(${x} ${y})`);
    for (const [key, value] of Object.entries({ x1: 0, y1: 0, x2: x, y2: y })) byId("ray").setAttribute(key, value);
    setValue("azimuth", azimuth);
    setValue("azimuth-slider", azimuth);
    setValue("elevation", elevation);
    setValue("elevation-slider", elevation);
    byId("shadows").checked = state.shadows;
    byId("auto").checked = state.auto;
    const layer = this.layers[state.layer];
    [...byId("layers").children].forEach((button, k) => button.setAttribute("aria-checked", k === state.layer));
    for (const button of document.querySelectorAll("[data-view]")) button.setAttribute("aria-checked", button.dataset.view === state.view);
    byId("layer-title").textContent = layer.label;
    byId("layer-unit").textContent = layer.unit === "1" ? "" : layer.unit;
    byId("layer-text").textContent = layer.map ? layer.title : "";
    byId("view-text").textContent = state.photograph !== null ? "Light that goes to the photograph's camera." : state.view === "map" ? "Light that goes straight up from every pixel." : "Light that goes to this camera. Drag to turn it, scroll to come near.";
    document.body.classList.toggle("in-space", state.view === "space");
  }

  /** turned: how far the camera has gone round the map, rad */
  needle(turned) {
    byId("needle").setAttribute("transform", `rotate(${this.head.convergence_deg + (turned * 180) / Math.PI})`);
  }

  /** typed: put back what the fields hold, also while they are written in */
  contrast(limits, colours, typed = false) {
    const span = limits[1] - limits[0]; // three digits of the range: below that nobody sees a difference
    const digits = (v) => (span > 1e-9 ? Number(v.toFixed(Math.max(0, 2 - Math.floor(Math.log10(span))))) : Number(v.toPrecision(3))).toString();
    [byId("low").textContent, byId("high").textContent] = limits.map(digits);
    for (const [id, value] of [["black", limits[0]], ["white", limits[1]]]) if (typed || document.activeElement !== byId(id)) byId(id).value = digits(value);
    if (this.barColours === (colours ?? "grey")) return;
    this.barColours = colours ?? "grey";
    const context = byId("colour-bar").querySelector("canvas").getContext("2d"), pixels = context.createImageData(256, 1);
    const table = colours ? Uint8Array.from(atob(this.head.colours[colours]), (c) => c.charCodeAt(0)) : null;
    for (let k = 0; k < 256; k++) {
      const grey = 255 * (k / 255) ** (1 / 2.2);
      pixels.data.set(table ? [...table.subarray(3 * k, 3 * k + 3), 255] : [grey, grey, grey, 255], 4 * k);
    }
    context.putImageData(pixels, 0, 0);
  }

  /** unitsPerPixel: of the map, whose longer side is 2 */
  scaleBar(unitsPerPixel, inSpace) {
    const across = (unitsPerPixel * this.head.gsd * Math.max(this.head.width, this.head.height)) / 2, length = roundBelow(130 * across);
    const bar = byId("scale-bar");
    bar.querySelector("i").style.width = `${length / across}px`;
    bar.querySelector("span").textContent = metres(length) + (inSpace ? " in the middle" : "");
  }

  values(rows) {
    const list = byId("values");
    list.replaceChildren(
      ...rows.flatMap(([name, value]) => {
        const term = document.createElement("dt"), text = document.createElement("dd");
        Object.assign(term, { textContent: name, title: name });
        text.textContent = value;
        return [term, text];
      }),
    );
  }
}

function setValue(id, value, typed = false) {
  if (typed || document.activeElement !== byId(id) || byId(id).type === "range") byId(id).value = Math.round(value * 100) / 100;
}

const short = (value) => (value !== 0 && Math.abs(value) < 1e-3 ? value.toExponential(2) : Number(value.toPrecision(4)).toString());

/** Rows for the read-out of a pixel; of none, or where nothing is known, dashes */
function pixelRows(head, page, relighter, ground, row, col) {
  const here = row !== undefined, k = row * head.width + col, [lon, lat] = here ? ground.lonLat(row, col) : [];
  const known = here && Number.isFinite(page.elevation[k]), say = (when, text) => (when ? text() : "–");
  const [image, incidence, emission, phase] = known ? relighter.read(row, col, 1, 1) : [], [sunlight, slope] = known ? relighter.read(row, col, 1, 1, 2) : [];
  const degrees = (v) => say(known, () => `${v.toFixed(1)}°`);
  return [
    ["Longitude", say(here, () => `${lon.toFixed(5)}° E`)],
    ["Latitude", say(here, () => `${Math.abs(lat).toFixed(5)}° ${lat < 0 ? "S" : "N"}`)],
    ["Height", say(known, () => `${page.elevation[k].toFixed(1)} m`)],
    [head.brightness, say(image >= 0, () => image.toFixed(5))],
    ["Incidence", degrees(incidence)],
    ["Emission", degrees(emission)],
    ["Phase", degrees(phase)],
    ["Slope", degrees(slope)],
    ["Sunlight", say(known, () => `${(100 * sunlight).toFixed(0)} %`)],
    ...page.fields.map((f) => [f.label, say(here && Number.isFinite(f.values[k]), () => short(f.values[k]))]),
  ];
}
