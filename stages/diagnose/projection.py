"""Splitting residuals of one site into what the ground does in every image alike, and what the images do.

Per ground pixel, n images see one albedo and one slope. Their errors, unknown but the same in every image, are spanned
by three columns: the image itself (albedo) and its derivatives by both slopes (DEM error). The part of a residual
outside that span is free of texture and, to first order, of DEM error: the dynamic rows. The part inside becomes maps
of relative albedo and slope error, whitened by their own spectrum: the static rows, a weaker channel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from stages.diagnose.chain import Chain

ALBEDO_PRIOR = 0.1  # relative; both priors only keep badly seen pixels from blowing up
SLOPE_PRIOR = math.tan(math.radians(4))
FREE_SLOPES = 6  # images of a site from which two slopes per pixel can be spared
BINS = 12
ALBEDO_BAND, SLOPE_BAND = 0.1, 0.25  # cycles per px


@dataclass
class Rows:
    """Columns split into dynamic (E, n, H, W) and static (E, K, H, W) rows of about unit noise."""

    dynamic: Tensor
    static: Tensor

    def dot(self, other: Rows) -> Tensor:
        """(E, F) inner products over everything."""
        a, b = self.dynamic.flatten(1), other.dynamic.flatten(1)
        return a @ b.T + self.static.flatten(1) @ other.static.flatten(1).T


class Projector:
    """The split for one site, linear and the same for every column.

    weight : (n, H, W), 1 / noise, 0 where masked
    """

    def __init__(self, chain: Chain, weight: Tensor) -> None:
        self.weight = weight
        columns = [chain.textured * weight]
        priors = [ALBEDO_PRIOR]
        if len(weight) >= FREE_SLOPES:
            columns += [t * weight for t in chain.slope_tangents()]
            priors += [SLOPE_PRIOR, SLOPE_PRIOR]
        self.basis: list[Tensor] = []
        k = len(columns)
        upper = torch.zeros(k, k, *weight.shape[1:])
        for j, column in enumerate(columns):
            for i, q in enumerate(self.basis):
                upper[i, j] = (q * column).sum(0)
                column = column - q * upper[i, j]
            norm = column.square().sum(0).sqrt()
            upper[j, j] = norm
            self.basis.append(torch.where(norm > 1e-4 * weight.amax(), column / norm.clamp(min=1e-12), 0.0))
        r = upper.permute(2, 3, 0, 1).double()
        penalty = torch.diag(torch.tensor([1 / p**2 for p in priors], dtype=torch.float64))
        inverse = torch.linalg.solve(r.transpose(-1, -2) @ r + penalty, r.transpose(-1, -2))
        self.back = inverse.permute(2, 3, 0, 1).float()  # (K, K, H, W): coefficients -> maps
        self.filter: Tensor | None = None

    @property
    def dynamic_rows(self) -> int:
        """Degrees of freedom of the dynamic rows."""
        used = sum(float((q.abs().sum(0) > 0).sum()) for q in self.basis)
        return max(int(float((self.weight > 0).sum()) - used), 0)

    def split(self, columns: Tensor, weighted: bool = False) -> tuple[Tensor, Tensor]:
        """(E, n, H, W) -> dynamic part, weighted; static maps (E, K, H, W), not yet whitened."""
        x = columns if weighted else columns * self.weight
        found = []
        for q in self.basis:
            c = (x * q).sum(1)
            x = torch.addcmul(x, q, c[:, None], value=-1)
            found.append(c)
        return x, self.maps(torch.stack(found, 1))

    def maps(self, coefficients: Tensor) -> Tensor:
        """Coefficients on the basis (E, K, H, W) -> maps of albedo and slope errors."""
        return torch.einsum("ijhw,ejhw->eihw", self.back, coefficients)

    def learn_spectrum(self, maps: Tensor) -> None:
        """Set the whitening filter from the residual's own maps (K, H, W)."""
        height, width = maps.shape[-2:]
        power = torch.fft.rfft2(maps).abs().square() / (height * width)
        ky, kx = torch.fft.fftfreq(height)[:, None], torch.fft.rfftfreq(width)
        k = torch.sqrt(ky**2 + kx**2).clamp(min=0.5 / max(height, width))
        place = (k / k.min()).log() / (k.max() / k.min()).log() * (BINS - 1)
        low = place.floor().long().clamp(max=BINS - 2)
        share = place - low
        filters = []
        for p in power:
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
        # a given DEM's shortest slopes are noise of its own: what follows terrain is sought at longer wavelengths
        shortest = [ALBEDO_BAND] + [SLOPE_BAND] * (len(filters) - 1)
        self.filter = torch.stack([f * torch.exp(-((k / b) ** 2)) for f, b in zip(filters, shortest, strict=True)])
        self.filter[:, 0, 0] = 0.0  # the mean belongs to the nominal model

    def whiten(self, maps: Tensor) -> Tensor:
        """Static maps (E, K, H, W) -> rows of unit noise."""
        if self.filter is None:
            raise RuntimeError("learn_spectrum comes before whiten")
        return torch.fft.irfft2(torch.fft.rfft2(maps) * self.filter, s=maps.shape[-2:])

    def rows(self, columns: Tensor) -> Rows:
        """(E, n, H, W) in I/F -> rows."""
        dynamic, maps = self.split(columns)
        return Rows(dynamic, self.whiten(maps))


