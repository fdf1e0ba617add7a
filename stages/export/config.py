"""The settings of export."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """opset : of ONNX"""

    opset: int = 17
