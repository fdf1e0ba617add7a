// Measured photographs beside the same ground under the same Sun, seen from the same camera.

class Photographs {
  constructor(head, page, relighter, act) {
    Object.assign(this, { head, page, relighter });
    if (!page.photographs.length) return;
    byId("photographs").hidden = false;
    page.photographs.forEach((p, k) => {
      const option = new Option(`${p.title} · Sun ${p.azimuth.toFixed(0)}°, ${p.elevation.toFixed(0)}° high`, String(k));
      byId("photograph").append(option);
    });
    byId("photograph").onchange = (event) => act.photograph(event.target.value === "" ? null : Number(event.target.value));
  }

  camera(k) {
    return new THREE.Vector3(...this.page.photographs[k].camera);
  }

  /** Draw the measured crop and the page's own, stretched alike */
  refresh(k) {
    if (!this.page.photographs.length) return;
    byId("photograph").value = k === null ? "" : String(k);
    document.querySelector(".pair").hidden = k === null;
    byId("photograph-text").textContent = "";
    if (k === null) return;
    const p = this.page.photographs[k], rendered = this.relighter.image(p.row, p.col, p.height, p.width);
    const found = compare(p.values, rendered), gain = p.unit === "dn" ? found.gain : 1;
    const measured = p.values.map((v) => v * gain), white = percentiles(measured, [0.995])[0] * 1.05 || 1;
    drawGrey(byId("measured"), measured, p, white);
    drawGrey(byId("rendered"), rendered, p, white);
    const unit = p.unit === "dn" ? `DN, times ${gain.toPrecision(3)} here` : "I/F", own = this.relighter.head.brightness;
    byId("photograph-text").textContent =
      `Means ${found.means.map((v) => v.toPrecision(3)).join(" (measured, " + unit + ") and ")} (page); correlation ${found.correlation.toFixed(3)}, RMS difference ${found.rms.toPrecision(3)} ${own}. ` +
      "Both have the same black and white; the page has the photograph's Sun and camera.";
  }
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
  const gain = mr / mm;
  return { means: [m / n, r / n], gain, correlation: covariance / deviations, rms: Math.sqrt(Math.max(0, (mm - 2 * mr + rr) / n)) };
}

function drawGrey(canvas, values, { height, width }, white) {
  Object.assign(canvas, { width, height });
  const context = canvas.getContext("2d"), pixels = context.createImageData(width, height);
  values.forEach((v, k) => {
    const grey = 255 * Math.min(1, Math.max(0, v / white)) ** (1 / 2.2);
    pixels.data.set([grey, grey, grey, Number.isNaN(v) ? 0 : 255], 4 * k);
  });
  context.putImageData(pixels, 0, 0);
}
