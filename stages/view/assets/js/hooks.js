// The page's own numbers, for tests and for the curious: window.lunargr.

function makeHooks(app) {
  const set = (parts) => {
    if ("layer" in parts && typeof parts.layer === "string") parts = { ...parts, layer: app.relighter.layers.findIndex((l) => l.name === parts.layer) };
    app.change(parts);
    app.drawNow();
  };
  return {
    set,
    /** I/F of the whole map under a Sun; camera: [m, m, m] in the axes of the map's middle, or from straight above */
    pixels: ({ azimuth, elevation, shadows = true, camera = null }) => {
      app.relighter.setLight({ sun: sunVector(app.head, azimuth, elevation), shadows, camera: camera && new THREE.Vector3(...camera) });
      const image = app.relighter.image();
      app.drawn = null;
      app.ask();
      return image;
    },
    photograph: (k) => (app.photograph(k), app.drawNow()),
    pick: (x, y) => app.terrain.pick(x, y),
    values: (row, col) => app.rows(row, col),
    pose: () => app.terrain.pose(),
    frames: app.frames,
    /** Frames per second over some frames, the Sun (or else the camera) turning, each frame waited for */
    rate: (frames, turning = "sun", coarse = false) => {
      const start = performance.now();
      for (let k = 0; k < frames; k++) {
        if (turning === "sun") state.azimuth = (state.azimuth + 2) % 360;
        else app.terrain.cameras.space.position.x += 0.01;
        app.drawNow(coarse);
        app.terrain.wait();
      }
      return (1000 * frames) / (performance.now() - start);
    },
  };
}
