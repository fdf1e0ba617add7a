"""From artefacts, results and pictures to one page."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any
from urllib.parse import quote

import cv2
import numpy as np
from markupsafe import Markup

from schemas import ConfigError, InputError, atomic_path, open_artefact, read_kind
from schemas.files.outputs import Output
from schemas.files.user_files import check_file, read_json
from schemas.provenance import read_record
from stages.common import page
from stages.common.page import diagnosis, pictures
from stages.common.page.sentences import Number, Sentence
from stages.common.progress import Progress
from stages.report import conclusions, relief, results, sections
from stages.report.config import Config
from stages.report.held_out import held_out_images

BUILDERS = {
    "scene": sections.scene,
    "pairs": sections.pairs,
    "checkpoint": sections.checkpoint,
    "svbrdf": relief.with_relief,
}
SENTENCES = {"checkpoint": conclusions.learned, "svbrdf": conclusions.albedo}
# The order of the page; a page says the same whatever the order of its files.
ORDER = ("scene", "pairs", "checkpoint", "svbrdf", "evaluation", "held_out", "match", "compare", "diagnosis")
# ... and of its first screen: what was learned, what it gains, what is still wrong
FIRST = ("checkpoint", "evaluation", "svbrdf", "held_out", "diagnosis")
MOST_NUMBERS = 3  # in large type
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


@dataclass
class Part:
    """What one file gives to the page. kind : one of ORDER; sentences, numbers, pictures : for the first screen"""

    kind: str
    section: page.Section
    sentences: list[Sentence]
    numbers: list[Number] = field(default_factory=list)
    pictures: list[Markup] = field(default_factory=list)


@dataclass
class Found:
    """What all files give. seen : evaluation.h5 and the evaluation.json beside it are one result"""

    parts: list[Part] = field(default_factory=list)
    shown: list[Path] = field(default_factory=list)
    linked: list[Path] = field(default_factory=list)
    details: list[Markup] = field(default_factory=list)
    seen: list[Any] = field(default_factory=list)

    def add(self, path: Path) -> None:
        """Take in one file. Raises ArtefactError, InputError."""
        kind = path.suffix.lower()
        if kind in PICTURES:
            self.shown.append(path)
            return
        if kind == ".html":
            check_file(path, "a page of 'lunargr view'")
            self.linked.append(path)
            return
        load = _json if kind == ".json" else _artefact
        try:
            part = load(path, self.details, self.seen)
        except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
            raise InputError(
                f"{path}: expected a result as its stage writes it, found other content ({type(error).__name__}: {error}); "
                "run the stage again."
            ) from None
        if part is not None:
            self.parts.append(part)


def work(files: Sequence[Path], output: Output, config: Config, progress: Progress) -> list[str]:
    """See :func:`stages.report.run`."""
    if not files:
        raise ConfigError("report: expected at least one file, found none; give the artefacts of a run.")
    found = Found()
    for number, path in enumerate(sorted(files, key=lambda p: p.suffix.lower() == ".json")):
        progress(number, len(files), "report")
        found.add(path)
    found.parts.sort(key=lambda part: ORDER.index(part.kind))
    chapters = [part.section for part in found.parts]
    lit = next((path for path in found.shown if path.stem.startswith("render")), None)
    rest = [path for path in found.shown if path != lit]
    if rest:
        chapters.append(_gallery(rest))
    if found.details:
        chapters.append(page.Section("Provenance", found.details))
    if not chapters and lit is None:
        raise ConfigError("report: expected artefacts or results of lunargr, found nothing that can be shown.")
    progress(len(files), len(files), "report")
    head = _first_screen(found, lit, config.note, output.file)
    subtitle = f"made by lunargr {version('lunargr')} from {len(files)} files"
    footer = "Every number and picture on this page is read from the files named under Provenance."
    with atomic_path(output.file) as partial:
        partial.write_text(page.page(config.title, subtitle, head, chapters, footer), encoding="utf-8")
    return [s.title for s in chapters]


def _first_screen(found: Found, lit: Path | None, note: str, output: Path) -> list[Markup]:
    """The note, three numbers, the pictures, the way to the page that relights the map; the findings in words, folded."""
    head = [page.paragraph(note, "note")] if note else []
    parts = sorted((p for p in found.parts if p.kind in FIRST), key=lambda p: FIRST.index(p.kind))
    # the first of each result, then what else there is, of the last result first
    rest = [number for part in reversed(parts) for number in part.numbers[1:]]
    numbers = [*(part.numbers[0] for part in parts if part.numbers), *rest][:MOST_NUMBERS]
    if numbers:
        head.append(page.headline(numbers))
    shown = [picture for part in parts for picture in part.pictures]
    if lit is not None:
        shown.append(_figure(lit))
    if shown:
        head.append(page.grid(shown))
    beside = output.with_name("view.html")
    if beside.is_file() and beside.resolve() not in [path.resolve() for path in found.linked]:
        found.linked.append(beside)
    for path in found.linked:
        address = quote(os.path.relpath(path, output.parent).replace(os.sep, "/"))
        head.append(page.link(address, f"Move the Sun and the camera over this map: {path.name}"))
    sentences = dict.fromkeys(s for part in parts for s in part.sentences)
    if sentences:
        said = page.conclusions(sentences)
        head.append(page.folded("What this run found, in words", [said]) if numbers else said)
    return head


def _artefact(path: Path, details: list[Markup], seen: list[Any]) -> Part | None:
    """The section of one HDF5 artefact; its origin is appended to ``details``, its result to ``seen``."""
    schema = read_kind(path)
    with open_artefact(path, schema) as file:
        details.append(_origin(path, schema.title))
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
        return Part("diagnosis", results.diagnosis(result), diagnosis.conclusions(result), diagnosis.numbers(result))
    if {"models", "gains", "claim"} <= keys:
        said = conclusions.held_out_images(result), conclusions.held_out_numbers(result)
        return Part("held_out", held_out_images(result), *said)
    if {"models", "gains"} <= keys:
        said = conclusions.evaluation(result), conclusions.evaluation_numbers(result)
        return Part("evaluation", results.evaluation(result, file), *said, results.before_and_after(result, file))
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


def _origin(path: Path, title: str) -> Markup:
    """Who made a file, from what and with which options."""
    record, _ = read_record(path)
    if record is None:
        return page.disclosure(f"{path.name}: written by another program", "no provenance in the file")
    lines = [f"{record['history']}, version {record['version'] or '?'}"]
    lines += [f"from {source['name']}  sha256 {source['sha256']}" for source in record["inputs"]]
    lines.append(json.dumps(record["config"], indent=1))
    return page.disclosure(f"{path.name}: {title}", "\n".join(lines))
