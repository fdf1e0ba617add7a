// Measured photographs beside the same ground under the same Sun, seen from the same camera.

class Photographs {
  constructor(head, page, relighter, terrain, act) {
    Object.assign(this, { head, page, relighter, terrain });
    if (!page.photographs.length) return;
    byId("photographs").hidden = false;
    page.photographs.forEach((p, k) => {
      const option = new Option(`${p.title} · Sun ${p.azimuth.toFixed(0)}°, ${p.elevation.toFixed(0)}° high`, String(k));
      byId("photograph").append(option);
    });
    byId("swipe").oninput = (event) => ((terrain.share = Number(event.target.value)), act.ask());
    byId("photograph").onchange = (event) => act.photograph(event.target.value === "" ? null : Number(event.target.value));
  }

  camera(k) {
    return new THREE.Vector3(...this.page.photographs[k].camera);
  }

  /** Lay the measured crop over the map, draw what the page misses, and say how alike they are. */
  refresh(k) {
    if (!this.page.photographs.length) return;
    byId("photograph").value = k === null ? "" : String(k);
    document.querySelector(".pair").hidden = k === null;
    byId("photograph-text").textContent = "";
    this.measured = null;
    if (k === null) return this.terrain.setPhotograph(null);
    const p = this.page.photographs[k], rendered = this.relighter.image(p.row, p.col, p.height, p.width), gain = p.unit === "dn" ? gainOf(p.values, rendered) : 1;
    this.measured = { ...p, values: p.values.map((v) => v * gain) };
    this.terrain.setPhotograph(this.measured);
    const found = compare(this.measured.values, rendered), residual = rendered.map((v, at) => this.measured.values[at] - v), unit = this.head.brightness;
    const most = Math.max(...percentiles(residual, [0.01, 0.99]).map(Math.abs)) || 1;
    drawSigned(byId("residual"), residual, p, most);
    byId("residual-text").textContent = `measured less rendered: blue −${short(most)}, red +${short(most)} ${unit}`;
    byId("photograph-text").textContent =
      `Means ${found.means.map((v) => v.toPrecision(3)).join(" (measured" + (gain === 1 ? "" : `, DN times ${gain.toPrecision(3)}`) + ") and ")} (rendered); ` +
      `correlation ${found.correlation.toFixed(3)}, RMS residual ${found.rms.toPrecision(3)} ${unit}. The rendering has the photograph's Sun and camera.`;
  }

  /** What was measured at a pixel of the map, or undefined */
  at(row, col) {
    const p = this.measured, r = row - p?.row, c = col - p?.col;
    return p && r >= 0 && c >= 0 && r < p.height && c < p.width ? p.values[r * p.width + c] : undefined;
  }
}

/** The factor that brings measured values nearest to rendered ones */
function gainOf(measured, rendered) {
  let both = 0, own = 0;
  measured.forEach((v, k) => {
    if (Number.isNaN(v + rendered[k])) return;
    both += v * rendered[k];
    own += v * v;
  });
  return both / own;
}

function compare(measured, rendered) {
  let n = 0, m = 0, r = 0, mm = 0, rr = 0, mr = 0;
  for (let k = 0; k < measured.length; k++) {
    const a = measured[k], b = rendered[k];
    if (Number.isNaN(a) || Number.isNaN(b)) continue;
    n++;
    m += a;
    r += b;
    mm += a * a;
    rr += b * b;
    mr += a * b;
  }
  const covariance = mr / n - (m / n) * (r / n), deviations = Math.sqrt((mm / n - (m / n) ** 2) * (rr / n - (r / n) ** 2));
  return { means: [m / n, r / n], correlation: covariance / deviations, rms: Math.sqrt(Math.max(0, (mm - 2 * mr + rr) / n)) };
}

/** Blue below 0, white at 0, red above; ``most``: where the colours end */
function drawSigned(canvas, values, { height, width }, most) {
  Object.assign(canvas, { width, height });
  const context = canvas.getContext("2d"), pixels = context.createImageData(width, height);
  values.forEach((v, k) => {
    const t = Math.min(1, Math.abs(v) / most), end = v < 0 ? [33, 102, 172] : [178, 24, 43];
    pixels.data.set([...end.map((c) => 247 + t * (c - 247)), Number.isNaN(v) ? 0 : 255], 4 * k);
  });
  context.putImageData(pixels, 0, 0);
}
