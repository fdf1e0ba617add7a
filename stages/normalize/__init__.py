"""Stage normalize. stage: from files to files; levels: gains and errors of the images; mosaic: many images to one; writing: the file."""

from __future__ import annotations

from typing import TYPE_CHECKING

from schemas.later import imported_later
from stages.normalize.config import Config, Summary

if TYPE_CHECKING:
    from stages.normalize.stage import run

__getattr__ = imported_later(__name__, "stage")
__all__ = ["Config", "Summary", "run"]
