"""Write the pairs file that the judged program reads."""

from collections.abc import Mapping
from pathlib import Path

import h5py
import numpy as np

from .hidden import Hidden
from .light import direction, horizon_tangent
from .randomness import generator
from .simulate import Simulator
from .world import World

BODY_RADIUS_M = 1737400.0
LEVEL_M = -1250.0  # mean height of the scenes above the sphere
LONGITUDE_DEG = 20.0

UNITS = {
    "elevation": "m", "image": "1", "valid": "1", "sun_horizon_deg": "degree", "detector_sample": "px",
    "detector_line": "px", "sun_direction_enu": "1", "camera_position_enu": "m", "convergence_deg": "degree",
    "longitude_deg": "degree", "latitude_deg": "degree", "row": "1", "col": "1", "image_index": "1", "site": "1",
    "tile": "1", "split": "1", "solar_distance_au": "au",
}  # fmt: skip


def pair_arrays(simulator: Simulator, pair: int, hidden: Hidden) -> dict[str, np.ndarray | float]:
    """What a normal user would have of one pair."""
    world = simulator.world
    number, frame_number = world.pairs[pair]
    site, frame = world.sites[number], world.frames[frame_number]
    dem, crop = simulator.given_dems(hidden)[site.scene], simulator.crop_dem(pair, hidden)
    window = world.window(site, 0, 1)
    horizon = horizon_tangent(dem, window, 1.0, frame.sun_azimuth_deg, np.tan(np.radians(0.5)))
    line, sample = simulator.coordinates(pair, hidden)
    middle_row, middle_col = site.top + (world.size - 1) / 2, site.left + (world.size - 1) / 2
    camera = np.array([frame.camera.col - middle_col, middle_row - frame.camera.row, frame.camera.height - crop.mean()])
    degree_px = np.degrees(world.gsd_m / BODY_RADIUS_M)
    scale = np.cos(np.radians(world.latitude_deg))
    return {
        "elevation": (crop * world.gsd_m + LEVEL_M).astype("f4"),
        "image": simulator.map_image(pair, hidden, noisy=True).astype("f4"),
        "valid": np.ones(crop.shape, "u1"),
        "sun_horizon_deg": np.degrees(np.arctan(horizon)).astype("f4"),
        "detector_sample": sample.astype("f4"),
        "detector_line": line.astype("f4"),
        "sun_direction_enu": np.array(direction(frame.sun_azimuth_deg, frame.sun_elevation_deg)),
        "camera_position_enu": camera * world.gsd_m,
        "convergence_deg": 0.0,
        "longitude_deg": float(LONGITUDE_DEG + site.scene + middle_col * degree_px / scale),
        "latitude_deg": float(world.latitude_deg - middle_row * degree_px),
    }


def as_numbers(world: World, pair: int, image: np.ndarray, seed: int) -> np.ndarray:
    """An image in uncalibrated numbers: a gain and an offset of its own for each frame."""
    rng = generator(seed, "numbers", world.pairs[pair][1])
    return np.round(image * rng.uniform(2e4, 4e4) + rng.uniform(20, 120)).astype("f4")


def write_pairs(simulator: Simulator, hidden: Hidden, path: Path, units: str) -> None:
    """Write all pairs; units: "1" for I/F or "dn" for numbers with a free gain and offset per image."""
    world = simulator.world
    columns: dict[str, list] = {}
    for pair in range(len(world.pairs)):
        arrays = pair_arrays(simulator, pair, hidden)
        if units == "dn":
            arrays["image"] = as_numbers(world, pair, arrays["image"], hidden.seed)
        for name, value in arrays.items():
            columns.setdefault(name, []).append(value)
    data = {name: np.stack(values) for name, values in columns.items()}
    sites = [world.sites[number] for number, _ in world.pairs]
    data["row"] = np.array([site.top + world.size // 2 for site in sites], "i4")
    data["col"] = np.array([site.left + world.size // 2 for site in sites], "i4")
    data["site"] = np.array([number for number, _ in world.pairs], "i4")
    data["tile"] = data["site"]
    data["image_index"] = np.array([frame for _, frame in world.pairs], "i4")
    data["split"] = np.array([site.split for site in sites], "u1")
    data["solar_distance_au"] = np.ones(len(world.frames))
    part = path.with_name(path.name + ".part")
    with h5py.File(part, "w") as file:
        file.attrs.update(root_attributes(world))
        write_arrays(file, data, units)
        names = [f"frame-{number:03d}" for number in range(len(world.frames))]
        file.create_dataset("image_id", data=names, dtype=h5py.string_dtype())
    part.rename(path)


def root_attributes(world: World) -> dict[str, object]:
    """Attributes of the whole file."""
    return {"schema": "pairs", "version": 1, "gsd_m": world.gsd_m, "body_radius_m": BODY_RADIUS_M}


def write_arrays(file: h5py.File, data: Mapping[str, np.ndarray], units: str) -> None:
    """Datasets with their units."""
    for name, values in data.items():
        options = {"compression": "gzip", "compression_opts": 1, "shuffle": True} if values.ndim == 3 else {}
        dataset = file.create_dataset(name, data=values, **options)
        dataset.attrs["units"] = units if name == "image" else UNITS[name]
