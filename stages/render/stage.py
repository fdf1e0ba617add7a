"""One view of a terrain, as a map or through a camera."""

from __future__ import annotations

from pathlib import Path

from schemas.files.companions import companions_of
from schemas.files.outputs import Output, Target, check_outputs
from stages.common.progress import Progress, Say, say_nothing, show_nothing
from stages.physics.bodies.spheres import find_body
from stages.render.config import Config, Summary, check, inputs, output_files
from stages.render.ortho import render_map
from stages.render.setup import find_camera, make_light, open_source
from stages.render.views import render_camera


def run(
    source: Path, output: Output | Path, config: Config, say: Say = say_nothing, progress: Progress = show_nothing
) -> Summary:
    """Render one view of ``source`` (svbrdf.h5, scene.h5 or a DEM). Raises LunargrError.

    output : NAME.exr writes NAME.exr, NAME.png and, for ortho views, NAME.tif; NAME.tif and NAME.png leave the EXR out
    """
    output = Output.at(output)
    path = output.file
    check(config)
    body = find_body("moon" if config.body is None else config.body)
    files = output_files(path, config.view)
    targets = [Target(p, name="the output" if p == path else f"{p.suffix} beside {path.name}") for p in files]
    check_outputs(targets, inputs(source, config), output.overwrite)
    with companions_of(path), open_source(source, config, body) as surface:
        relief = surface.height_range()
        if config.view == "ortho":
            light = make_light(surface, config, body, relief)
            return render_map(surface, light, relief, files, config, progress)
        camera = find_camera(surface, config)
        light = make_light(surface, config, body, relief, camera)
        return render_camera(surface, camera, light, relief, files, config, path.stem, progress)
