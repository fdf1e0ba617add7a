"""normalized.h5, block by block, and what it says of itself."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from schemas import ArtefactWriter
from stages.common.brightness import QUANTITIES
from stages.normalize.config import Config, Summary
from stages.normalize.levels import MIDDLES, Levels
from stages.normalize.mosaic import Layer
from stages.physics.images.references import References
from stages.physics.images.table import Frame
from stages.physics.maps.geotiff import MOSAIC_BANDS
from stages.physics.maps.window import Box
from stages.physics.terrain.surface import Surface

if TYPE_CHECKING:
    from stages.normalize.stage import Block


def attributes_of(surface: Surface, config: Config, units: str) -> dict[str, Any]:
    """Root attributes of a normalized.h5."""
    incidence, emission, phase = config.standard_deg
    geometry = {"incidence_deg": incidence, "emission_deg": emission, "phase_deg": phase}
    place = {"gsd_m": surface.grid.gsd, "body_radius_m": surface.grid.radius}
    told = {"model": surface.model.name, "quantity": f"{QUANTITIES[units]}; at the standard geometry"}
    return place | told | geometry | {"image_units": units}


class Maps:
    """Takes blocks of a map. rows : those of a shard, None for the whole map"""

    def __init__(self, writer: ArtefactWriter, rows: tuple[int, int] | None) -> None:
        self._writer = writer
        self._images = {name: writer.dataset(name) for name in ("normalized", "normalized_std", "mask")}
        self._mosaics = [writer.dataset(name) for name in MOSAIC_BANDS]
        self._seen, self._sum, self._shown = 0, 0.0, 0
        if rows is not None:
            writer.file.attrs["shard_rows"] = np.array(rows, np.int64)

    @staticmethod
    def sizes(references: References, layers: int) -> dict[str, int]:
        """Of the dimensions."""
        grid, frames = references.surface.grid, len(references.frames)
        return {"frame": frames, "layer": layers, "incidence_bin": len(MIDDLES), "y": grid.height, "x": grid.width}

    def put(self, box: Box, block: Block) -> None:
        """Write one block."""
        part = np.s_[box[0] : box[0] + box[2], box[1] : box[1] + box[3]]
        shown: dict[str, NDArray] = {"normalized": block.normal, "normalized_std": block.std, "mask": block.mask}
        for name, values in shown.items():
            for k, plane in zip(block.images, values, strict=True):
                self._images[name][(k, *part)] = plane
        for layer, mosaic in enumerate(block.mosaics):
            maps = (mosaic.value, mosaic.std, mosaic.scatter, mosaic.count)
            for target, plane in zip(self._mosaics, maps, strict=True):
                target[(layer, *part)] = plane
        first = block.mosaics[0]
        known = first.count > 0
        self._seen += int(known.sum())
        self._sum += float(first.value[known].sum(dtype=float))
        self._shown += int(first.count.sum(dtype=int))

    def close(self, references: References, levels: Levels, layers: Sequence[Layer]) -> None:
        """Write what is known of the map and the images."""
        writer, grid, frames = self._writer, references.surface.grid, references.frames
        writer.write_crs(grid.crs_wkt, grid.transform)
        writer.write("x", grid.xy(0, np.arange(grid.width))[0])
        writer.write("y", grid.xy(np.arange(grid.height), 0)[1])
        writer.write("image_id", [frame.image_id for frame in frames])
        writer.write("solar_distance_au", np.array([frame.solar_distance_au for frame in frames]))
        writer.write("wavelength_nm", np.array([frame.wavelength_nm for frame in frames]))
        writer.write("gain", levels.gain)
        writer.write("offset", levels.offset)
        writer.write("image_std", levels.std)
        writer.write("bin_cos_incidence", MIDDLES)
        writer.write("layer_name", [layer.name for layer in layers])
        writer.write("phase_low_deg", np.array([layer.low for layer in layers]))
        writer.write("phase_high_deg", np.array([layer.high for layer in layers]))

    def summarise(
        self, frames: Sequence[Frame], levels: Levels, units: str, angles: dict[str, tuple[float, float]]
    ) -> Summary:
        """What was written, for the lines at the end."""
        height, width = self._mosaics[0].shape[-2:]
        std = np.array([np.nanmedian(row) if np.isfinite(row).any() else np.nan for row in levels.std])
        names = [frame.image_id for frame in frames]
        images = tuple(zip(names, levels.gain.tolist(), levels.offset.tolist(), std.tolist(), strict=True))
        return Summary(
            images, self._seen / (height * width), self._sum / max(1, self._seen), self._shown / max(1, self._seen),
            levels.before, levels.after, units, angles,
        )  # fmt: skip
