// Maps out of the page's one block of data; see stages/view/packing.py.

const ONE = 4096;  // of weights

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
async function unpackMap(blob, packed, frames = []) {
  const [start, length] = packed.data, [height, width] = packed.shape;
  const left = readNumbers(await inflate(blob.subarray(start, start + length)), height * width, packed.share);
  const frame = addPrediction(left, height, width, packed, frames);
  frames.push(frame);
  for (let row = 0; row < height; row++) left.set(frame.subarray((row + 1) * (width + 2) + 1, (row + 1) * (width + 2) + 1 + width), row * width);
  return { codes: left, offset: packed.offset, step: packed.step, height, width };
}

/** Whole numbers of either sign, ``share`` to a byte, and after them what some are larger by, four bytes each, plane by plane */
function readNumbers(bytes, count, share) {
  const base = [256, 16, 6][share - 1], found = new Int32Array(count), first = Math.ceil(count / share), large = (bytes.length - first) / 4;
  for (let byte = 0, k = 0, more = first; byte < first; byte++) {
    for (let j = 0, rest = bytes[byte]; j < share && k < count; j++, k++) {
      const digit = rest % base;
      rest = (rest - digit) / base;
      found[k] = digit;
      if (digit < base - 1) continue;
      found[k] += bytes[more] | (bytes[more + large] << 8) | (bytes[more + 2 * large] << 16) | (bytes[more + 3 * large] << 24);
      more++;
    }
  }
  return found.map((v) => (v & 1 ? -((v + 1) >>> 1) : v >>> 1));
}

/** Codes within a frame: a row of zeros above, and a column before and after that go on with what is next to them */
function addPrediction(left, height, width, { helpers, weights }, frames) {
  const frame = new Int32Array((height + 1) * (width + 2)), sums = new Float64Array(width), [w, n, nw, ne] = weights;
  for (let row = 0; row < height; row++) {
    const above = row * (width + 2), here = above + width + 2;
    frame[here] = frame[above + 1];
    sums.fill(weights.at(-1) + ONE / 2);
    helpers.forEach((helper, k) => {
      const other = frames[helper], [at, west, north, northWest] = weights.slice(4 + 4 * k);
      for (let c = 0; c < width; c++) sums[c] += at * other[here + c + 1] + west * other[here + c] + north * other[above + c + 1] + northWest * other[above + c];
    });
    for (let c = 0; c < width; c++) {
      const sum = sums[c] + w * frame[here + c] + n * frame[above + c + 1] + nw * frame[above + c] + ne * frame[above + c + 2];
      frame[here + c + 1] = Math.floor(sum / ONE) + left[row * width + c];
    }
    frame[here + width + 1] = frame[here + width];
  }
  return frame;
}

/** Float32Array, NaN where not known */
async function unpackValues(blob, packed, known, frames) {
  const { codes, offset, step } = await unpackMap(blob, packed, frames);
  const values = new Float32Array(codes.length);
  for (let k = 0; k < codes.length; k++) values[k] = known[k] ? offset + step * codes[k] : NaN;
  return values;
}

/** Uint8Array, 1 = known */
async function unpackMask(blob, packed) {
  const { codes, offset } = await unpackMap(blob, packed);
  return Uint8Array.from(codes, (code) => code + offset);
}

/** Values of blocks of pixels -> of the map's pixels */
function spreadBlocks(values, { width, height, block }) {
  const across = Math.ceil(width / block), spread = new Float32Array(width * height);
  for (let row = 0, k = 0; row < height; row++) {
    const first = Math.floor(row / block) * across;
    for (let col = 0; col < width; col++, k++) spread[k] = values[first + Math.floor(col / block)];
  }
  return spread;
}

async function unpackPage(head) {
  const blob = await readBlob();
  const elevationKnown = await unpackMask(blob, head.elevation_known);
  const frames = [], elevation = await unpackValues(blob, head.elevation, elevationKnown, frames);
  const mapped = await unpackMask(blob, head.mapped);
  const fields = [];
  for (const [k, field] of head.fields.entries()) {
    if ("constant" in field) continue;
    const known = field.known ? await unpackMask(blob, field.known) : mapped;
    const coefficient = k < head.count, label = coefficient ? field.name : field.name.replaceAll("_", " ");
    const values = await unpackValues(blob, field.map, known, frames);
    fields.push({ ...field, coefficient, label, values: coefficient ? values : spreadBlocks(values, head) });
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
