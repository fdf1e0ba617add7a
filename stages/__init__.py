"""The stages of the pipeline, one module each, and the physics and networks beneath them."""

from stages.common.caches import choose_caches

__version__ = "0.1.0"

choose_caches()  # before any stage imports numba or matplotlib
