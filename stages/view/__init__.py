"""view: one self-contained page that relights a learned map in a browser."""

from __future__ import annotations

from stages.view.run import Config, Summary, run

__all__ = ["Config", "Summary", "run"]
