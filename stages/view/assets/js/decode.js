// Maps out of the page's one block of data; see stages/view/packing.py.

async function readBlob() {
  const text = document.getElementById("blob").textContent.trim();
  if (Uint8Array.fromBase64) return Uint8Array.fromBase64(text);
  const binary = atob(text), bytes = new Uint8Array(binary.length);
  for (let k = 0; k < binary.length; k++) bytes[k] = binary.charCodeAt(k);
  return bytes;
}

async function inflate(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** {codes: Int32Array, offset, step, height, width}; value = offset + step x code */
async function unpackMap(blob, packed) {
  const [start, length] = packed.place, [height, width] = packed.shape, pixels = height * width;
  const planes = await inflate(blob.subarray(start, start + length));
  const codes = new Int32Array(pixels);
  for (let plane = 0; plane < packed.planes; plane++) {
    const from = plane * pixels, shift = 8 * plane;
    for (let k = 0; k < pixels; k++) codes[k] |= planes[from + k] << shift;
  }
  for (let k = 0; k < pixels; k++) codes[k] = codes[k] & 1 ? -((codes[k] + 1) >>> 1) : codes[k] >>> 1;
  if (packed.order === 2) for (let k = width; k < pixels; k++) codes[k] += codes[k - width];
  for (let row = 0; row < height; row++) {
    for (let k = row * width + 1; k < (row + 1) * width; k++) codes[k] += codes[k - 1];
  }
  return { codes, offset: packed.offset, step: packed.step, height, width };
}

/** Float32Array, NaN where not known */
async function unpackValues(blob, packed, known) {
  const { codes, offset, step } = await unpackMap(blob, packed);
  const values = new Float32Array(codes.length);
  for (let k = 0; k < codes.length; k++) values[k] = known && !known[k] ? NaN : offset + step * codes[k];
  return values;
}

/** Uint8Array, 1 = known */
async function unpackMask(blob, packed) {
  const { codes, offset, step } = await unpackMap(blob, packed);
  return Uint8Array.from(codes, (code) => (offset + step * code > 0.5 ? 1 : 0));
}

async function unpackPage(head) {
  const blob = await readBlob();
  const elevationKnown = await unpackMask(blob, head.elevation_known);
  const elevation = await unpackValues(blob, head.elevation, elevationKnown);
  const mapped = await unpackMask(blob, head.mapped);
  const fields = [];
  for (const [k, field] of head.fields.entries()) {
    if ("constant" in field) continue;
    const known = field.known ? await unpackMask(blob, field.known) : mapped;
    const coefficient = k < head.count, label = coefficient ? field.name : field.name.replaceAll("_", " ");
    fields.push({ ...field, coefficient, label, values: await unpackValues(blob, field.map, known) });
  }
  const photographs = [];
  for (const photograph of head.photographs) {
    const values = await unpackValues(blob, photograph.map, await unpackMask(blob, photograph.known));
    photographs.push({ ...photograph, values, height: photograph.map.shape[0], width: photograph.map.shape[1] });
  }
  document.getElementById("blob").remove();
  return { elevation, mapped, fields, photographs };
}

/** The given shares (0..1) of a sample of the finite values */
function percentiles(values, shares) {
  const every = Math.max(1, Math.floor(values.length / 40000)), sample = [];
  for (let k = 0; k < values.length; k += every) if (Number.isFinite(values[k])) sample.push(values[k]);
  sample.sort((a, b) => a - b);
  return shares.map((share) => (sample.length ? sample[Math.round(share * (sample.length - 1))] : 0));
}
