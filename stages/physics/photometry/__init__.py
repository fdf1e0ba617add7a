"""Reflectance models behind one registry. The one rule of this package:

    every model returns the radiance factor I/F = pi r, with r the bidirectional reflectance (sr^-1).

I/F INCLUDES cos(incidence) and is normalised for the Sun's distance. The reflectance factor is I/F / cos(incidence),
the BRDF is I/F / (pi cos(incidence)).

A new model is one new file in this folder: it subclasses ReflectanceModel and decorates itself with @register.
"""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from stages.physics.geometry import Angles
from stages.physics.photometry.base import Parameter, ReflectanceModel, get_model, model_names, register

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")


def masked_radiance_factor(model: ReflectanceModel, parameters: Mapping[str, Tensor], angles: Angles) -> Tensor:
    """I/F, exactly 0 (with zero gradient, never NaN) where the Sun or the camera is behind the surface."""
    lit = (angles.cos_incidence > 0) & (angles.cos_emission > 0)
    return torch.where(
        lit, model.radiance_factor(parameters, angles), torch.zeros((), dtype=angles.cos_incidence.dtype)
    )


def evaluate(model: str, parameters: Mapping[str, Any], incidence: Any, emission: Any, phase: Any) -> Any:
    """I/F of the model called ``model`` at angles in radians; arrays in, array out; tensors in, tensor out.

    parameters : name -> number or array that broadcasts with the angles; missing names take their defaults.
    Raises RegistryError for an unknown model or parameter.
    """
    reflectance = get_model(model)
    names = [p.name for p in reflectance.parameters]
    for name in parameters:
        if name not in names:
            from schemas.errors import RegistryError

            raise RegistryError.unknown(f"parameter of {reflectance.name}", name, names)
    given = [incidence, emission, phase, *parameters.values()]
    as_tensor = any(isinstance(v, Tensor) for v in given)
    full = {**reflectance.defaults(), **parameters}
    tensors = {
        k: torch.as_tensor(v) if isinstance(v, Tensor) else torch.as_tensor(np.asarray(v, float))
        for k, v in full.items()
    }
    i, e, g = (
        v if isinstance(v, Tensor) else torch.as_tensor(np.asarray(v, dtype=float))
        for v in (incidence, emission, phase)
    )
    result = masked_radiance_factor(reflectance, tensors, Angles.from_angles(i, e, g))
    return result if as_tensor else result.numpy()[()]


__all__ = [
    "Parameter",
    "ReflectanceModel",
    "evaluate",
    "get_model",
    "masked_radiance_factor",
    "model_names",
    "register",
]