class Local:
    """Columns of single images (shifts, gains), which live in one image and reach the others through the projection.

    columns : (n, k, H, W) in I/F
    """

    def __init__(self, projector: Projector, columns: Tensor, prior: Tensor | None = None) -> None:
        self.projector = projector
        self.raw = columns * projector.weight[:, None]
        n, k = columns.shape[:2]
        on_basis = torch.stack([self.raw * q[:, None] for q in projector.basis], 2)  # (n, k, K, H, W)
        flat = on_basis.flatten(0, 1)
        self.static = projector.whiten(projector.maps(flat))
        b, s = flat.flatten(1), self.static.flatten(1)
        gram = s @ s.T - b @ b.T
        raw = self.raw.flatten(2)
        own = raw @ raw.transpose(1, 2)
        for i in range(n):
            gram[i * k : (i + 1) * k, i * k : (i + 1) * k] += own[i]
        self.gram = gram.double()
        if prior is not None:
            self.gram = self.gram + torch.diag(prior.double().repeat(n))

    def cross(self, rows: Rows) -> Tensor:
        """(n k, E) inner products with columns that are projected already."""
        n, k = self.raw.shape[:2]
        dynamic = torch.einsum("nkx,enx->nke", self.raw.flatten(2), rows.dynamic.flatten(2)).reshape(n * k, -1)
        return (dynamic + self.static.flatten(1) @ rows.static.flatten(1).T).double()

    def fit(self, rows: Rows) -> Tensor:
        """Least-squares coefficients (n k, E)."""
        ridge = 1e-9 * self.gram.diagonal().mean().clamp(min=1e-30)
        return torch.linalg.solve(self.gram + ridge * torch.eye(len(self.gram), dtype=torch.float64), self.cross(rows))

    def remove(self, rows: Rows) -> Rows:
        """The rows without what the local columns can explain."""
        n, k = self.raw.shape[:2]
        fitted = self.fit(rows).float()
        image = torch.einsum("nkx,nke->enx", self.raw.flatten(2), fitted.view(n, k, -1))
        image = image.view(-1, n, *self.raw.shape[2:])
        for q in self.projector.basis:
            image = torch.addcmul(image, q, (image * q).sum(1, keepdim=True), value=-1)
        static = torch.einsum("fx,fe->ex", self.static.flatten(1), fitted).view(-1, *self.static.shape[1:])
        return Rows(rows.dynamic - image, rows.static - static)
