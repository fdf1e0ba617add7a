"""PyTorch takes most of a short command's time to import: where only names are asked for, it can wait."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import sys
from collections.abc import Iterator
from types import ModuleType
from typing import Any


class _StandIn(ModuleType):
    """Stands for a module until one of its attributes is used; importlib's LazyLoader loads at `import name`."""

    def __getattr__(self, attribute: str) -> Any:
        if sys.modules.get(self.__name__) is self:
            del sys.modules[self.__name__]
        return getattr(importlib.import_module(self.__name__), attribute)


@contextlib.contextmanager
def without(name: str) -> Iterator[None]:
    """Within this block ``import name`` costs nothing until something of the module is used.

    What is imported within the block keeps a stand-in for the module, which then imports it. Nothing changes where the
    module is loaded, or not installed.
    """
    spec = None if name in sys.modules else importlib.util.find_spec(name)
    if spec is None:
        yield
        return
    sys.modules[name] = _StandIn(name)
    sys.modules[name].__spec__ = spec
    try:
        yield
    finally:  # submodules cannot be imported from a stand-in
        if isinstance(sys.modules.get(name), _StandIn):
            del sys.modules[name]
