"""Camera views: one, or a trajectory of them."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np

from schemas.errors import GeometryError, LunargrError
from schemas.files.companions import companions_of
from schemas.files.locks import claim
from schemas.files.outputs import Output
from stages.common.arrays import Floats32
from stages.common.progress import Progress, show_nothing
from stages.physics.cameras.base import Camera
from stages.physics.cameras.pinhole import Pinhole
from stages.physics.terrain.shading import BACKPLANES
from stages.render.config import SUN, Config, Summary
from stages.render.dataset import EXPORT_PASSES, View, camera_facts, export_views, write_cameras
from stages.render.files import CAMERAS, finished, shard_of_views, view_files
from stages.render.perspective import no_ground
from stages.render.pictures import Preview, write_dn, write_exr, write_png
from stages.render.renderer import Renderer
from stages.render.setup import find_camera, metadata
from stages.render.tally import Tally
from stages.render.trajectory import ViewRow

EACH = 3  # work of rendering a view, in passes of its export


def render_trajectory(source: Path, table: Path, output: Output, config: Config, progress: Progress) -> list[Summary]:
    """See :func:`stages.render.run_trajectory`."""
    folder = output.file
    config = replace(config, view="pinhole")
    views = shard_of_views(table, config)
    outputs = {view.view_id: view_files(folder, view.view_id, config) for view in views}
    done = finished(outputs) if output.resume else set()
    results: list[Summary] = []
    total = (EACH + EXPORT_PASSES * len(config.export)) * len(views)
    with Renderer(source, config=config) as renderer:
        surface = renderer.surface
        for number, view in enumerate(views):
            progress(EACH * number, total, "views")
            if view.view_id in done:
                results.append(Summary(view.view_id, tuple(outputs[view.view_id]), config.size_px, skipped=True))
                continue
            view_config = _with_row(config, view)
            try:
                camera = find_camera(surface, view_config)
                files = outputs[view.view_id]
                with claim(files[0]), companions_of(files[0]):
                    results.append(render_camera(renderer, camera, files, view_config, view.view_id, show_nothing))
            except LunargrError as error:
                raise type(error)(f"{table.name}, {view.view_id}: {error}") from None
        rows = [_with_row(config, view) for view in views]
        cameras = [cast(Pinhole, find_camera(surface, row)) for row in rows]
        if config.shard[1] == 1 and not (output.resume and (folder / CAMERAS).exists()):
            suns = [renderer.sun(row) for row in rows]
            write_cameras(folder / CAMERAS, [v.view_id for v in views], cameras, suns, surface.grid)
        rendered = [View(v.view_id, c, outputs[v.view_id][0]) for v, c in zip(views, cameras, strict=True)]
        for number, kind in enumerate(config.export):
            before = (EACH + EXPORT_PASSES * number) * len(views)
            export_views(rendered, surface.grid, folder, kind, _counted_on(progress, before, total))
    progress(total, total, "views")
    return results


def _counted_on(progress: Progress, before: int, total: int) -> Callable[[int], None]:
    """Progress of an export, after ``before`` steps of the whole."""
    return lambda done: progress(before + done, total, "export")


def _with_row(config: Config, view: ViewRow) -> Config:
    """The configuration of one row: what the row leaves empty stays as it is; a row's Sun replaces the whole Sun."""
    view_config = replace(
        config,
        position=view.position,
        look_at=view.look_at if view.look_at is not None or view.quaternion is not None else config.look_at,
        quaternion=view.quaternion,
        roll_deg=view.roll_deg,
        fov_deg=view.fov_deg if view.fov_deg is not None else config.fov_deg,
    )
    if view.sun:
        view_config = replace(view_config, **{**dict.fromkeys(SUN), **view.sun})  # type: ignore[arg-type]
    return view_config


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
    parts: list[Floats32] = []  # of the image, where a sensor takes it as a whole
    errors = surface.knows_errors and ".exr" in named
    scene, bands = renderer.bands(camera, light, config.samples, errors)
    channels = ["image", *(["image_std"] if errors else []), *BACKPLANES]
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
                parts.append(band["image"])
            tally.add(band)
            ground |= bool(np.isfinite(band["depth"]).any())
            done += len(band["image"])
            progress(done, camera.lines, "lines")
        if not ground:
            raise GeometryError(no_ground(surface))
        write_png(named[".png"], preview.image())
    if renderer.sensor is not None:
        write_dn(named[".tif"], renderer.photograph(np.concatenate(parts), light, config.seed, view_id))
    summary = tally.summary(view_id, files, (camera.samples, camera.lines), scene.samples)
    return replace(summary, pixels_per_post=scene.pixels_per_post)
