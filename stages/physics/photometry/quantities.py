"""Conversions between the quantities that are called reflectance. All models here give I/F.

bidirectional reflectance   r                 = I/F / pi               sr^-1   (ASP's Hapke, Hapke's books)
radiance factor             I/F = RADF        = pi r                   1       (ISIS, PDS images, this package)
reflectance factor          REFF              = I/F / cos(i)           1
BRDF                        r / cos(i)        = I/F / (pi cos(i))      sr^-1   (renderers)
"""

from __future__ import annotations

import math
from typing import TypeVar

import numpy as np
import torch

Array = TypeVar("Array", float, np.ndarray, "torch.Tensor")


def to_bidirectional_reflectance(radiance_factor: Array) -> Array:
    """I/F -> r, sr^-1.

    Of a number or (...,) array or tensor.
    """
    return radiance_factor / math.pi


def from_bidirectional_reflectance(reflectance: Array) -> Array:
    """r, sr^-1 -> I/F.

    Of a number or (...,) array or tensor.
    """
    return reflectance * math.pi


def to_reflectance_factor(radiance_factor: Array, cos_incidence: Array) -> Array:
    """I/F -> reflectance factor; cos_incidence must be above 0.

    Of numbers or (...,) arrays or tensors, broadcastable against each other.
    """
    return radiance_factor / cos_incidence


def from_reflectance_factor(reflectance_factor: Array, cos_incidence: Array) -> Array:
    """Reflectance factor -> I/F.

    Of numbers or (...,) arrays or tensors, broadcastable against each other.
    """
    return reflectance_factor * cos_incidence


def to_brdf(radiance_factor: Array, cos_incidence: Array) -> Array:
    """I/F -> BRDF, sr^-1; cos_incidence must be above 0.

    Of numbers or (...,) arrays or tensors, broadcastable against each other.
    """
    return radiance_factor / (math.pi * cos_incidence)


def from_brdf(brdf: Array, cos_incidence: Array) -> Array:
    """BRDF, sr^-1 -> I/F.

    Of numbers or (...,) arrays or tensors, broadcastable against each other.
    """
    return brdf * (math.pi * cos_incidence)
