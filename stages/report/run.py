"""From artefacts, results and pictures to one page."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

from markupsafe import Markup

from schemas import ConfigError, InputError, atomic_path, check_output, open_artefact, read_kind
from schemas.files.user_files import check_file, read_json
from stages.common import page
from stages.common.page import pictures
from stages.report import results, sections

BUILDERS = {
    "scene": sections.scene,
    "pairs": sections.pairs,
    "checkpoint": sections.checkpoint,
    "svbrdf": sections.svbrdf,
}
# The order of the page; a page says the same whatever the order of its files.
ORDER = ("scene", "pairs", "checkpoint", "svbrdf", "evaluation", "match", "compare", "diagnosis")
PICTURES = {".png": "image/png", ".jpg": "image/jpeg", ".jpeg": "image/jpeg"}
LARGEST_PICTURE = 12 * 2**20  # bytes


@dataclass
class Config:
    """The page's title."""

    title: str = "Lunar reflectance learned from terrain"


def run(
    files: Sequence[Path],
    output: Path,
    config: Config,
    *,
    overwrite: bool = False,
    progress: Callable[[int, int, str], None] | None = None,
) -> list[str]:
    """Write the page and return the titles of its sections.

    files : artefacts, JSON results of match, compare and diagnose, and PNG or JPEG pictures, in any order
    Raises ConfigError, ArtefactError, InputError.
    """
    if not files:
        raise ConfigError("report: expected at least one file, found none; give the artefacts of a run.")
    check_output(output, files, overwrite)
    found: list[tuple[int, page.Section]] = []
    cards: list[tuple[str, str, str]] = []
    shown: list[Path] = []
    details: list[Markup] = []
    seen: list[Any] = []  # evaluation.h5 and the evaluation.json beside it are one result
    for number, path in enumerate(sorted(files, key=lambda p: p.suffix.lower() == ".json")):
        if progress is not None:
            progress(number, len(files), "report")
        if path.suffix.lower() in PICTURES:
            shown.append(path)
            continue
        load = _json if path.suffix.lower() == ".json" else _artefact
        try:
            kind, section, more = load(path, details, seen)
        except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
            raise InputError(
                f"{path}: expected a result as its stage writes it, found other content ({type(error).__name__}: {error}); "
                "run the stage again."
            ) from None
        if section is not None:
            found.append((ORDER.index(kind), section))
        cards.extend(more)
    chapters = [section for _, section in sorted(found, key=lambda item: item[0])]
    if shown:
        chapters.append(_gallery(shown))
    if details:
        chapters.append(page.Section("Provenance", details))
    if not chapters:
        raise ConfigError("report: expected artefacts or results of lunargr, found nothing that can be shown.")
    if progress is not None:
        progress(len(files), len(files), "report")
    head = [page.cards(cards)] if cards else []
    subtitle = f"made by lunargr {version('lunargr')} from {len(files)} files"
    footer = "Every number and picture on this page is read from the files named under Provenance."
    with atomic_path(output) as partial:
        partial.write_text(page.page(config.title, subtitle, head, chapters, footer), encoding="utf-8")
    return [s.title for s in chapters]


Part = tuple[str, page.Section | None, list[tuple[str, str, str]]]  # kind, section, headline numbers


def _artefact(path: Path, details: list[Markup], seen: list[Any]) -> Part:
    """The section of one HDF5 artefact; its origin is appended to ``details``, its result to ``seen``."""
    schema = read_kind(path)
    with open_artefact(path, schema) as file:
        details.append(_origin(path, file))
        if schema.name == "evaluation":
            result = json.loads(str(file.attrs["metrics"]))
            seen.append(result)
            return "evaluation", results.evaluation(result, file), results.headline(result)
        if schema.name == "diagnosis":
            result = json.loads(str(file.attrs["report"]))
            seen.append(result)
            return "diagnosis", results.diagnosis(result), []
        if schema.name in BUILDERS:
            return schema.name, BUILDERS[schema.name](file), []
    return "scene", None, []


def _json(path: Path, details: list[Markup], seen: list[Any]) -> Part:
    """The section of a JSON result, told by its keys; none for one that is on the page already."""
    result: Any = read_json(path, "a result in JSON")
    if result in seen:
        return "scene", None, []
    seen.append(result)
    keys = set(result) if isinstance(result, dict) else set()
    if {"matchers", "size_px"} <= keys:
        return "match", results.matching(result), []
    if {"models", "differences"} <= keys:
        return "compare", results.comparison(result), []
    if {"verdict", "causes"} <= keys:
        return "diagnosis", results.diagnosis(result), []
    if {"models", "gains"} <= keys:
        return "evaluation", results.evaluation(result, None), results.headline(result)
    raise InputError(f"{path}: expected a result of evaluate, match, compare or diagnose, found other JSON.")


def _gallery(paths: Sequence[Path]) -> page.Section:
    section = page.Section("Pictures")
    figures = []
    for path in paths:
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
        if content[:4] not in (b"\x89PNG",) and content[:2] != b"\xff\xd8":
            raise InputError(f"{path}: expected a PNG or JPEG picture, found another kind of file.")
        source = pictures.uri_of(content, PICTURES[path.suffix.lower()])
        figures.append(page.picture(source, path.stem.replace("_", " ")))
    section.add(page.grid(figures))
    return section


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
