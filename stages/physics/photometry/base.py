"""The interface of every reflectance model: named, bounded, cited parameters and a differentiable formula for I/F."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import torch

from schemas.errors import ArtefactError, RegistryError
from stages.physics.formation.geometry import Angles

if TYPE_CHECKING:
    import h5py


@dataclass(frozen=True)
class Parameter:
    """One parameter of a model: bounds are physical limits, the default is a published lunar value where there is one."""

    name: str
    unit: str
    lower: float
    upper: float
    default: float
    description: str


STANDARD = math.radians(30)  # incidence and phase of the standard geometry (30, 0, 30) of maps and laboratories
ALBEDO = Parameter("albedo", "1", 0.0, 1.0, 0.12, "normal albedo: I/F at incidence = emission = phase = 0")


class ReflectanceModel(ABC):
    """Base of every reflectance model. Subclasses fill the class attributes and ``radiance_factor``."""

    name: ClassVar[str]
    title: ClassVar[str]
    formula: ClassVar[str]
    reference: ClassVar[str]
    reciprocal: ClassVar[bool]
    parameters: ClassVar[tuple[Parameter, ...]]
    # Parameters that a network predicts pixel by pixel by default; the rest is fitted globally. Empty: every parameter.
    default_maps: ClassVar[tuple[str, ...]] = ()
    # I/F is a linear function of the parameters, so that a global fit is one least-squares solve.
    linear: ClassVar[bool] = False
    # The formula and its gradients are finite for any cosines in [-1, 1], which need not be clamped away from 0 then.
    finite: ClassVar[bool] = False
    # The same formula in GLSL ES 3.00 for the page of `lunargr view`; None: it has no page. It defines
    #     float radiance_factor(float p[COUNT], float mu0, float mu, float cos_g)
    # with p in the order of ``parameters`` and both cosines above 0, and may use PI and phase_angle(cos_g).
    glsl: ClassVar[str | None] = None

    @abstractmethod
    def radiance_factor(self, parameters: Mapping[str, torch.Tensor], angles: Angles) -> torch.Tensor:
        """I/F = pi r, including cos(incidence), wherever incidence and emission are below 90 deg.

        parameters : tensors that broadcast with the angles. Callers use :func:`evaluate`, which masks the rest.
        """

    def constrain(self, raw: torch.Tensor, dim: int, names: Sequence[str] | None = None) -> torch.Tensor:
        """Network outputs -> parameters within their bounds (sigmoid between lower and upper).

        names : the parameters along ``dim``; all of them where None
        raw : (..., C, ...) with the parameters along ``dim``
        """
        low, high = self._bounds(raw, dim, names)
        return low + (high - low) * torch.sigmoid(raw)

    def unconstrain(self, value: torch.Tensor, dim: int, names: Sequence[str] | None = None) -> torch.Tensor:
        """Inverse of :meth:`constrain`, for starting a network at known coefficients.

        value : (..., C, ...) with the parameters along ``dim``
        """
        low, high = self._bounds(value, dim, names)
        return torch.logit(((value - low) / (high - low)).clamp(1e-6, 1 - 1e-6))

    def _bounds(self, like: torch.Tensor, dim: int, names: Sequence[str] | None) -> tuple[torch.Tensor, torch.Tensor]:
        """Lower and upper bounds along ``dim``, on the device of ``like``."""
        chosen = [p for p in self.parameters if names is None or p.name in names]
        shape = [1] * like.ndim
        shape[dim] = len(chosen)
        bounds = ([p.lower for p in chosen], [p.upper for p in chosen])
        low, high = (torch.tensor(b, dtype=like.dtype, device=like.device).view(shape) for b in bounds)
        return low, high

    def choose_maps(self, wanted: Sequence[str] = ()) -> tuple[str, ...]:
        """The parameters to predict pixel by pixel, in the model's order; by default ``default_maps``, or all.

        Raises RegistryError for a name that is not a parameter.
        """
        names = [p.name for p in self.parameters]
        for name in wanted:
            if name not in names:
                raise RegistryError.unknown(f"parameter of {self.name}", name, names)
        chosen = wanted or self.default_maps or names
        return tuple(name for name in names if name in chosen)

    def unpack(self, coefficients: torch.Tensor | Mapping[str, torch.Tensor], dim: int) -> dict[str, torch.Tensor]:
        """A stack of coefficients, in the order of ``parameters``, -> parameters by name. A mapping by name is copied.

        coefficients : (..., C, ...) with the parameters along ``dim``; returns each without that axis
        """
        if not isinstance(coefficients, torch.Tensor):
            return dict(coefficients)
        # unbind and not select: its backward is one stack, where select writes a full stack of zeros per parameter
        return dict(zip((p.name for p in self.parameters), coefficients.unbind(dim), strict=True))

    def defaults(self) -> dict[str, float]:
        return {p.name: p.default for p in self.parameters}


def horizon_cosine(dtype: torch.dtype) -> float:
    """Cosines at or under this count as 0: cos(90 deg) is 6e-17, not 0, in float64, and -4e-8 in float32."""
    return 1e-12 if dtype == torch.float64 else 1e-7


def masked_radiance_factor(
    model: ReflectanceModel, parameters: Mapping[str, torch.Tensor], angles: Angles
) -> torch.Tensor:
    """I/F, exactly 0 (with zero gradient, never NaN) where the Sun or the camera is behind the surface.

    parameters : by name, each broadcasting with the angles (...,)
    """
    mu0, mu = angles.cos_incidence, angles.cos_emission
    floor = horizon_cosine(mu0.dtype)
    lit = (mu0 > floor) & (mu > floor)
    if not model.finite:
        # torch.where passes gradient 0 to the branch not taken, and 0 * inf is NaN: the formula must not see angles
        # at which it or its slope is infinite.
        angles = replace(angles, cos_incidence=mu0.clamp(min=floor), cos_emission=mu.clamp(min=floor))
    value = model.radiance_factor(parameters, angles)
    return torch.where(lit, value, torch.zeros((), dtype=value.dtype, device=value.device))


def lambert_albedo(model: ReflectanceModel, parameters: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Of a diffuse facet that reflects as much as the model's at incidence 30, emission 0 and phase 30 deg.

    parameters : by name, each (...) or what broadcasts to it; returns (...)
    """
    incidence = torch.full_like(next(iter(torch.broadcast_tensors(*parameters.values()))), STANDARD)
    angles = Angles.from_angles(incidence, torch.zeros_like(incidence), incidence)
    return masked_radiance_factor(model, parameters, angles).clamp(min=0) / math.cos(STANDARD)


_MODELS: dict[str, ReflectanceModel] = {}


def register(cls: type[ReflectanceModel]) -> type[ReflectanceModel]:
    """Class decorator: make a model known under its name (case does not matter)."""
    _MODELS[cls.name.lower()] = cls()
    return cls


def get_model(name: str) -> ReflectanceModel:
    """The model called ``name``. Raises RegistryError with the choices."""
    try:
        return _MODELS[name.lower()]
    except KeyError:
        raise RegistryError.unknown("reflectance model", name, model_names()) from None


def named_model(path: Path, file: h5py.File) -> ReflectanceModel:
    """The model that an open artefact names. Raises ArtefactError for one that is not registered."""
    try:
        return get_model(str(file.attrs["model"]))
    except RegistryError as error:
        raise ArtefactError(f"{path}: root attribute 'model': {error}") from None


def model_names() -> list[str]:
    """The registered models, in the order of their modules."""
    return [m.name for m in _MODELS.values()]
