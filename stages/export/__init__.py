"""export: a trained network as ONNX, with a card that says what it is."""

from __future__ import annotations

from stages.export.onnx_file import Config, Summary, run

__all__ = ["Config", "Summary", "run"]
