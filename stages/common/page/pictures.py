"""Arrays to pictures inside a page: images as data URIs, colour bars, charts as SVG in the page's text colour."""

from __future__ import annotations

import base64
import io
import re
from typing import Any

import cv2
import h5py
import numpy as np

LONGEST = 900  # px: of larger maps only every k-th pixel is drawn
INK = "#010203"  # stands for the page's text colour until the SVG is written


def read_thinned(data: h5py.Dataset, *leading: int, longest: int = LONGEST) -> tuple[np.ndarray, int]:
    """A map (or one band of it) with every k-th row and column, read in bands; (array, k)."""
    height, width = data.shape[-2:]
    step = max(1, -(-max(height, width) // longest))
    rows = [data[(*leading, slice(r, min(r + 64 * step, height), step), slice(None, None, step))]
            for r in range(0, height, 64 * step)]  # fmt: skip
    return np.concatenate(rows), step


def data_uri(picture: np.ndarray) -> str:
    """A PNG as data URI. picture : (H, W, 3), RGB, or (H, W, 4), RGBA, uint8"""
    return _encoded(picture, "png", cv2.IMWRITE_PNG_COMPRESSION, 9)


def photo_uri(picture: np.ndarray, quality: int = 85) -> str:
    """A WebP as data URI, a tenth of a PNG for photographs. picture : (H, W, 3), RGB, or (H, W, 4), RGBA, uint8"""
    return _encoded(picture, "webp", cv2.IMWRITE_WEBP_QUALITY, quality)


def _encoded(picture: np.ndarray, kind: str, option: int, value: int) -> str:
    code = cv2.COLOR_RGBA2BGRA if picture.shape[2] == 4 else cv2.COLOR_RGB2BGR
    _, encoded = cv2.imencode(f".{kind}", cv2.cvtColor(picture, code), [option, value])
    return uri_of(encoded.tobytes(), f"image/{kind}")


def uri_of(content: bytes, kind: str) -> str:
    """A file's content as a data: URI."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def limits(values: np.ndarray, tail: float = 0.5) -> tuple[float, float]:
    """Low and high percentiles of the finite values, never equal. values : any shape; tail : percent beyond each"""
    known = values[np.isfinite(values)]
    if not len(known):
        return 0.0, 1.0
    low, high = np.percentile(known, (tail, 100 - tail))
    return float(low), float(high) if high > low else float(low) + max(abs(float(low)), 1.0) * 1e-6


def coloured(values: np.ndarray, low: float, high: float, colours: str) -> np.ndarray:
    """(H, W) -> (H, W, 4) uint8; unknown values are transparent."""
    import matplotlib

    scaled = np.clip((values - low) / (high - low), 0, 1)
    rgba = matplotlib.colormaps[colours](np.nan_to_num(scaled), bytes=True)
    rgba[~np.isfinite(values)] = 0
    return rgba


def shaded_relief(elevation: np.ndarray, gsd: float) -> tuple[np.ndarray, float, float]:
    """Elevation in colour times a hillshade lit from the upper left, (H, W, 4) uint8, and the colour limits."""
    low, high = limits(elevation)
    picture = coloured(elevation, low, high, "cividis").astype(float)
    filled = np.where(np.isfinite(elevation), elevation, np.nanmean(elevation) if np.isfinite(elevation).any() else 0)
    north, east = np.gradient(filled.astype(float), gsd)
    # Relief is exaggerated so that a typical slope is seen whatever the terrain.
    steepness = np.median(np.hypot(north, east)[np.isfinite(elevation)]) if np.isfinite(elevation).any() else 1.0
    lift = 0.35 / max(float(steepness), 1e-9)
    shade = (1 + lift * (east + north) * 0.7) / np.sqrt(1 + lift**2 * (east**2 + north**2)) / np.sqrt(2)
    picture[..., :3] *= np.clip(0.45 + 0.75 * shade, 0.15, 1.25)[..., None]
    return np.clip(picture, 0, 255).astype(np.uint8), low, high


def gradient(colours: str) -> str:
    """A matplotlib colour map as CSS colours."""
    import matplotlib

    stops = matplotlib.colormaps[colours](np.linspace(0, 1, 9), bytes=True)
    return ", ".join(f"rgb({r},{g},{b})" for r, g, b, _ in stops)


def number(value: float) -> str:
    """A number with three significant digits, or whole from 100 on."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def new_chart(width: float, height: float) -> tuple[Any, Any]:
    """A matplotlib figure whose text and axes will take the page's colour."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.add_subplot()
    axes.patch.set_alpha(0)
    for spine in axes.spines.values():
        spine.set_color(INK)
        spine.set_alpha(0.4)
    axes.tick_params(colors=INK, which="both")
    axes.xaxis.label.set_color(INK)
    axes.yaxis.label.set_color(INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.grid(color=INK, alpha=0.12, linewidth=0.6)
    axes.set_axisbelow(True)
    return figure, axes


def chart_svg(figure: Any, salt: str) -> str:
    """The figure as inline SVG; ``salt`` keeps its ids apart from other charts' on the page."""
    import matplotlib

    stream = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": salt, "font.family": "sans-serif"}):
        figure.savefig(stream, format="svg", dpi=200, transparent=True, metadata={"Date": None})
    svg = stream.getvalue()
    svg = svg[svg.index("<svg") :]
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    svg = re.sub(r' xmlns(:xlink)?="[^"]*"', "", svg)  # HTML needs no namespace for SVG
    svg = re.sub(r'(id="|href="#|url\(#)', rf"\g<1>{salt}-", svg)
    return svg.replace(INK, "currentColor").replace("<text", '<text fill="currentColor"')
