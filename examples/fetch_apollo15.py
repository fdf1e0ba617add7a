"""Three Apollo 15 metric camera cubes and the elevation model below them: fetched once, checked, made ready for ingest.

python examples/fetch_apollo15.py results/apollo15_cubes/data

Cubes: USGS-Astrogeology/autocnet (public domain). Elevations: LROC WAC GLD100 (NASA/ASU) in tiles of jaanga/moon (MIT), each
pixel red + 256 green - 10000 m. Where LUNARGR_SHARED names a folder that holds both, nothing is fetched.
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import os
import sys
from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import from_origin

from schemas import InputError, LunargrError

SOURCE = "https://raw.githubusercontent.com"
CUBES = {
    "AS15-M-0297_crop.cub": "c602259617a35d8634edb61b21aac1478153a4850e03070a531f7c2227543a5b",
    "AS15-M-0298_crop.cub": "c67373a2076f77c67ff1e42693559002db171cd94a3c094e8f58cc2d42faac98",
    "AS15-M-0299_crop.cub": "51c8ece394d51ed9d5252ebf80ea57c3aeb1ba01003ae6dba6e67ea9d2f2960c",
}
CUBE = "USGS-Astrogeology/autocnet/136610b/autocnet/examples/Apollo15/{name}"
TILE = "jaanga/moon/d64475719d6c307710ac88d1453bd299327085d0/heightmaps/64p/{x}/64p-{x}-{y}.png"
TILE_PX, TILE_DEG = 256, 4
COLUMNS, ROWS = range(33, 39), range(26, 30)  # 132 .. 156 E, 14 .. 30 S
# of all elevations, int16 from north to south: the tiles' own digests are not known, what they decode to is
ELEVATION = "6946095475443c0993e9bd86bd066620f67c3b4209638881d30d80d6a438ae77"
MOON = "+proj=longlat +R=1737400 +no_defs"


def fetch(url: str, digest: str | None, folder: Path) -> Path:
    """A file of the public repositories, from the cache where it is there. Raises InputError when it cannot be fetched."""
    try:
        import pooch
    except ModuleNotFoundError:
        raise InputError("the data are fetched with 'pooch', which is not installed; run: pip install pooch") from None
    pooch.get_logger().setLevel("WARNING")
    try:
        name = url.rsplit("/", 1)[1]
        return Path(pooch.retrieve(url, known_hash=digest, fname=name, path=folder))
    except ValueError:
        raise InputError(
            f"{url}: expected a file of SHA-256 {digest}, found another; is the connection filtered?"
        ) from None
    except OSError as error:  # requests' errors are OSErrors
        raise InputError(
            f"{url}: cannot be fetched ({type(error).__name__}); without a network set LUNARGR_SHARED."
        ) from None


def fetch_elevations(source: str, cache: Path, target: Path) -> None:
    """Write the tiles' elevations as a GeoTIFF. Raises InputError where they are others than expected."""
    rows = []
    for y in ROWS:
        tiles = [fetch(f"{source}/{TILE.format(x=x, y=y)}", None, cache) for x in COLUMNS]
        pictures = []
        for tile in tiles:
            with rasterio.open(tile) as dataset:
                pictures.append(dataset.read([1, 2]).astype(np.int32))
        rows.append(np.concatenate([red + 256 * green - 10000 for red, green in pictures], axis=1))
    elevation = np.concatenate(rows).astype("<i2")
    if hashlib.sha256(elevation.tobytes()).hexdigest() != ELEVATION:
        raise InputError(
            f"{cache}: expected GLD100 tiles that decode to the elevations of {ELEVATION[:12]}, found others."
        )
    west, north = COLUMNS[0] * TILE_DEG, 90 - ROWS[0] * TILE_DEG
    place = from_origin(west, north, TILE_DEG / TILE_PX, TILE_DEG / TILE_PX)
    partial = target.with_suffix(".partial.tif")
    profile = {"driver": "GTiff", "dtype": "int16", "count": 1, "crs": MOON, "transform": place, "compress": "deflate"}
    with rasterio.open(partial, "w", height=elevation.shape[0], width=elevation.shape[1], **profile) as dataset:
        dataset.write(elevation, 1)
    partial.replace(target)


def make_ready(folder: Path, shared: Path | None, source: str = SOURCE) -> Path:
    """Write ``images.csv`` and ``dem.tif`` into the folder; returns the table. Raises InputError."""
    folder.mkdir(parents=True, exist_ok=True)
    cache, dem = folder / "cache", folder / "dem.tif"
    cubes = {name: shared / "data" / "apollo15_cubes" / name for name in CUBES} if shared else {}
    if not cubes or not all(path.is_file() for path in cubes.values()):
        cubes = {name: fetch(f"{source}/{CUBE.format(name=name)}", digest, cache) for name, digest in CUBES.items()}
    known = shared / "data" / "apollo15" / "gld100_64ppd.tif" if shared else None
    if known is not None and known.is_file():
        dem.unlink(missing_ok=True)
        dem.symlink_to(known.resolve())
    elif not dem.is_file():
        fetch_elevations(source, cache, dem)
    table = folder / "images.csv"
    with table.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["image_id", "path", "units"])
        writer.writerows(
            (name.split("_")[0], os.path.relpath(path, folder), "dn") for name, path in sorted(cubes.items())
        )
    return table


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    shared = os.environ.get("LUNARGR_SHARED")
    print(
        f"{make_ready(folder, Path(shared) if shared else None)}: three images and their cameras; {folder / 'dem.tif'}"
    )


if __name__ == "__main__":
    try:
        main()
    except LunargrError as error:
        print(error, file=sys.stderr)
        raise SystemExit(3) from None
