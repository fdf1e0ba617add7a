"""Names of a package that are imported when they are first asked for: the command's help must answer at once."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any


def imported_later(package: str, where: Mapping[str, str]) -> Callable[[str], Any]:
    """The package's ``__getattr__``. where : name -> the module of the package that holds it"""

    def find(name: str) -> Any:
        if name not in where:
            raise AttributeError(f"module '{package}' has no attribute '{name}'")
        return getattr(importlib.import_module(f"{package}.{where[name]}"), name)

    return find
