"""What evaluate is asked for."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """fit_pairs : bounds the pairs that baselines are fitted on (0: all); renderings : whether every rendered crop is kept,
    None: where they are small; only : rows of the table, () for all; extend : the diagnosis whose extended model is scored, too;
    published : the set of Hapke's parameters that is scored, None: the one nearest to the images' wavelength
    """

    split: str = "test"
    batch: int = 16
    fit_pairs: int = 4096
    renderings: bool | None = None
    seed: int = 0
    device: str = "auto"
    only: tuple[str, ...] = ()
    extend: str | None = None
    published: str | None = None
