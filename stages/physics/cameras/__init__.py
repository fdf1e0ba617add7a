"""Camera models, one file each, behind a registry.

A new camera is one new file in this folder: it subclasses Camera, says which ``type`` (or CSM ``name_model``) it reads
and decorates itself with @register. ``examples/new_camera.py`` shows one.
"""

from __future__ import annotations

import importlib
import pkgutil
from pathlib import Path

from stages.physics.cameras.base import Camera, camera_from_document, camera_kinds, read_document, register

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")


def open_camera(path: str | Path) -> Camera:
    """The camera in a file: our JSON or an ALE/CSM ISD. Raises LunargrError."""
    path = Path(path)
    return camera_from_document(read_document(path), str(path))


__all__ = ["Camera", "camera_from_document", "camera_kinds", "open_camera", "register"]
