"""Registries that are filled by the files of a folder."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Container, Iterable

from schemas.errors import ConfigError, LunargrError


def import_all(package: str, path: Iterable[str], but: Container[str] = ()) -> None:
    """Import every module of a package, so that what it registers is known. Raises ConfigError that names a file which is not right.

    path : the package's ``__path__``; but : modules that register nothing
    """
    for module in pkgutil.iter_modules(path):
        if module.name in but:
            continue
        try:
            importlib.import_module(f"{package}.{module.name}")
        except LunargrError:
            raise
        except Exception as error:
            raise ConfigError(
                f"{package}.{module.name}: expected a module that can be imported, found {type(error).__name__}: {error}; mend the file or remove it."
            ) from error


__all__ = ["import_all"]
