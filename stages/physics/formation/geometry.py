"""Surface normals and photometric angles of a height field, differentiable in elevation, Sun and camera."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch


@dataclass(frozen=True)
class Angles:
    """Incidence, emission and phase of every pixel, as cosines; the angles are worked out where a model asks for them.

    cos_incidence, cos_emission, cos_phase : (...,) tensors, negative where the Sun or the camera is behind the surface
    incidence_given, emission_given, phase_given : (...,) rad, where the angles themselves are known, see :meth:`from_angles`
    """

    cos_incidence: torch.Tensor
    cos_emission: torch.Tensor
    cos_phase: torch.Tensor
    incidence_given: torch.Tensor | None = None
    emission_given: torch.Tensor | None = None
    phase_given: torch.Tensor | None = None

    @classmethod
    def from_angles(cls, incidence: torch.Tensor, emission: torch.Tensor, phase: torch.Tensor) -> Angles:
        """From angles in radians, kept as given so that nothing is lost near phase 0.

        incidence, emission, phase : (...,) each, broadcastable
        """
        return cls(incidence.cos(), emission.cos(), phase.cos(), incidence, emission, phase)

    @cached_property
    def incidence(self) -> torch.Tensor:
        """rad"""
        return safe_acos(self.cos_incidence) if self.incidence_given is None else self.incidence_given

    @cached_property
    def emission(self) -> torch.Tensor:
        """rad"""
        return safe_acos(self.cos_emission) if self.emission_given is None else self.emission_given

    @cached_property
    def phase(self) -> torch.Tensor:
        """rad"""
        return safe_acos(self.cos_phase) if self.phase_given is None else self.phase_given


def safe_acos(cosine: torch.Tensor) -> torch.Tensor:
    """acos with finite gradients at +-1: the argument keeps 1e-7 (float32) or 1e-14 (float64) away from them.

    cosine : (...,); returns the same shape, rad
    """
    margin = 1e-14 if cosine.dtype == torch.float64 else 1e-7
    return torch.acos(cosine.clamp(-1 + margin, 1 - margin))


def slopes(elevation: torch.Tensor, gsd: float) -> tuple[torch.Tensor, torch.Tensor]:
    """(dz/deast, dz/dnorth) by second-order central differences, one-sided at the edges.

    elevation : (..., H, W), m, rows run south
    """
    east = torch.empty_like(elevation)
    north = torch.empty_like(elevation)
    east[..., :, 1:-1] = (elevation[..., :, 2:] - elevation[..., :, :-2]) / (2 * gsd)
    east[..., :, 0] = (elevation[..., :, 1] - elevation[..., :, 0]) / gsd
    east[..., :, -1] = (elevation[..., :, -1] - elevation[..., :, -2]) / gsd
    north[..., 1:-1, :] = (elevation[..., :-2, :] - elevation[..., 2:, :]) / (2 * gsd)
    north[..., 0, :] = (elevation[..., 0, :] - elevation[..., 1, :]) / gsd
    north[..., -1, :] = (elevation[..., -2, :] - elevation[..., -1, :]) / gsd
    return east, north


def crop_axes(
    height: int, width: int, gsd: float, device: torch.device | str = "cpu"
) -> tuple[torch.Tensor, torch.Tensor]:
    """East (W,) and north (H,) of the pixel centres from the crop's centre, m.

    The centre is the corner shared by the four middle pixels for even sizes.
    """
    east = (torch.arange(width, dtype=torch.float32, device=device) - (width - 1) / 2) * gsd
    north = ((height - 1) / 2 - torch.arange(height, dtype=torch.float32, device=device)) * gsd
    return east, north


def curvature_slopes(
    slope_east: torch.Tensor, slope_north: torch.Tensor, gsd: float, body_radius: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Tilt slopes on the sphere into the tangent plane at the crop's centre, where the Sun's direction is given.

    The surface falls away from that plane as d^2 / 2R, so its slope gains -d / R (1 deg per 30 km on the Moon).

    slope_east, slope_north : (..., H, W); gsd, body_radius : m
    """
    height, width = slope_east.shape[-2:]
    east, north = crop_axes(height, width, gsd, slope_east.device)
    return slope_east - east / body_radius, slope_north - north[:, None] / body_radius


def view_vectors(
    elevation: torch.Tensor, camera_position: torch.Tensor, gsd: float
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Unit vectors (east, north, up), each (B, H, W), from every pixel to the camera.

    elevation : (B, H, W), m; camera_position : (B, 3), m from the crop centre at the crop's mean elevation.
    """
    height, width = elevation.shape[-2:]
    east, north = crop_axes(height, width, gsd, elevation.device)
    camera = camera_position.to(elevation.dtype)
    x = camera[:, 0, None, None] - east
    y = camera[:, 1, None, None] - north[:, None]
    z = camera[:, 2, None, None] - (elevation - elevation.mean(dim=(-2, -1), keepdim=True))
    inverse = torch.rsqrt(x * x + y * y + z * z)
    return x * inverse, y * inverse, z * inverse


def photometric_angles(
    slope_east: torch.Tensor,
    slope_north: torch.Tensor,
    sun_direction: torch.Tensor,
    view: tuple[torch.Tensor, torch.Tensor, torch.Tensor],
) -> Angles:
    """Angles of a surface with these slopes.

    slope_east, slope_north : (B, H, W); sun_direction : (B, 3) or (B, 3, H, W), unit; view : three (B, H, W)
    """
    inverse = torch.rsqrt(1 + slope_east * slope_east + slope_north * slope_north)
    sun = sun_direction.to(slope_east.dtype)
    sx, sy, sz = (sun if sun.ndim == 4 else sun[:, :, None, None]).unbind(1)
    vx, vy, vz = view
    cos_incidence = (sz - slope_east * sx - slope_north * sy) * inverse
    cos_emission = (vz - slope_east * vx - slope_north * vy) * inverse
    cos_phase = sx * vx + sy * vy + sz * vz
    return Angles(cos_incidence, cos_emission, cos_phase)
