"""Candidate effects behind one registry: what the forward model may lack, one file each.

An effect is a parametric extension of the chain in ``stages/physics/formation``; its slot fixes where it acts, so the
order in which effects are listed never matters within the physics. The list of `lunargr diagnose` is this folder.
"""

from __future__ import annotations

import importlib
import pkgutil

from stages.effects.base import Effect, Survey, Trial, effect_names, get_effect, register

_TOOLS = ("base", "fields", "filters", "extension")
for _module in pkgutil.iter_modules(__path__):
    if _module.name not in _TOOLS:
        importlib.import_module(f"{__name__}.{_module.name}")

from stages.effects.extension import load_extension  # noqa: E402 - it needs the registry filled

__all__ = ["Effect", "Survey", "Trial", "effect_names", "get_effect", "load_extension", "register"]
