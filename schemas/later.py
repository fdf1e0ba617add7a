"""What is imported when it is first asked for: short commands must answer at once."""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Callable
from types import ModuleType
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


class _StandIn(ModuleType):
    """A module's place until something of it is asked for. Not importlib's LazyLoader: for it, `import name` asks already."""

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
