"""Camera views: one, or a trajectory of them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from schemas.errors import ConfigError, GeometryError
from schemas.files.companions import companions_of
from schemas.files.locks import claim
from schemas.files.outputs import Output
from stages.common.arrays import Floats32
from stages.common.progress import Progress, show_nothing
from stages.physics.cameras.base import Camera
from stages.physics.terrain.shading import BACKPLANES
from stages.render.config import Config, Summary
from stages.render.dataset import EXPORT_PASSES, View, camera_facts, export_views, write_cameras
from stages.render.files import CAMERAS, finished, view_files
from stages.render.flight import find_flight, named_row
from stages.render.pictures import Preview, write_dn, write_exr, write_png
from stages.render.renderer import Renderer, joined
from stages.render.setup import metadata
from stages.render.sight import no_ground
from stages.render.tally import Tally

EACH = 3  # work of rendering a view, in passes of its export


def render_trajectory(source: Path, table: Path, output: Output, config: Config, progress: Progress) -> list[Summary]:
    """See :func:`stages.render.run_trajectory`."""
    folder = output.file
    config = replace(config, view="pinhole")
    index, count = config.shard
    results: list[Summary] = []
    with Renderer(source, config=config) as renderer:
        if config.export and renderer.sensor is not None and renderer.sensor.line_time_s:
            raise ConfigError(
                "`export`: expected a sensor without 'line_time_s'; data sets hold one pose for a picture."
            )
        flight = find_flight(renderer, config, table)
        frames = flight[index::count]
        outputs = {frame.view_id: view_files(folder, frame.view_id, config) for frame in frames}
        done = finished(outputs) if output.resume else set()
        total = (EACH + EXPORT_PASSES * len(config.export)) * len(frames)
        for number, (view_id, camera, view_config) in enumerate(frames):
            progress(EACH * number, total, "views")
            files = outputs[view_id]
            if view_id in done:
                results.append(Summary(view_id, tuple(files), (camera.samples, camera.lines), skipped=True))
                continue
            with named_row(table, view_id), claim(files[0]), companions_of(files[0]):
                results.append(render_camera(renderer, camera, files, view_config, view_id, show_nothing))
        cameras = [frame.camera for frame in frames]
        if count == 1 and not (output.resume and (folder / CAMERAS).exists()):
            suns = [renderer.sun(frame.config) for frame in frames]
            write_cameras(folder / CAMERAS, list(outputs), cameras, suns, renderer.surface.grid)
        rendered = [View(view_id, camera, outputs[view_id][0]) for view_id, camera, _ in frames]
        for number, kind in enumerate(config.export):
            before = (EACH + EXPORT_PASSES * number) * len(frames)
            export_views(rendered, renderer.surface.grid, folder, kind, _counted_on(progress, before, total))
    progress(total, total, "views")
    return results


def _counted_on(progress: Progress, before: int, total: int) -> Callable[[int], None]:
    """Progress of an export, after ``before`` steps of the whole."""
    return lambda done: progress(before + done, total, "export")


def render_camera(
    renderer: Renderer,
    camera: Camera,
    files: Sequence[Path],
    config: Config,
    view_id: str,
    progress: Progress,
) -> Summary:
    """One view, streamed to its files band by band."""
    surface, light = renderer.surface, renderer.light(config, camera)
    named = {path.suffix.lower(): path for path in files}
    parts: list[dict[str, Floats32]] = []  # where a sensor takes the image as a whole
    errors = surface.knows_errors and ".exr" in named and config.detail is None
    scene, bands = renderer.bands(camera, light, config.samples, errors)
    invented = [] if config.detail is None else ["invented"]
    channels = ["image", *(["image_std"] if errors else []), *BACKPLANES, *invented]
    preview, tally, done, ground = Preview(camera.lines, camera.samples, 8192), Tally(surface.image_units), 0, False
    with contextlib.ExitStack() as stack:
        exr = None
        if ".exr" in named:
            facts = metadata(surface, config, light) | camera_facts(camera)
            exr = stack.enter_context(write_exr(named[".exr"], camera.lines, camera.samples, channels, facts))
        for band in bands:
            if exr:
                exr.write(band)
            preview.add(band["image"])
            if renderer.sensor is not None:
                parts.append({name: band[name] for name in ("image", "exposed") if name in band})
            tally.add(band)
            ground |= bool(np.isfinite(band["depth"]).any())
            done += len(band["image"])
            progress(done, camera.lines, "lines")
        if not ground:
            raise GeometryError(no_ground(surface))
        write_png(named[".png"], preview.image())
    if renderer.sensor is not None:
        write_dn(named[".tif"], renderer.photograph(joined(parts), light, config.seed, view_id))
    summary = tally.summary(view_id, files, (camera.samples, camera.lines), scene.samples)
    return replace(summary, pixels_per_post=scene.pixels_per_post)
