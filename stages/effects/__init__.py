"""Candidate effects behind one registry: what the forward model may lack, one file each.

An effect is a parametric extension of the chain in ``stages/physics/formation``; its slot fixes where it acts, so the
order in which effects are listed never matters within the physics. The list of `lunargr diagnose` is this folder.
"""

from __future__ import annotations

from stages.common.registry import import_all
from stages.effects.base import Effect, Survey, Trial, effect_names, get_effect, register

import_all(__name__, __path__, but=("base", "fields", "filters", "extension"))

from stages.effects.extension import load_extension  # noqa: E402 - it needs the registry filled

__all__ = ["Effect", "Survey", "Trial", "effect_names", "get_effect", "load_extension", "register"]
