"""export: a trained network as ONNX, with a card that says what it is."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from schemas.files.outputs import Output, Target
from stages.common import runner
from stages.export.config import Config

if TYPE_CHECKING:
    from stages.export.onnx_file import Summary

__all__ = ["Config", "run"]


def _targets(call: runner.Call) -> list[Target]:
    path = call.output.file
    return [Target(path), Target(path.with_suffix(".md"), name=f"the card of {path.name}")]


@runner.stage(writes=_targets)
def run(checkpoint: Path, output: Output | Path, config: Config) -> Summary:
    """Write ``output`` (.onnx) and its card beside it (.md). Raises LunargrError."""
    from stages.export.onnx_file import work

    return work(checkpoint, Output.at(output), config)
