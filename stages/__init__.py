"""The stages of the pipeline, one module each, and the physics and networks beneath them."""

__version__ = "0.1.0"
