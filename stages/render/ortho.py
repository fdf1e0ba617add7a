"""Ortho views: bands of a map from the top down, however large it is."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from schemas.errors import GeometryError
from schemas.files.outputs import atomic_path
from schemas.rasters import TIFF_TAG
from stages.common.progress import Progress
from stages.physics.maps.geotiff import MapTiff
from stages.physics.terrain.shading import BACKPLANES, Light, shade_block
from stages.physics.terrain.surface import Surface
from stages.render.config import Config, Summary
from stages.render.pictures import Preview, write_exr, write_png
from stages.render.setup import metadata
from stages.render.tally import Tally

BAND_ROWS = 256
BAND_PX = 1 << 20  # of a wide map fewer rows at a time: memory does not follow its width
BAND_COLUMNS = 1024
UNITS = {"image": "1", "image_std": "1", "shadow": "1", "sky_view": "1", "depth": "m", "elevation": "m"}


def render_map(
    surface: Surface,
    light: Light,
    relief: tuple[float, float],
    files: Sequence[Path],
    config: Config,
    progress: Progress,
) -> Summary:
    """The whole map, streamed to its files band by band."""
    grid = surface.grid
    images = ["image", "image_std"] if surface.knows_errors else ["image"]
    channels = [*images, *BACKPLANES, "elevation", *(["sky_view"] if light.bounce is not None else [])]
    bands = channels if config.backplanes_in_tif else ["image"]
    named = {path.suffix.lower(): path for path in files}
    wanted = channels if ".exr" in named else list(dict.fromkeys([*bands, "shadow", "incidence_deg"]))
    wanted = [*wanted, "clipped"]
    preview, tally = Preview(grid.height, grid.width), Tally(surface.image_units)
    facts = metadata(surface, config, light)
    with contextlib.ExitStack() as stack:
        exr = tif = None
        if ".exr" in named:
            exr = stack.enter_context(write_exr(named[".exr"], grid.height, grid.width, channels, facts))
        for suffix in (".tif", ".tiff"):
            if suffix in named:
                units = [UNITS.get(b, "degree") for b in bands]
                tags = {TIFF_TAG if k == "record" else k: v for k, v in facts.items()}
                partial = stack.enter_context(atomic_path(named[suffix]))
                tif = stack.enter_context(MapTiff(partial, grid, bands, tags, units))
        rows = max(32, min(BAND_ROWS, BAND_PX // grid.width // 16 * 16))  # EXR packs 16 rows together
        for row in range(0, grid.height, rows):
            progress(row, grid.height, "rows")
            height = min(rows, grid.height - row)
            band = {c: np.empty((height, grid.width), np.float32) for c in wanted}
            for col in range(0, grid.width, BAND_COLUMNS):
                block = shade_block(surface, light, row, col, height, min(BAND_COLUMNS, grid.width - col))
                if light.camera_position is None:
                    block["depth"] = relief[1] - block["elevation"]  # from a plane of sight through the highest point
                for name in wanted:
                    band[name][:, col : col + BAND_COLUMNS] = block[name]
            if exr:
                exr.write(band)
            if tif:
                tif.put(row, 0, np.stack([band[b] for b in bands]))
            preview.add(band["image"])
            tally.add(band)
        if tally.known == 0:
            raise GeometryError(
                f"{surface.path}: expected valid coefficients and elevations, found none; nothing to render."
            )
        write_png(named[".png"], preview.image())
    progress(grid.height, grid.height, "rows")
    return tally.summary(files[0].stem, files, (grid.width, grid.height), 1)
