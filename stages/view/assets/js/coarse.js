// The same map with fewer pixels: what is drawn while something moves, where the page's own map takes too long.

const COARSE_PX = 192;  // along the longer side

function coarseMap(head, page) {
  const share = Math.min(1, COARSE_PX / Math.max(head.width, head.height)), [height, width] = [head.height, head.width].map((n) => Math.max(2, Math.round(n * share)));
  const down = head.height / height, across = head.width / width, mean = (values) => blockMeans(values, head, height, width);
  const pixel_size = head.pixel_size.map((size, k) => size * (k % 2 ? across : down));
  const fields = page.fields.map((field) => ({ ...field, values: mean(field.values) }));
  const mapped = Uint8Array.from(mean(page.mapped), (part) => (part >= 0.5 ? 1 : 0));
  return [{ ...head, height, width, pixel_size, gsd: head.gsd * across }, { ...page, elevation: mean(page.elevation), mapped, fields }];
}

/** Means of what is known in height x width blocks, NaN where nothing is */
function blockMeans(values, from, height, width) {
  const sums = new Float64Array(height * width), counts = new Uint32Array(height * width);
  for (let row = 0, k = 0; row < from.height; row++) {
    const first = Math.floor((row * height) / from.height) * width;
    for (let col = 0; col < from.width; col++, k++) {
      const value = values[k], block = first + Math.floor((col * width) / from.width);
      if (value === value) {
        sums[block] += value;
        counts[block]++;
      }
    }
  }
  return Float32Array.from(sums, (sum, k) => sum / counts[k]);
}
