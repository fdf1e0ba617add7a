"""Modules that are imported when they are first used: short commands must answer at once."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any


def imported_later(package: str, *modules: str) -> Callable[[str], Any]:
    """A package's ``__getattr__``, which looks for the names in its ``__all__`` in these of its modules, in order."""

    def find(name: str) -> Any:
        # A name that ``__all__`` lacks may be a module of the package, which Python then imports itself.
        for module in modules if name in sys.modules[package].__all__ else ():
            loaded = importlib.import_module(f"{package}.{module}")
            if name in vars(loaded):
                return vars(loaded)[name]
        raise AttributeError(f"module '{package}' has no attribute '{name}'")

    return find


class _StandIn(ModuleType):
    """Stands for a module until one of its attributes is used; importlib's LazyLoader loads at `import name`."""

    def __getattr__(self, attribute: str) -> Any:
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]
        return getattr(importlib.import_module(self.__name__), attribute)


def import_when_used(name: str) -> None:
    """Let ``import name`` cost nothing until something of the module is used, as ``from name import ...`` does at once.

    Nothing changes where the module is loaded, or not installed.
    """
    spec = None if name in sys.modules else importlib.util.find_spec(name)
    if spec is not None:
        sys.modules[name] = _StandIn(name)
        sys.modules[name].__spec__ = spec
