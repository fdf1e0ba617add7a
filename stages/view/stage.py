"""From svbrdf.h5 to a page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from schemas import ConfigError, atomic_path
from schemas.files.outputs import Output
from stages.common.progress import Progress
from stages.view.config import Config
from stages.view.frames import make_frames
from stages.view.layers import read_content
from stages.view.page import make_page
from stages.view.photographs import read_photographs
from stages.view.still import still_jpeg

STEPS = 4


@dataclass(frozen=True)
class Summary:
    """What was written, for the line at the end."""

    height: int
    width: int
    factor: int
    model: str
    layers: int
    photographs: int
    size: int


def work(source: Path, pairs: Path | None, output: Output, config: Config, progress: Progress) -> Summary:
    """See :func:`stages.view.run`."""
    path = output.file
    _check(config, path)
    progress(0, STEPS, "reading maps")
    content = read_content(source, config.max_px)
    frames = make_frames(content.grid)
    photographs = []
    if pairs is not None:
        photographs = read_photographs(pairs, content.grid, content.factor, frames, config.photographs)
    progress(1, STEPS, "still picture")
    still = still_jpeg(content, config.sun_azimuth_deg, config.sun_elevation_deg)
    progress(2, STEPS, "packing")
    start = {"azimuth": config.sun_azimuth_deg, "elevation": config.sun_elevation_deg}
    text = make_page(content, frames, photographs, still, start, config.title or source.stem)
    progress(3, STEPS, "writing")
    with atomic_path(path) as partial:
        partial.write_text(text, encoding="utf-8")
    progress(STEPS, STEPS, "page")
    return Summary(
        content.grid.height,
        content.grid.width,
        content.factor,
        content.model.name,
        len(content.coefficients) + len(content.others),
        len(photographs),
        path.stat().st_size,
    )


def _check(config: Config, page: Path) -> None:
    if page.suffix.lower() not in (".html", ".htm"):
        raise ConfigError(f"{page}: expected a name that ends in .html; choose another `output`.")
    if not 16 <= config.max_px <= 8192:
        raise ConfigError(f"`max_px`: expected pixels in 16..8192, found {config.max_px}.")
    if not 0 < config.sun_elevation_deg <= 90:
        raise ConfigError(f"`sun_elevation_deg`: expected degrees in 0..90, found {config.sun_elevation_deg:g}.")
    if config.photographs < 1:
        raise ConfigError(f"`photographs`: expected at least 1, found {config.photographs}.")
