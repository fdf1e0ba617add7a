"""One HTML file from packed maps: template, style, shaders and scripts in one, nothing from outside."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from importlib.metadata import version
from importlib.resources import files
from typing import Any

import jinja2
import numpy as np
from numpy.typing import NDArray

from stages.view.frames import NODES, Frames
from stages.view.layers import Content, block_mean
from stages.view.packing import Blob, Packer, spread_step
from stages.view.photographs import Photograph
from stages.view.steps import choose_steps

HEIGHT_STEP = 1e-3  # of a pixel: slopes are then kept to 2e-4
PHOTOGRAPH_LEVELS = 256  # steps of its range
# Of maps that no picture is made of: steps of the range, and pixels along each side of a block whose mean is kept.
OTHER_LEVELS, OTHER_BLOCK = 64, 3
SCRIPTS = (
    "decode.js", "ground.js", "coarse.js", "shadows.js", "relight.js", "terrain.js", "panel.js", "photographs.js", "overlay.js", "address.js", "hooks.js",
    "main.js",
)  # fmt: skip
SAME = 1e-6  # relative: what varies less is the same everywhere
SHADERS = ("common", "lattice", "spread", "visible", "shade", "draw_vertex", "draw")
COLOURS = ("viridis", "magma", "cividis")


def make_page(
    content: Content, frames: Frames, photographs: Sequence[Photograph], still: bytes, start: dict[str, Any], title: str
) -> str:
    """The whole page. start : what it shows first (azimuth, elevation in degrees)"""
    blob = Blob()
    head = describe(content, frames, photographs, blob)
    head |= {"start": start, "title": title}
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    template = environment.from_string(_asset("page.html.j2"))
    return template.render(
        title=title,
        model=content.model,
        version=version("lunargr"),
        start=start,
        style=_asset("page.css"),
        library=_asset("vendor/three.min.js"),
        licence=_asset("vendor/LICENSE.three.txt"),
        script="\n".join(_asset(f"js/{name}") for name in SCRIPTS),
        head=_json_for_html({**head, "shaders": _shaders(content)}),
        blob=blob.text(),
        still=base64.b64encode(still).decode("ascii"),
    )


def describe(content: Content, frames: Frames, photographs: Sequence[Photograph], blob: Blob) -> dict[str, Any]:
    """What the page's script must know; its maps go into ``blob``."""
    grid = content.grid
    known = np.isfinite(content.elevation)
    mapped = known.copy()
    for layer in content.coefficients:
        mapped &= np.isfinite(layer.values)
    levels, steps, error = choose_steps(content, mapped)
    packer = Packer()
    elevation = blob.add_map(packer.pack(content.elevation, known, HEIGHT_STEP * grid.gsd))
    fields = []
    for k, layer in enumerate([*content.coefficients, *content.others]):
        good = np.isfinite(layer.values)
        entry: dict[str, Any] = {"name": layer.name, "title": layer.title, "unit": layer.unit}
        fields.append(entry)
        low, high = float(np.min(layer.values[good])), float(np.max(layer.values[good]))
        if high - low <= SAME * max(abs(low), abs(high)):
            entry["constant"] = high
            continue
        values, step = layer.values, steps[k] if k < len(steps) else 0.0
        if k >= len(steps):
            values = _blocks(values)
            good = np.isfinite(values)
            step = spread_step(values, good, OTHER_LEVELS)
        entry["map"] = blob.add_map(packer.pack(values, good, step))
        # coefficients are mostly known where all others are
        if not np.array_equal(good, mapped):
            entry["known"] = blob.add_mask(good)
    return {
        "height": grid.height,
        "width": grid.width,
        "gsd": grid.gsd,
        "radius": grid.radius,
        "factor": content.factor,
        "brightness": content.brightness,
        "model": {"name": content.model.name, "title": content.model.title, "formula": content.model.formula},
        "count": len(content.coefficients),
        "levels": levels,
        "error": error,
        "block": OTHER_BLOCK,
        "elevation": elevation,
        "elevation_known": blob.add_mask(known),
        "mapped": blob.add_mask(mapped),
        "fields": fields,
        "nodes": NODES,
        "axes": [round(float(v), 9) for v in frames.axes.ravel()],
        "pixel_size": [float(v) for v in frames.pixel_size.ravel()],
        "middle": frames.middle.tolist(),
        "convergence_deg": frames.convergence_deg,
        "colours": {name: _colours(name) for name in COLOURS},
        "photographs": [_photograph(p, blob) for p in photographs],
    }


def _blocks(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Means over blocks of OTHER_BLOCK pixels a side; those at the border go on beyond it as they end."""
    height, width = values.shape
    return block_mean(np.pad(values, ((0, -height % OTHER_BLOCK), (0, -width % OTHER_BLOCK)), "edge"), OTHER_BLOCK)


def _photograph(photograph: Photograph, blob: Blob) -> dict[str, Any]:
    good = np.isfinite(photograph.image)
    return {
        "title": photograph.title,
        "unit": photograph.unit,
        "row": photograph.row,
        "col": photograph.col,
        "azimuth": photograph.sun_azimuth_deg,
        "elevation": photograph.sun_elevation_deg,
        "camera": photograph.camera.tolist(),
        "map": blob.add_map(
            Packer().pack(photograph.image, good, spread_step(photograph.image, good, PHOTOGRAPH_LEVELS))
        ),
        "known": blob.add_mask(good),
    }


def _colours(name: str) -> str:
    """256 RGB colours of a colour map as base64."""
    import matplotlib

    table = matplotlib.colormaps[name](np.arange(256), bytes=True)[:, :3]
    return base64.b64encode(table.tobytes()).decode("ascii")


def _shaders(content: Content) -> dict[str, str]:
    sources = {name: _asset(f"shaders/{name}.glsl") for name in SHADERS}
    return {**sources, "model": content.model.glsl or ""}


def _asset(name: str) -> str:
    return files("stages.view").joinpath("assets", *name.split("/")).read_text(encoding="utf-8")


def _json_for_html(value: Any) -> str:
    """JSON that may stand inside a script element, whatever its strings hold."""
    return json.dumps(value, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
