"""Names of a package that are imported when they are first asked for: the command's help must answer at once."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from typing import Any


def imported_later(package: str, *modules: str) -> Callable[[str], Any]:
    """The package's ``__getattr__``, for what its ``__all__`` lists.

    modules : of the package, in which a name is looked for in this order
    """

    def find(name: str) -> Any:
        # Others may be modules of the package, which Python then imports itself.
        for module in modules if name in sys.modules[package].__all__ else ():
            loaded = importlib.import_module(f"{package}.{module}")
            if name in vars(loaded):
                return vars(loaded)[name]
        raise AttributeError(f"module '{package}' has no attribute '{name}'")

    return find
