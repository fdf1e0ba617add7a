"""What diagnose is asked for."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """model : fitted where there is no checkpoint, in its coefficients ``free`` (() for all); most_pairs (of 128 px; of larger ones fewer, by area), most_sites : used for the search.

    law_known : the ground follows ``model``, whose coefficients alone are fitted
    """

    model: str = "M2"
    free: tuple[str, ...] = ()
    most_causes: int = 4
    most_images: int = 16
    most_pairs: int = 384
    most_sites: int = 128
    seed: int = 0
    law_known: bool = False
