// The page's state in its address: #azimuth=270&elevation=12&layer=slope&view=space&shadows=0&photograph=1&contrast=0,0.2&camera=...

const POSE = { map: 3, space: 6 };  // numbers of Terrain.pose()

function readAddress(layers, photographs) {
  const given = new URLSearchParams(location.hash.slice(1)), parts = {};
  const numbers = (name) => given.get(name).split(",").map((text) => (text.trim() === "" ? NaN : Number(text)));
  const read = (name, count, take) => {
    const values = given.has(name) ? numbers(name) : [];
    if (values.length === count && values.every(Number.isFinite)) take(values);
  };
  read("azimuth", 1, ([v]) => v >= -360 && v <= 360 && (parts.azimuth = v));
  read("elevation", 1, ([v]) => v >= 0.1 && v <= 90 && (parts.elevation = v));
  read("photograph", 1, ([v]) => Number.isInteger(v) && v >= 1 && v <= photographs && (parts.photograph = v - 1));
  read("contrast", 2, (limits) => limits[0] < limits[1] && Object.assign(parts, { auto: false, limits }));
  const layer = layers.findIndex(({ name }) => name === given.get("layer"));
  if (layer >= 0) parts.layer = layer;
  if (given.get("view") in POSE) parts.view = given.get("view");
  if (given.has("shadows")) parts.shadows = given.get("shadows") !== "0";
  read("camera", POSE[parts.view ?? "map"], (pose) => (parts.pose = pose));
  return parts;
}

function writeAddress({ azimuth, elevation, layer, view, shadows, auto, limits, photograph }, layers, pose) {
  const parts = { azimuth: azimuth.toFixed(2), elevation: elevation.toFixed(2), layer: layers[layer].name, view, shadows: shadows ? 1 : 0 };
  const join = (numbers) => numbers.map((v) => Number(v.toPrecision(6))).join(",");
  if (photograph !== null) parts.photograph = photograph + 1;
  if (!auto) parts.contrast = join(limits);
  parts.camera = join(pose);
  try {
    history.replaceState(null, "", `#${new URLSearchParams(parts).toString().replaceAll("%2C", ",")}`);
  } catch {
    // some browsers do not let a page from a file change its address
  }
}
