"""Splitting residuals of one site into what the ground does in every image alike, and what the images do.

Per ground pixel, n images see one albedo and one slope. Their errors, unknown but the same in every image, are spanned
by three columns: the image itself (albedo) and its derivatives by both slopes (DEM error). The part of a residual
outside that span is free of texture and, to first order, of DEM error: the dynamic rows. The part inside becomes maps
of relative albedo and slope error, whitened by their own spectrum: the static rows, a weaker channel.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property

import torch
from torch import Tensor

from stages.diagnose.chain import Chain

ALBEDO_PRIOR = 0.1  # relative; both priors only keep badly seen pixels from blowing up
SLOPE_PRIOR = math.tan(math.radians(4))
FREE_SLOPES = 6  # images of a site from which two slopes per pixel can be spared
BINS = 12
LOCAL_PRIOR = 1.0  # px of a shift, all of an image's brightness
RIDGE = 1e-6  # of a column's energy: single precision
ALBEDO_BAND, SLOPE_BAND = 0.1, 0.15  # cycles per px

Blocks = Sequence[tuple[slice, slice]]  # rows and columns of each


class Projector:
    """The split for one site, linear and the same for every column.

    weight : (n, H, W), 1 / noise, 0 where masked. Columns are (E, n, H, W), weighted by whoever makes them.
    """

    def __init__(self, chain: Chain, weight: Tensor) -> None:
        self.weight = weight
        columns = [chain.textured * weight]
        priors = [ALBEDO_PRIOR]
        if len(weight) >= FREE_SLOPES:
            columns += [t * weight for t in chain.slope_tangents()]
            priors += [SLOPE_PRIOR, SLOPE_PRIOR]
        basis: list[Tensor] = []
        k = len(columns)
        upper = torch.zeros(k, k, *weight.shape[1:])
        for j, column in enumerate(columns):
            for i, q in enumerate(basis):
                upper[i, j] = (q * column).sum(0)
                column = column - q * upper[i, j]
            norm = column.square().sum(0).sqrt()
            upper[j, j] = norm
            basis.append(torch.where(norm > 1e-4 * weight.amax(), column / norm.clamp(min=1e-12), 0.0))
        self.basis = torch.stack(basis)  # (K, n, H, W), orthonormal per pixel
        self._upper, self._priors = upper, priors
        self.filter: Tensor | None = None

    @cached_property
    def back(self) -> Tensor:
        """(K, K, H, W): coefficients on the basis -> maps."""
        r = self._upper.permute(2, 3, 0, 1).double()
        penalty = torch.diag(torch.tensor([1 / p**2 for p in self._priors], dtype=torch.float64))
        inverse = torch.linalg.solve(r.transpose(-1, -2) @ r + penalty, r.transpose(-1, -2))
        return inverse.permute(2, 3, 0, 1).float()

    @property
    def dynamic_rows(self) -> int:
        """Degrees of freedom of the dynamic rows."""
        used = float((self.basis.abs().sum(1) > 0).sum())
        return max(int(float((self.weight > 0).sum()) - used), 0)

    def coefficients(self, columns: Tensor) -> Tensor:
        """(E, n, H, W) -> coefficients on the basis, (E, K, H, W)."""
        out = columns.new_empty(len(columns), len(self.basis), *columns.shape[-2:])
        for x, c in zip(columns, out, strict=True):  # one column at a time stays in the cache
            for k, q in enumerate(self.basis):
                torch.sum(x * q, 0, out=c[k])
        return out

    def project_(self, columns: Tensor, coefficients: Tensor) -> Tensor:
        """Take the basis' share out of columns (E, n, H, W), in place."""
        for x, c in zip(columns, coefficients, strict=True):
            for k, q in enumerate(self.basis):
                x.addcmul_(q, c[k], value=-1)
        return columns

    def maps(self, coefficients: Tensor) -> Tensor:
        """Coefficients on the basis (E, K, H, W) -> maps of albedo and slope errors."""
        out = torch.zeros_like(coefficients)
        for i in range(len(self.back)):
            for j in range(len(self.back)):
                out[:, i].addcmul_(self.back[i, j], coefficients[:, j])
        return out

    def learn_spectrum(self, maps: Tensor) -> None:
        """Set the whitening filter from the residual's own maps (K, H, W)."""
        height, width = maps.shape[-2:]
        self.window = _tapered(height)[:, None] * _tapered(width)
        power = torch.fft.rfft2(maps * self.window).abs().square() / (height * width)
        ky, kx = torch.fft.fftfreq(height)[:, None], torch.fft.rfftfreq(width)
        k = torch.sqrt(ky**2 + kx**2).clamp(min=0.5 / max(height, width))
        place = (k / k.min()).log() / (k.max() / k.min()).log() * (BINS - 1)
        low = place.floor().long().clamp(max=BINS - 2)
        share = place - low
        filters, firm = [], []
        noise = (self.back.square().sum(1) * self.window.square()).mean((-2, -1))
        for p, n in zip(power, noise, strict=True):
            # weighted means in overlapping bins, in the log-mean-exp sense robust enough for chi-square power
            flat = torch.zeros(BINS)
            norm = torch.zeros(BINS)
            for b, s in ((low, 1 - share), (low + 1, share)):
                flat.index_add_(0, b.flatten(), (p * s).flatten())
                norm.index_add_(0, b.flatten(), s.flatten())
            mean = (flat / norm.clamp(min=1e-9)).clamp(min=1e-30)
            filled = norm > 0
            mean = torch.where(filled, mean, mean[filled].mean())
            smooth = (mean.log()[low] * (1 - share) + mean.log()[low + 1] * share).exp()
            filters.append(smooth.rsqrt())
            firm.append((1 - n / smooth).clamp(min=0))
        self.firm = torch.stack(firm)  # share of each frequency's power that is not the pixels' noise
        # a given DEM's shortest slopes are noise of its own: what follows terrain is sought at longer wavelengths
        shortest = torch.tensor([ALBEDO_BAND] + [SLOPE_BAND] * (len(filters) - 1))[:, None, None]
        self.wavenumber = 2 * math.pi * k  # rad per px
        self.passed = torch.exp(-((k / shortest) ** 2))
        self.passed[:, 0, 0] = 0.0  # the mean belongs to the nominal model
        self.filter = torch.stack(filters) * self.passed

    def whiten(self, maps: Tensor) -> Tensor:
        """Static maps (E, K, H, W) -> rows of unit noise."""
        if self.filter is None:
            raise RuntimeError("learn_spectrum comes before whiten")
        return torch.fft.irfft2(torch.fft.rfft2(maps * self.window) * self.filter, s=maps.shape[-2:])

    def slope_noise(self) -> float:
        """Sum of squares that unit noise of the pixels leaves in the whitened maps of slope errors."""
        if self.filter is None or len(self.back) < 3:
            return 0.0
        variance = (self.back[1:].square().sum(1) * self.window.square()).sum((-2, -1))
        passed = (self.filter[1:].square() * self._both()).sum((-2, -1)) / self.window.numel()
        return float((variance * passed).sum())

    def noise_sharpened(self, sigma2: float) -> float:
        """Product of the given DEM's own noise and what sharpening the DEM by ``sigma2`` px^2 adds to it, in whitened slopes.

        Noise is what the residual's maps have beyond the noise of the images' pixels.
        """
        if self.filter is None or len(self.back) < 3:
            return 0.0
        added = torch.expm1(0.5 * sigma2 * self.wavenumber.square())
        return float((self.passed[1:].square() * self.firm[1:] * added * self._both()).sum())

    def _both(self) -> Tensor:
        """How many frequencies each of the half plane's stands for."""
        both = torch.full((self.wavenumber.shape[-1],), 2.0)
        both[0] = 1.0
        if self.window.shape[-1] % 2 == 0:
            both[-1] = 1.0
        return both


