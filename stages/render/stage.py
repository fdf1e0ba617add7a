"""One view of a terrain, as a map or through a camera."""

from __future__ import annotations

from pathlib import Path

from stages.common.progress import Progress
from stages.physics.bodies.spheres import find_body
from stages.render.config import Config, Summary
from stages.render.files import output_files
from stages.render.ortho import render_map
from stages.render.setup import find_camera, make_light, open_source
from stages.render.views import render_camera


def work(source: Path, path: Path, config: Config, progress: Progress) -> Summary:
    """See :func:`stages.render.run`."""
    body = find_body("moon" if config.body is None else config.body)
    files = output_files(path, config.view)
    with open_source(source, config, body) as surface:
        relief = surface.height_range()
        if config.view == "ortho":
            light = make_light(surface, config, body, relief)
            return render_map(surface, light, relief, files, config, progress)
        camera = find_camera(surface, config)
        light = make_light(surface, config, body, relief, camera)
        return render_camera(surface, camera, light, relief, files, config, path.stem, progress)
