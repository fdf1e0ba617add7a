"""Camera models, one file each, behind a registry.

A new camera is one new file in this folder: it subclasses Camera, says which ``type`` (or CSM ``name_model``) it reads
and decorates itself with @register. ``examples/new_camera.py`` shows one.
"""

from __future__ import annotations

from pathlib import Path

from stages.common.registry import import_all
from stages.physics.cameras.base import Camera, camera_from_document, cameras, read_document, register
from stages.physics.cameras.isis_cube import is_cube
from stages.physics.cameras.isis_instruments import cube_document

import_all(__name__, __path__)


def open_camera(path: str | Path) -> Camera:
    """The camera in a file: our JSON, an ALE/CSM ISD, or an ISIS cube with SPICE attached. Raises LunargrError."""
    path = Path(path)
    if is_cube(path):
        return camera_from_document(cube_document(path), str(path))
    return camera_from_document(read_document(path), str(path))


__all__ = ["Camera", "camera_from_document", "cameras", "open_camera", "register"]
