"""The errors that a user can cause, and the exit code they end in.

    LunargrError            exit code 3, one line on standard error, no traceback
    ├── ConfigError         an option or a recipe is wrong
    ├── InputError          a file of the user's (DEM, image, table) is missing, damaged or unusable
    ├── ArtefactError       one of our own HDF5 artefacts is missing, of another stage or version, or damaged
    ├── GeometryError       places, directions or bodies that cannot be (Sun below the horizon, pixels off the body)
    └── RegistryError       an unknown model, camera, effect or matcher; lists the choices

A message says where, what was expected, what was found and what to do, in one line. Anything else that is raised
is a bug in lunargr and keeps its traceback.
"""

from __future__ import annotations

from collections.abc import Iterable

EXIT_CODE = 3


class LunargrError(Exception):
    """Base of every error that is the input's fault and not the program's."""


class ConfigError(LunargrError):
    """An option or a recipe is wrong."""


class InputError(LunargrError):
    """A file of the user's is missing, damaged or unusable."""


class ArtefactError(LunargrError):
    """An HDF5 artefact is missing, damaged, or of another stage or version."""


class GeometryError(LunargrError):
    """A place, direction or body that cannot be."""


class RegistryError(LunargrError):
    """An unknown name; the message lists the choices."""

    @classmethod
    def unknown(cls, kind: str, name: str, choices: Iterable[str]) -> RegistryError:
        """The one wording for every unknown name."""
        return cls(f"unknown {kind} '{name}'; choose one of: {', '.join(sorted(choices))}.")