def _tapered(count: int) -> Tensor:
    """A window that falls to zero over an eighth of the crop at either end: borders are no part of a spectrum, (count,)."""
    edge = (torch.arange(count) + 0.5).minimum(count - torch.arange(count) - 0.5) / (count / 8)
    return torch.sin(0.5 * math.pi * edge.clamp(max=1)) ** 2


def cut_out(x: Tensor, blocks: Blocks | None) -> Tensor:
    """(..., H, W) -> (..., N), the pixels of these blocks, or all."""
    if blocks is None:
        return x.flatten(-2)
    return torch.cat([x[..., rows, columns].flatten(-2) for rows, columns in blocks], -1)


class Local:
    """Columns that live in one image each (shifts, gains) and reach the others through the projection.

    Only their dynamic rows count: what one image does to the maps of the ground is lost among twelve.
    columns : (n, k, H, W) in I/F
    """

    def __init__(self, projector: Projector, columns: Tensor) -> None:
        self.raw = columns * projector.weight[:, None]
        # (n k, K, H, W): their coefficients on the basis
        self.coefficients = (self.raw[:, :, None] * projector.basis.transpose(0, 1)[:, None]).flatten(0, 1)
        self.gram = self.products(None)

    def products(self, blocks: Blocks | None) -> Tensor:
        """(n k, n k) inner products after projection, over the pixels of these blocks."""
        raw, on_basis = cut_out(self.raw, blocks), cut_out(self.coefficients, blocks)
        n, k = raw.shape[:2]
        gram = -(on_basis.flatten(1) @ on_basis.flatten(1).T)
        own = raw @ raw.transpose(1, 2)
        for i in range(n):
            gram[i * k : (i + 1) * k, i * k : (i + 1) * k] += own[i]
        return gram.double()

    def cross(self, columns: Tensor, coefficients: Tensor | None, blocks: Blocks | None = None) -> Tensor:
        """(n k, E) inner products with weighted columns (E, n, H, W) of known coefficients (E, K, H, W), None for zeros."""
        raw, x = cut_out(self.raw, blocks), cut_out(columns, blocks)
        own = torch.cat([r @ x[:, i].T for i, r in enumerate(raw)]).double()
        if coefficients is None:
            return own
        shared = cut_out(self.coefficients, blocks).flatten(1) @ cut_out(coefficients, blocks).flatten(1).T
        return own - shared

    def remove_(self, columns: Tensor, coefficients: Tensor) -> None:
        """Take what the local columns can explain out of weighted columns and their coefficients, in place."""
        n, k = self.raw.shape[:2]
        # an image that shows next to nothing bounds its values no better than what is ordinary; and what rounding
        # leaves of a column that the ground can imitate is no column
        energy = self.raw.double().square().sum((-2, -1)).flatten()
        normal = self.gram + torch.diag(LOCAL_PRIOR**-2 + RIDGE * energy)
        scale = normal.diagonal().rsqrt()
        solved = torch.linalg.solve(normal * scale[:, None] * scale, self.cross(columns, coefficients) * scale[:, None])
        fitted = (solved * scale[:, None]).float()
        flat, raw = columns.flatten(-2), self.raw.flatten(-2)
        for i in range(n):
            flat[:, i] -= fitted[i * k : (i + 1) * k].T @ raw[i]
        coefficients.flatten(1).addmm_(fitted.T, self.coefficients.flatten(1), alpha=-1)
