"""render: images of a terrain with its reflectance, for any Sun and camera, with backplanes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from schemas.files.outputs import Output
from stages.common import runner
from stages.common.progress import Progress, show_nothing
from stages.render.config import Config, StereoConfig, Summary, check, check_trajectory
from stages.render.files import (
    as_json,
    input_files,
    main_file,
    manifest,
    stereo_targets,
    trajectory_targets,
    view_targets,
)

if TYPE_CHECKING:
    from stages.render.renderer import Frame, Renderer

__all__ = ["Config", "Frame", "Renderer", "StereoConfig", "Summary", "run", "run_stereo", "run_trajectory"]


def __getattr__(name: str) -> Any:
    """The classes that need what is slow to import, on first use."""
    if name in ("Frame", "Renderer"):
        from stages.render import renderer

        return getattr(renderer, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


@runner.stage(
    reads=input_files,
    writes=view_targets,
    main=main_file,
    check=lambda call: check(call.config),
    content=lambda summary: as_json([summary]),
)
def run(source: Path, output: Output | Path, config: Config, progress: Progress = show_nothing) -> Summary:
    """Render one view of ``source`` (svbrdf.h5, scene.h5 or a DEM). Raises LunargrError.

    output : NAME.exr writes NAME.exr, NAME.png and, for ortho views, NAME.tif; NAME.tif and NAME.png leave the EXR out
    """
    from stages.render.stage import work

    return work(source, Output.at(output).file, config, progress)


@runner.stage(
    reads=input_files,
    writes=trajectory_targets,
    main=lambda call: None,
    check=lambda call: check_trajectory(call.config),
    content=as_json,
)
def run_trajectory(
    source: Path, table: Path, output: Output | Path, config: Config, progress: Progress = show_nothing
) -> list[Summary]:
    """Render the views of a trajectory table into a folder, one EXR and PNG per row. Raises LunargrError.

    An output that is resumed leaves alone what is there already; a shard is every n-th view. Shards share the folder:
    each view has a lock of its own.
    """
    from stages.render.views import render_trajectory

    return render_trajectory(source, table, Output.at(output), config, progress)


@runner.stage(reads=input_files, writes=stereo_targets, main=manifest)
def run_stereo(
    source: Path, output: Output | Path, config: Config, stereo: StereoConfig, progress: Progress = show_nothing
) -> Path:
    """Render ``stereo.count`` pairs of ``source`` into a folder; the path of the manifest. Raises LunargrError.

    config : what is rendered, size and field of view; its Sun and camera are drawn here
    """
    from stages.render.stereo import render_stereo

    return render_stereo(source, Output.at(output).file, config, stereo, progress)
