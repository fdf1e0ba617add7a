"""From artefacts, results and pictures to one page."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple
from urllib.parse import quote

import cv2
import numpy as np
from markupsafe import Markup

from schemas import ConfigError, InputError, atomic_path, check_output, open_artefact, read_kind
from schemas.files.outputs import Output
from schemas.files.user_files import check_file, read_json
from stages.common import page
from stages.common.page import pictures
from stages.common.page.diagnosis import conclusions as diagnosed
from stages.common.page.sentences import Sentence
from stages.common.progress import Progress, Say, say_nothing, show_nothing
from stages.report import conclusions, maps, results, sections
from stages.report.config import Config
from stages.report.held_out import held_out_images

BUILDERS = {
    "scene": sections.scene,
    "pairs": sections.pairs,
    "checkpoint": sections.checkpoint,
    "svbrdf": maps.svbrdf,
}
SENTENCES = {"checkpoint": conclusions.learned, "svbrdf": conclusions.albedo}
# The order of the page; a page says the same whatever the order of its files.
ORDER = ("scene", "pairs", "checkpoint", "svbrdf", "evaluation", "held_out", "match", "compare", "diagnosis")
# ... and of its first screen: what was learned, what it gains, what is still wrong
FIRST = ("checkpoint", "evaluation", "svbrdf", "held_out", "diagnosis")
PICTURES = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg"}
LARGEST_PICTURE = 12 * 2**20  # bytes
HEAVY, WIDEST = 300_000, 1400  # bytes, px: larger pictures are scaled down and written as WebP
# What is seen on the pictures that commands write, by the beginning of their names.
CAPTIONS = {
    "match_": "Matches between a measured crop (left) and the rendered ones, coloured by how far each ends from where it began",
    "crop_": "A test crop: measured, rendered by the compared models, and measured minus rendered",
    "errors": "Errors of the compared models with their 95 % intervals",
    "training_curves": "Loss on training and validation pairs",
    "render": "The map as 'lunargr render' lights it",
}


class Part(NamedTuple):
    """What one file gives. kind : one of ORDER; sentences : for the first screen"""

    kind: str
    section: page.Section
    sentences: list[Sentence]


def run(
    files: Sequence[Path],
    output: Output | Path,
    config: Config,
    say: Say = say_nothing,
    progress: Progress = show_nothing,
) -> list[str]:
    """Write the page and return the titles of its sections.

    files : artefacts, JSON results of evaluate, match, compare and diagnose, PNG or JPEG pictures, and pages of
    `lunargr view` to link to, in any order; `view.html` beside the output is linked, too
    Raises ConfigError, ArtefactError, InputError.
    """
    output = Output.at(output)
    if not files:
        raise ConfigError("report: expected at least one file, found none; give the artefacts of a run.")
    check_output(output.file, files, output.overwrite)
    found: list[Part] = []
    shown: list[Path] = []
    linked: list[Path] = []
    details: list[Markup] = []
    seen: list[Any] = []  # evaluation.h5 and the evaluation.json beside it are one result
    for number, path in enumerate(sorted(files, key=lambda p: p.suffix.lower() == ".json")):
        progress(number, len(files), "report")
        if path.suffix.lower() in PICTURES:
            shown.append(path)
            continue
        if path.suffix.lower() == ".html":
            check_file(path, "a page of 'lunargr view'")
            linked.append(path)
            continue
        load = _json if path.suffix.lower() == ".json" else _artefact
        try:
            part = load(path, details, seen)
        except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
            raise InputError(
                f"{path}: expected a result as its stage writes it, found other content ({type(error).__name__}: {error}); "
                "run the stage again."
            ) from None
        if part is not None:
            found.append(part)
    found.sort(key=lambda part: ORDER.index(part.kind))
    chapters = [part.section for part in found]
    first = next((path for path in shown if path.stem.startswith("render")), None)
    rest = [path for path in shown if path != first]
    if rest:
        chapters.append(_gallery(rest))
    if details:
        chapters.append(page.Section("Provenance", details))
    if not chapters and first is None:
        raise ConfigError("report: expected artefacts or results of lunargr, found nothing that can be shown.")
    progress(len(files), len(files), "report")
    head = _head(found, linked, output.file)
    if first is not None:
        head = [page.beside(head, _figure(first))]
    subtitle = f"made by lunargr {version('lunargr')} from {len(files)} files"
    footer = "Every number and picture on this page is read from the files named under Provenance."
    with atomic_path(output.file) as partial:
        partial.write_text(page.page(config.title, subtitle, head, chapters, footer), encoding="utf-8")
    return [s.title for s in chapters]


def _head(found: Sequence[Part], linked: Sequence[Path], output: Path) -> list[Markup]:
    """The first screen: a way to the page that relights the map, and conclusions, each once."""
    beside = output.with_name("view.html")
    if beside.is_file() and beside.resolve() not in [path.resolve() for path in linked]:
        linked = [*linked, beside]
    head = []
    for path in linked:
        address = quote(os.path.relpath(path, output.parent).replace(os.sep, "/"))
        head.append(page.link(address, f"Move the Sun and the camera over this map: {path.name}"))
    sentences = [s for kind in FIRST for part in found if part.kind == kind for s in part.sentences]
    return [*head, page.conclusions(dict.fromkeys(sentences))] if sentences else head


def _artefact(path: Path, details: list[Markup], seen: list[Any]) -> Part | None:
    """The section of one HDF5 artefact; its origin is appended to ``details``, its result to ``seen``."""
    schema = read_kind(path)
    with open_artefact(path, schema) as file:
        details.append(_origin(path, file))
        if schema.name in ("evaluation", "diagnosis"):
            result = json.loads(str(file.attrs["metrics" if schema.name == "evaluation" else "report"]))
            seen.append(result)
            return _result(result, file)
        if schema.name in BUILDERS:
            sentences = SENTENCES[schema.name](file) if schema.name in SENTENCES else []
            return Part(schema.name, BUILDERS[schema.name](file), sentences)
    return None


def _json(path: Path, details: list[Markup], seen: list[Any]) -> Part | None:
    """The section of a JSON result; none for one that is on the page already."""
    result: Any = read_json(path, "a result in JSON")
    if result in seen:
        return None
    seen.append(result)
    part = _result(result, None) if isinstance(result, dict) else None
    if part is None:
        raise InputError(f"{path}: expected a result of evaluate, match, compare or diagnose, found other JSON.")
    return part


def _result(result: dict[str, Any], file: Any) -> Part | None:
    """The section of a result, which its keys tell apart. file : the artefact, which may hold crops"""
    keys = set(result)
    if {"matchers", "size_px"} <= keys:
        return Part("match", results.matching(result), [])
    if {"models", "differences"} <= keys:
        return Part("compare", results.comparison(result), [])
    if "verdict" in keys:
        return Part("diagnosis", results.diagnosis(result), diagnosed(result))
    if {"models", "gains", "claim"} <= keys:
        return Part("held_out", held_out_images(result), conclusions.held_out_images(result))
    if {"models", "gains"} <= keys:
        return Part("evaluation", results.evaluation(result, file), conclusions.evaluation(result))
    return None


def _gallery(paths: Sequence[Path]) -> page.Section:
    return page.Section("Pictures", [page.grid([_figure(path) for path in paths])])


def _figure(path: Path) -> Markup:
    """A picture with what it shows. Raises InputError for a file that is none."""
    check_file(path, "a PNG or JPEG picture")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path.") from None
    if len(content) > LARGEST_PICTURE:
        raise InputError(
            f"{path}: expected a picture below {LARGEST_PICTURE // 2**20} MiB, found {len(content) / 2**20:.0f} MiB; "
            "make a smaller preview."
        )
    if not content.startswith((b"\x89PNG", b"\xff\xd8")):
        raise InputError(f"{path}: expected a PNG or JPEG picture, found another kind of file.")
    return page.picture(_picture_uri(content, path), _caption(path))


def _picture_uri(content: bytes, path: Path) -> str:
    """A picture as data URI, large ones smaller and as WebP, so that the page stays light."""
    if len(content) <= HEAVY:
        return pictures.uri_of(content, PICTURES[path.suffix.lower()])
    picture = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR_RGB)
    if picture is None:
        raise InputError(f"{path}: expected a PNG or JPEG picture, found a damaged one; make it again.")
    scale = min(1.0, WIDEST / max(picture.shape[:2]))
    size = [max(1, round(n * scale)) for n in picture.shape[1::-1]]
    return pictures.photo_uri(cv2.resize(picture, size, interpolation=cv2.INTER_AREA) if scale < 1 else picture)


def _caption(path: Path) -> str:
    """What is seen, where a command of lunargr named the picture; and its name."""
    caption = next((text for start, text in CAPTIONS.items() if path.stem.startswith(start)), None)
    name = path.stem.replace("_", " ")
    return name if caption is None else f"{caption} ({name})"


def _origin(path: Path, file: Any) -> Markup:
    """Who made a file, from what and with which options."""
    attributes = file.attrs
    if "history" not in attributes:
        return page.disclosure(f"{path.name}: written by another program", "no provenance in the file")
    inputs = json.loads(str(attributes.get("inputs", "[]")))
    lines = [f"{attributes['history']}, version {attributes.get('lunargr_version', '?')}"]
    lines += [f"from {source['name']}  sha256 {source['sha256']}" for source in inputs]
    lines.append(json.dumps(json.loads(str(attributes.get("config", "{}"))), indent=1))
    return page.disclosure(f"{path.name}: {attributes.get('title', '')}", "\n".join(lines))
