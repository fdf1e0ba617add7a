"""Reflectance models behind one registry. The one rule of this package:

    every model returns the radiance factor I/F = pi r, with r the bidirectional reflectance (sr^-1).

I/F INCLUDES cos(incidence) and is normalised for the Sun's distance. The reflectance factor is I/F / cos(incidence),
the BRDF is I/F / (pi cos(incidence)).

A new model is one new file in this folder: it subclasses ReflectanceModel and decorates itself with @register.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from schemas.errors import RegistryError
from stages.common.registry import import_all
from stages.physics.formation.geometry import Angles
from stages.physics.photometry.base import (
    Parameter,
    ReflectanceModel,
    get_model,
    horizon_cosine,
    lambert_albedo,
    masked_radiance_factor,
    model_names,
    named_model,
    register,
)
from stages.physics.photometry.published import ParameterSet, get_set, published_sets

import_all(__name__, __path__)


def evaluate(model: str, parameters: Mapping[str, Any], incidence: Any, emission: Any, phase: Any) -> Any:
    """I/F of the model called ``model`` at angles in radians; arrays in, array out; tensors in, tensor out.

    parameters : name -> number or array that broadcasts with the angles; missing names take their defaults. A parameter
        in radians is also taken in degrees under its name with ``_deg``.
    Computes in float64 unless every array (or tensor) given is float32.
    Raises RegistryError for an unknown model or parameter.
    """
    reflectance = get_model(model)
    full = {**reflectance.defaults(), **in_radians(reflectance, parameters)}
    given = {"incidence": incidence, "emission": emission, "phase": phase, **full}
    as_tensor = any(isinstance(v, torch.Tensor) for v in given.values())
    tensors = {k: v if isinstance(v, torch.Tensor) else torch.from_numpy(np.array(v)) for k, v in given.items()}
    single = {t.dtype for t in tensors.values() if t.ndim} == {torch.float32}
    dtype = torch.float32 if single else torch.float64
    device = next((t.device for t in tensors.values() if t.device.type != "cpu"), torch.device("cpu"))
    tensors = {k: t.to(device, dtype) for k, t in tensors.items()}
    angles = Angles.from_angles(*(tensors.pop(k) for k in ("incidence", "emission", "phase")))
    result = masked_radiance_factor(reflectance, tensors, angles)
    return result if as_tensor else result.numpy()[()]


def in_radians(model: ReflectanceModel, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """The parameters under their own names, with NAME_deg turned into NAME; RegistryError for a name not known."""
    degrees = {f"{p.name}_deg": p.name for p in model.parameters if p.unit == "rad"}
    names = [p.name for p in model.parameters]
    known: dict[str, Any] = {}
    for name, value in parameters.items():
        if name in degrees:
            known[degrees[name]] = value * (math.pi / 180) if isinstance(value, torch.Tensor) else np.radians(value)
        elif name in names:
            known[name] = value
        else:
            raise RegistryError.unknown(f"parameter of {model.name}", name, [*names, *degrees])
    return known


__all__ = [
    "Parameter",
    "ParameterSet",
    "ReflectanceModel",
    "evaluate",
    "get_model",
    "get_set",
    "horizon_cosine",
    "in_radians",
    "lambert_albedo",
    "masked_radiance_factor",
    "model_names",
    "named_model",
    "published_sets",
    "register",
]
