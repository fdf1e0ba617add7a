"""Fit of one displacement to the shifts of an image's blocks, in the simplest form that cross-validation does not reject."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from schemas.errors import GeometryError
from stages.common.arrays import Floats, Mask
from stages.physics.images.displacement import FORMS, Basis, Field
from stages.physics.images.registration import Shift

LEAST_BLOCKS = {"constant": 4, "affine": 8, "field": 12}
WORST_FIELD_SIGMA_PX = 0.25
WORST_SCATTER_PX = 1.5
LEAST_ACCEPTED = 0.2  # share of the blocks tried
OUTLIER = 3.5  # standard deviations from the fit beyond which a block is left out
LEAST_SIGMA_PX = 0.02  # resampling alone is no better
MOST_CELLS = 8  # of a field's knots along its longer side
STIFFNESS = tuple(4.0**k for k in range(-5, 6))  # weights of a field's bending against the blocks' misfit
FOLDS = 8  # of the cross-validation
COARSE_STEPS = 5  # first iterations, which leave no block out yet


@dataclass(frozen=True)
class _Blocks:
    """Accepted blocks. row, col : (n,); shift : (n, 2) dx, dy; covariance : (n, 2, 2); relief : (n, 2) mean px or None.

    The relief's share fitted within each block is not used: errors of the DEM bias it (on Apollo frames the share of the
    image came out .76 with it, .91 without, and held-out ground was explained worse).
    """

    row: Floats
    col: Floats
    shift: Floats
    covariance: Floats
    relief: Floats | None

    @property
    def sigma(self) -> Floats:
        return np.sqrt(np.maximum(self.covariance[:, [0, 1], [0, 1]].max(axis=1), LEAST_SIGMA_PX**2))


@dataclass(frozen=True)
class _Solution:
    """One least-squares fit of p = 2 size [+ 1] parameters.

    theta : (p,) coefficients of dx and dy, and the relief's share; covariance : (p, p) of them
    keep : (n,) blocks that are no outliers; scatter : px; freedom : parameters per axis
    design : (n, 2, p); rows, values : (2 n, p) and (2 n,) weighted equations; penalty : (p, p) added to their normal matrix
    """

    theta: Floats
    covariance: Floats
    keep: Mask
    scatter: float
    freedom: float
    design: Floats
    rows: Floats
    values: Floats
    penalty: Floats


def fit_field(
    shifts: Sequence[Shift], row: ArrayLike, col: ArrayLike, form: str = "constant", reference: float | None = None
) -> Field:
    """One displacement of a whole image from the shifts of its blocks.

    row, col : (n,) px, the blocks' middles on the grid
    form : the most general of FORMS that may be taken. One beyond 'constant', and relief displacement, is taken where it
    predicts held-out blocks better, by more than the standard error of that gain.
    reference : m, the height that relief does not displace; None where relief displacement is not to be tried
    Blocks that disagree with the rest are left out; where the evidence is too poor, ``Field.refused`` holds the reason.
    """
    if form not in FORMS:
        raise GeometryError(f"registration: expected 'constant', 'affine' or 'field', found '{form}'.")
    row, col = np.asarray(row, float), np.asarray(col, float)
    good = np.array([s.accepted for s in shifts], bool)
    middle = (float(row.mean()), float(col.mean())) if len(shifts) else (0.0, 0.0)
    nothing = Field(Basis("constant", middle), np.zeros((2, 1)), int(good.sum()), len(shifts), math.inf, math.inf, 0.0)
    needed = min(LEAST_BLOCKS["constant"], max(1, len(shifts)))
    if good.sum() < max(needed, LEAST_ACCEPTED * len(shifts)):
        first = next((s.refused for s in shifts if s.refused), "no region was tried")
        return replace(
            nothing, refused=f"{int(good.sum())} of {len(shifts)} regions agree with the rendering (elsewhere: {first})"
        )
    kept = [s for s in shifts if s.accepted]
    blocks = _Blocks(
        row[good],
        col[good],
        np.array([(s.dx, s.dy) for s in kept]),
        np.array([s.place_covariance for s in kept]),
        np.array([s.relief for s in kept]) if reference is not None else None,
    )
    chosen = _choose(blocks, form, middle)
    found = chosen.whole
    if found is None or found.keep.sum() < needed / 2:
        return replace(nothing, refused=f"its {len(kept)} usable regions contradict each other")
    n = chosen.basis.size
    coefficients = found.theta[: 2 * n].reshape(2, n)
    parts = chosen.basis.matrix(blocks.row, blocks.col)
    mean = parts[found.keep].mean(axis=0)
    error = math.sqrt(max(float(mean @ found.covariance[part, part] @ mean) for part in (np.s_[:n], np.s_[n : 2 * n])))
    scatter = max(found.scatter, float(np.median(blocks.sigma)))
    field = Field(
        chosen.basis,
        coefficients,
        int(found.keep.sum()),
        len(shifts),
        scatter,
        math.hypot(error, scatter),
        float(np.median([s.correlation for s in kept])),
        float(found.theta[-1]) if chosen.relief else 0.0,
        chosen.share_error,
        reference or 0.0,
        (float(mean @ coefficients[0]), float(mean @ coefficients[1])),
        found.freedom,
        chosen.held_out,
    )
    if scatter > WORST_SCATTER_PX:
        return replace(field, refused=f"its regions scatter by {scatter:.2f} px")
    if error > WORST_FIELD_SIGMA_PX:
        return replace(field, refused=f"the shift is uncertain by {error:.2f} px")
    return field


# --- which form -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Candidate:
    """One form. whole : its fit to all blocks; loss : (n,) of each block where it was held out"""

    basis: Basis
    relief: bool
    whole: _Solution | None
    loss: Floats
    share_error: float = math.nan
    held_out: float = math.nan


def _choose(blocks: _Blocks, form: str, middle: tuple[float, float]) -> _Candidate:
    """The simplest form that no more general one beats on held-out blocks by more than the standard error of its lead."""
    folds = _deal_folds(blocks)
    constant = Basis("constant", middle)
    plain = _solve(blocks, constant, False, 0.0)
    if plain is None:
        return _Candidate(constant, False, None, np.array([]))
    bases: list[tuple[Basis, tuple[float, ...]]] = []
    number = len(blocks.row)
    spread = np.linalg.svd(np.stack([blocks.row - blocks.row.mean(), blocks.col - blocks.col.mean()]), compute_uv=False)
    apart = spread.min() > 0.1 * max(spread.max(), 1e-9)
    span = max(np.ptp(blocks.row), np.ptp(blocks.col), 1.0)
    if form != "constant" and number >= LEAST_BLOCKS["affine"] and apart:
        bases.append((Basis("affine", middle, span / 2), (0.0,)))
    if form == "field" and number >= LEAST_BLOCKS["field"] and apart:
        bases.append((_field_basis(blocks), STIFFNESS))
    tried = [
        (basis, relief, [f for k in stiffness if (f := _solve(blocks, basis, relief, k)) is not None])
        for basis, stiffness in bases
        for relief in ((False, True) if blocks.relief is not None else (False,))
    ]
    # one scale for all forms: the smallest scatter among the fits with at least four blocks per parameter
    scatters = [f.scatter for _, _, fits in tried for f in fits if f.freedom < number / 4]
    scale = np.hypot(blocks.sigma, min([plain.scatter, *scatters]))
    best = _Candidate(constant, False, plain, _held_out(blocks, plain, folds, scale)[0])
    for basis, relief, fits in tried:
        outcomes = [(*_held_out(blocks, fit, folds, scale), fit) for fit in fits]
        if not outcomes:
            continue
        loss, shares, fit = min(outcomes, key=lambda outcome: float(outcome[0].mean()))
        lead = np.bincount(folds, weights=best.loss - loss)
        if lead.sum() > math.sqrt(len(lead)) * lead.std(ddof=1):
            best = _Candidate(basis, relief, fit, loss, _jackknife(shares) if relief else math.nan)
    zero = _loss(blocks.shift, scale)
    return replace(best, held_out=1 - float(best.loss.sum()) / max(1e-12, float(zero.sum())))


def _field_basis(blocks: _Blocks) -> Basis:
    """Square cells between knots over all blocks: at least two blocks wide, and at most MOST_CELLS a side."""
    low = np.array([blocks.row.min(), blocks.col.min()])
    extent = np.array([np.ptp(blocks.row), np.ptp(blocks.col)])
    spacing = math.sqrt(float(extent[0] * extent[1]) / len(blocks.row))  # of blocks
    step = max(2 * spacing, float(extent.max()) / MOST_CELLS)
    cells = np.maximum(1, np.ceil(extent / step)).astype(int)
    start = low - (cells * step - extent) / 2
    return Basis("field", (float(start[0]), float(start[1])), step, (int(cells[0]), int(cells[1])))


def _deal_folds(blocks: _Blocks) -> NDArray[np.int64]:
    """(n,) the fold of each block: squares of the ground of about two by two blocks are dealt to FOLDS folds at random."""
    extent = max(1.0, float(np.ptp(blocks.row)) * float(np.ptp(blocks.col)))
    side = 2 * math.sqrt(extent / len(blocks.row)) + 1
    place = np.stack([(blocks.row - blocks.row.min()) // side, (blocks.col - blocks.col.min()) // side], axis=1)
    _, square = np.unique(place, axis=0, return_inverse=True)
    square = square.ravel()
    dealt = np.random.default_rng(0).permutation(square.max() + 1)
    return np.asarray(dealt[square] % min(FOLDS, square.max() + 1))


def _held_out(blocks: _Blocks, fit: _Solution, folds: NDArray[np.int64], scale: Floats) -> tuple[Floats, Floats]:
    """(n,) loss of each block under ``fit`` repeated without its fold, and (folds,) the relief's share each time.

    Outliers stay those of the fit to all blocks.
    """
    loss, shares = _loss(blocks.shift, scale), []
    for fold in range(folds.max() + 1):
        out = folds == fold
        rest = fit.rows[np.repeat(~out, 2)], fit.values[np.repeat(~out, 2)]
        if (fit.keep & ~out).sum() >= 3:
            inverse = np.linalg.inv(rest[0].T @ rest[0] + fit.penalty)
            theta = inverse @ (rest[0].T @ rest[1])
            loss[out] = _loss((blocks.shift - fit.design @ theta)[out], scale[out])
            shares.append(theta[-1])
    return loss, np.array(shares)


def _loss(residual: Floats, scale: Floats) -> Floats:
    """(n,) squared residuals (n, 2) in standard deviations ``scale`` (n,), at most that of an outlier."""
    return np.minimum((residual**2).sum(axis=1) / scale**2, OUTLIER**2)


def _jackknife(values: Floats) -> float:
    """Standard error from estimates (n,) with each fold left out once (Quenouille 1956)."""
    n = len(values)
    return math.sqrt((n - 1) / n * float(((values - values.mean()) ** 2).sum())) if n > 1 else math.nan


# --- one fit --------------------------------------------------------------------------------------------------------


def _solve(blocks: _Blocks, basis: Basis, relief: bool, stiffness: float) -> _Solution | None:
    """Weighted least squares with outliers left out; None where too few blocks agree.

    A block weighs by its own covariance and by the scatter of all; it is an outlier beyond OUTLIER standard deviations.
    Up to a third of the blocks may be bad: at first they weigh little (Cauchy), later they are left out.
    """
    n, size = len(blocks.row), basis.size
    design, bending = _design(blocks, basis, relief)
    shift, free = blocks.shift, design.shape[2]
    least = 2 if basis.form == "constant" else 3
    floor = float(np.median(blocks.sigma))
    residual = shift - np.median(shift, axis=0)
    keep = np.ones(n, bool)
    for k in range(COARSE_STEPS + 15):
        scatter = 1.4826 * float(np.median(np.abs(residual[keep])))
        distance = np.abs(residual).max(axis=1) / np.hypot(blocks.sigma, max(scatter, floor))
        weight = 1 / (1 + distance**2)
        before = keep
        if k >= COARSE_STEPS:
            keep = distance < OUTLIER
            weight = keep.astype(float)
            if keep.sum() < min(least, n):
                return None
        excess = max(0.0, scatter**2 - floor**2) + LEAST_SIGMA_PX**2
        root = np.linalg.cholesky(np.linalg.inv(blocks.covariance + excess * np.eye(2)))
        root = np.swapaxes(root, 1, 2) * np.sqrt(weight)[:, None, None]
        x, y = (root @ design).reshape(2 * n, free), (root @ shift[:, :, None]).reshape(2 * n)
        normal = x.T @ x
        penalty = bending * stiffness * np.trace(normal[:size, :size]) / size
        penalty += 1e-9 * np.trace(normal) / free * np.eye(free)
        inverse = np.linalg.inv(normal + penalty)
        theta = inverse @ (x.T @ y)
        last, residual = residual, shift - design @ theta
        if k > COARSE_STEPS and (before == keep).all() and np.abs(residual - last).max() < 1e-3:
            break
    share = inverse @ normal
    freedom = (float(np.trace(share)) - relief) / 2
    scatter = 1.4826 * float(np.median(np.abs(residual[keep])))
    return _Solution(theta, share @ inverse, keep, scatter, freedom, design, x, y, penalty)


def _design(blocks: _Blocks, basis: Basis, relief: bool) -> tuple[Floats, Floats]:
    """(n, 2, p) design matrix of each block's dx and dy, and (p, p) the quadratic form of the bending."""
    size = basis.size
    parts = basis.matrix(blocks.row, blocks.col)
    design = np.zeros((len(parts), 2, 2 * size + relief))
    design[:, 0, :size], design[:, 1, size : 2 * size] = parts, parts
    if relief and blocks.relief is not None:
        design[:, :, -1] = blocks.relief
    bending = np.zeros((design.shape[2],) * 2)
    bending[: 2 * size, : 2 * size] = np.kron(np.eye(2), basis.bending())
    return design, bending
