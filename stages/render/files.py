"""The files that render reads and writes, and its results as JSON."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from schemas.errors import ConfigError
from schemas.files.locks import claim
from schemas.files.outputs import Target
from stages.common.runner import Call
from stages.render.config import Config, Summary

CAMERAS = "cameras.json"  # of a trajectory
DN = "_dn.tif"  # ends the name of a sensor's image
MANIFEST = "manifest.json"  # of stereo pairs


def inputs(source: Path, config: Config) -> list[Path]:
    """What an image is made from."""
    return [source, *_given(config)]


def input_files(call: Call) -> list[Path]:
    """The files that no output may replace."""
    return [*call.files, *_given(call.config)]


def _given(config: Config) -> list[Path]:
    """The files that a configuration names."""
    from stages.physics.detector import sensor_file

    sensor = None if config.sensor is None else sensor_file(config.sensor)
    return [Path(p) for p in (config.camera, config.extend, sensor) if p]


def output_files(output: Path, config: Config) -> list[Path]:
    """The files behind one `output`. Raises ConfigError."""
    files = _picture_files(output, config.view)
    return files if config.sensor is None else [*files, output.with_name(f"{output.stem}{DN}")]


def _picture_files(output: Path, view: str) -> list[Path]:
    suffix = output.suffix.lower()
    png, tif = output.with_suffix(".png"), output.with_suffix(".tif")
    if suffix in (".exr", ""):
        exr = output.with_suffix(".exr")
        return [exr, png, tif] if view == "ortho" else [exr, png]
    if suffix in (".tif", ".tiff"):
        if view != "ortho":
            raise ConfigError(f"{output}: a pinhole view has no map grid for a GeoTIFF; name a .exr or .png file.")
        return [output, png]
    if suffix == ".png":
        return [output]
    raise ConfigError(f"{output}: expected a name that ends in .exr, .tif or .png; choose another `output`.")


def main_file(call: Call) -> Path:
    """The file of a view that becomes whole last."""
    return output_files(call.output.file, call.config)[0]


def view_targets(call: Call) -> list[Target]:
    """The files of one view."""
    path = call.output.file
    files = output_files(path, call.config)
    return [Target(p, name="the output" if p == path else f"{p.suffix} beside {path.name}") for p in files]


def view_files(folder: Path, view_id: str, config: Config) -> list[Path]:
    """The files of one view of a trajectory."""
    return output_files(folder / f"{view_id}{'.png' if config.png_only else '.exr'}", replace(config, view="pinhole"))


SIDES = ("left", "right")  # of stereo


def shard_of_views(table: Path, config: Config) -> list[str]:
    """The names of a shard's views: every n-th of those of all rows."""
    from stages.render.trajectory import read_trajectory

    index, count = config.shard
    names = [row.view_id for row in read_trajectory(table)]
    if config.rig is not None:
        names = [f"{name}_{side}" for name in names for side in SIDES]
    return names[index::count]


def finished(outputs: Mapping[str, Sequence[Path]]) -> set[str]:
    """The views whose files are all there."""
    return {name for name, files in outputs.items() if all(path.exists() for path in files)}


def trajectory_targets(call: Call) -> list[Target]:
    """The files of the views that are still to be rendered, and of the data set that is exported."""
    folder, config = call.output.file, call.config
    outputs = {name: view_files(folder, name, config) for name in shard_of_views(call.arguments["table"], config)}
    done = finished(outputs) if call.output.resume else set()
    new = [files for name, files in outputs.items() if name not in done]
    new += [export_files(list(outputs), folder, kind) for kind in config.export]
    if config.shard[1] == 1 and not call.output.resume:
        new.append([folder / CAMERAS])
    for files in new:
        if any(path.exists() for path in files):
            with claim(files[0]):  # tidies up where a killed run left some of them
                pass
    return [Target(path) for files in new for path in files]


def export_files(view_ids: Sequence[str], folder: Path, kind: str) -> list[Path]:
    """The files of the data set ``kind``; the first is written last, and the others belong to it."""
    images = [f"images/{name}.png" for name in view_ids]
    if kind == "colmap":
        rest = [f"sparse/0/{name}.txt" for name in ("cameras", "images", "points3D")]
    else:
        rest = [*(f"depths/{name}.npy" for name in view_ids), "transforms.json"]
    return [folder / kind / name for name in ("world.json", *images, *rest)]


def manifest(call: Call) -> Path:
    """The list of stereo pairs, which becomes whole last."""
    return call.output.file / MANIFEST


def pair_names(count: int) -> list[str]:
    """Of stereo pairs."""
    return [f"pair_{number:05d}" for number in range(count)]


def pair_files(folder: Path, name: str, config: Config) -> list[Path]:
    """Of the left view, of the right one, and the correspondences."""
    views = [path for side in SIDES for path in view_files(folder, f"{name}_{side}", config)]
    return [*views, folder / f"{name}_matches.exr"]


def stereo_targets(call: Call) -> list[Target]:
    """The files of all stereo pairs."""
    folder, names = call.output.file, pair_names(call.arguments["stereo"].count)
    return [
        Target(path) for path in (manifest(call), *(p for name in names for p in pair_files(folder, name, call.config)))
    ]


def as_json(results: Sequence[Summary]) -> dict[str, Any]:
    """What was rendered, for the JSON file."""

    def finite(value: float) -> float | None:
        return value if math.isfinite(value) else None

    views = [
        {
            "view_id": r.view_id,
            "files": [str(p) for p in r.files],
            "size_px": list(r.size_px),
            "known_share": finite(r.known_share),
            "mean_iof": finite(r.mean),
            "shadow_share": finite(r.shadow_share),
            "incidence_deg": [finite(v) for v in r.incidence_deg],
            "samples": r.samples,
            "skipped": r.skipped,
            "clipped_px": r.clipped,
            "pixels_per_post": finite(r.pixels_per_post),
            "image_units": r.image_units,
        }
        for r in results
    ]
    return {"views": views}
