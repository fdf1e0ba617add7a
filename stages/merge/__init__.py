"""Stage merge. run: the stage; parts: what is joined, and what it must have in common; joining: each variable."""

from __future__ import annotations

from stages.merge.run import Config, run

__all__ = ["Config", "run"]
