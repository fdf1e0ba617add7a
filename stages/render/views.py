"""Camera views: one, or a trajectory of them."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Sequence
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
from stages.physics.bodies.spheres import find_body
from stages.physics.cameras.base import Camera
from stages.physics.cameras.pinhole import Pinhole
from stages.physics.maps.grid import Grid
from stages.physics.terrain.shading import BACKPLANES, Light
from stages.physics.terrain.surface import Surface
from stages.render.config import SUN, Config, Summary
from stages.render.dataset import EXPORT_PASSES, View, export_views
from stages.render.files import finished, shard_of_views, view_files
from stages.render.perspective import apply_sensor, make_scene, render_view
from stages.render.pictures import Preview, write_exr, write_png
from stages.render.setup import camera_place, find_camera, make_light, metadata, open_source
from stages.render.tally import Tally
from stages.render.trajectory import ViewRow

EACH = 3  # work of rendering a view, in passes of its export


def render_trajectory(source: Path, table: Path, output: Output, config: Config, progress: Progress) -> list[Summary]:
    """See :func:`stages.render.run_trajectory`."""
    folder = output.file
    config = replace(config, view="pinhole")
    body = find_body("moon" if config.body is None else config.body)
    views = shard_of_views(table, config)
    outputs = {view.view_id: view_files(folder, view.view_id, config) for view in views}
    done = finished(outputs) if output.resume else set()
    results: list[Summary] = []
    total = EACH * len(views) + (0 if config.export is None else EXPORT_PASSES * len(views))
    with open_source(source, config, body) as surface:
        relief = surface.height_range()
        lights: dict[str, Light] = {}  # a Sun that stays serves many views with one horizon
        for number, view in enumerate(views):
            progress(EACH * number, total, "views")
            if view.view_id in done:
                results.append(Summary(view.view_id, tuple(outputs[view.view_id]), config.size_px, skipped=True))
                continue
            view_config = _with_row(config, view)
            key = repr([getattr(view_config, k) for k in SUN])
            try:
                if key not in lights:
                    lights = {key: make_light(surface, view_config, body, relief)}
                camera = find_camera(surface, view_config)
                light = replace(lights[key], camera_position=camera_place(camera))
                files = outputs[view.view_id]
                with claim(files[0]), companions_of(files[0]):
                    results.append(
                        render_camera(surface, camera, light, relief, files, view_config, view.view_id, show_nothing)
                    )
            except LunargrError as error:
                raise type(error)(f"{table.name}, {view.view_id}: {error}") from None
        if config.export is not None:
            cameras = [cast(Pinhole, find_camera(surface, _with_row(config, view))) for view in views]
            rendered = [View(v.view_id, c, outputs[v.view_id][0]) for v, c in zip(views, cameras, strict=True)]
            before = EACH * len(views)
            export_views(
                rendered, surface.grid, folder, config.export, lambda done: progress(before + done, total, "export")
            )
    progress(total, total, "views")
    return results


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
    surface: Surface,
    camera: Camera,
    light: Light,
    relief: tuple[float, float],
    files: Sequence[Path],
    config: Config,
    view_id: str,
    progress: Progress,
) -> Summary:
    """One view, streamed to its files band by band."""
    light = replace(light, camera_position=camera_place(camera))
    named = {path.suffix.lower(): path for path in files}
    errors = surface.knows_errors and ".exr" in named
    scene = make_scene(surface, camera, light, relief, config.samples, errors)
    channels = ["image", *(["image_std"] if errors else []), *BACKPLANES]
    bands: Iterable[dict[str, Floats32]] = render_view(surface, camera, light, scene)
    if any(effect.slot == "sensor" for effect in light.extensions):  # these need the whole image
        bands = [_whole(bands, light, scene.grid)]
    preview, tally, done, ground = Preview(camera.lines, camera.samples, 8192), Tally(surface.image_units), 0, False
    with contextlib.ExitStack() as stack:
        exr = None
        if ".exr" in named:
            facts = metadata(surface, config, light)
            exr = stack.enter_context(write_exr(named[".exr"], camera.lines, camera.samples, channels, facts))
        for band in bands:
            if exr:
                exr.write(band)
            preview.add(band["image"])
            tally.add(band)
            ground |= bool(np.isfinite(band["depth"]).any())
            done += len(band["image"])
            progress(done, camera.lines, "lines")
        if not ground:
            raise GeometryError(
                f"the view misses {surface.path.name}: no pixel sees valid ground; check the camera's place, `look_at` (or `quaternion`) and `fov_deg`."
            )
        write_png(named[".png"], preview.image())
    return tally.summary(view_id, files, (camera.samples, camera.lines), scene.samples)


def _whole(bands: Iterable[dict[str, Floats32]], light: Light, grid: Grid) -> dict[str, Floats32]:
    """All lines at once, as the sensor's own effects need them."""
    parts = list(bands)
    whole = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    whole["image"] = apply_sensor(whole["image"], light, grid)
    return whole
