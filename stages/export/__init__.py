"""export: a trained network as ONNX, with a card that says what it is."""

from __future__ import annotations

from typing import TYPE_CHECKING

from schemas.later import imported_later
from stages.export.config import Config

if TYPE_CHECKING:
    from stages.export.onnx_file import run

__getattr__ = imported_later(__name__, "onnx_file")
__all__ = ["Config", "run"]
