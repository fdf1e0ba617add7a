"""What holds of every name whatever was planted: its gain on held-out ground, and that on the test pairs, is not below zero."""

from __future__ import annotations

from collections.abc import Sequence


def doubtful(answers: Sequence[dict]) -> list[str]:
    """Rows of a table in Markdown: of the answers with a name, how many have one whose gain may be negative, and how many lose on the test pairs for sure."""
    named = [a for a in answers if a["causes"]]
    unsure = [a for a in named if not all((c["held_out_low"] or 0) > 0 for c in a["causes"])]
    highs = [a["held_out"]["gain_percent_high"] for a in named]
    losing = [high for high in highs if high is not None and high < 0]
    return [
        f"| any name: a cause whose gain on held-out ground may be negative | {len(unsure)} of {len(named)} |",
        f"| any name: the test pairs surely lose by the extended model | {len(losing)} of {len(named)}{_worst(losing)} |",
    ]


def _worst(losing: Sequence[float]) -> str:
    return f" (up to {-min(losing):.2g} %)" if losing else ""


__all__ = ["doubtful"]
