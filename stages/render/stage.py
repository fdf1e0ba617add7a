"""One view of a terrain, as a map or through a camera."""

from __future__ import annotations

from pathlib import Path

from stages.common.progress import Progress
from stages.render.config import Config, Summary
from stages.render.files import output_files
from stages.render.ortho import render_map
from stages.render.renderer import Renderer
from stages.render.views import render_camera


def work(source: Path, path: Path, config: Config, progress: Progress) -> Summary:
    """See :func:`stages.render.run`."""
    files = output_files(path, config)
    with Renderer(source, config=config) as renderer:
        if config.view == "ortho":
            return render_map(renderer.surface, renderer.light(config), renderer.relief, files, config, progress)
        camera = renderer.find_camera(config)
        return render_camera(renderer, camera, files, config, path.stem, progress)
