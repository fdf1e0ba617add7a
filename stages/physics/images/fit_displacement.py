"""One displacement of a whole image from the shifts of its blocks, as plain as held-out blocks allow."""

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
STIFFNESS = tuple(4.0**k for k in range(-5, 6))  # of a field, against what the blocks say
FOLDS = 8  # of ground that is held out
COARSE_STEPS = 5  # in which no block is left out yet


@dataclass(frozen=True)
class _Blocks:
    """Accepted blocks. row, col : (n,); seen : (n, 2) dx, dy; covariance : (n, 2, 2); relief : (n, 2) mean px or None.

    What relief does within a block was fitted beside its shift, and is not used: errors of the DEM pull it (on Apollo frames
    the share came out .76 with it, .91 without, and held-out ground was explained worse).
    """

    row: Floats
    col: Floats
    seen: Floats
    covariance: Floats
    relief: Floats | None

    @property
    def sigma(self) -> Floats:
        return np.sqrt(np.maximum(self.covariance[:, [0, 1], [0, 1]].max(axis=1), LEAST_SIGMA_PX**2))


@dataclass(frozen=True)
class _Solution:
    """theta : (2 size [+ 1],), dx's and dy's coefficients and the relief's share; covariance of it; off : (n, 2) px, what it
    leaves; keep : (n,) bool, blocks that count; scatter : px; freedom : parameters per axis
    design : (n, 2, p); rows, values : (2 n, p) and (2 n,) the weighted equations; held : (p, p) what holds theta besides them
    """

    theta: Floats
    covariance: Floats
    off: Floats
    keep: Mask
    scatter: float
    freedom: float
    design: Floats
    rows: Floats
    values: Floats
    held: Floats


def fit_field(
    shifts: Sequence[Shift], row: ArrayLike, col: ArrayLike, form: str = "constant", reference: float | None = None
) -> Field:
    """One displacement of a whole image from its blocks' shifts at (row, col) on the grid.

    form : the freest of FORMS that may be taken. A freer one than 'constant', and relief displacement, is taken
    where it predicts blocks that it was not fitted to better, by more than the standard error of that.
    reference : m, the height that relief does not displace; None where relief displacement is not to be tried
    Blocks that disagree with the rest are left out; ``Field.refused`` says where the evidence is too poor.
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
        np.array([_covariance_of(s) for s in kept]),
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


def _covariance_of(shift: Shift) -> Floats:
    if shift.covariance is not None:
        return shift.covariance[:2, :2]
    return shift.sigma**2 * np.eye(2)


# --- which form -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Candidate:
    basis: Basis
    relief: bool
    whole: _Solution | None
    loss: Floats  # (n,) what each block, held out, is off by
    share_error: float = math.nan
    held_out: float = math.nan


def _choose(blocks: _Blocks, form: str, middle: tuple[float, float]) -> _Candidate:
    """The plainest form that no freer one beats on held-out blocks by more than the standard error of its lead."""
    squares = _squares(blocks)
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
    # blocks weigh alike for all forms: by what the closest of their fits that many blocks hold leaves
    scatters = [f.scatter for _, _, fits in tried for f in fits if f.freedom < number / 4]
    scale = np.hypot(blocks.sigma, min([plain.scatter, *scatters]))
    best = _Candidate(constant, False, plain, _held_out(blocks, plain, squares, scale)[0])
    for basis, relief, fits in tried:
        outcomes = [(*_held_out(blocks, fit, squares, scale), fit) for fit in fits]
        if not outcomes:
            continue
        loss, shares, fit = min(outcomes, key=lambda outcome: float(outcome[0].mean()))
        lead = _by_square(best.loss - loss, squares)
        if lead.sum() > math.sqrt(len(lead)) * lead.std(ddof=1):
            best = _Candidate(basis, relief, fit, loss, _jackknife(shares) if relief else math.nan)
    zero = _loss(blocks.seen, scale)
    return replace(best, held_out=1 - float(best.loss.sum()) / max(1e-12, float(zero.sum())))


def _field_basis(blocks: _Blocks) -> Basis:
    """Square cells of knots over all blocks, as close as every second block along a row, and no more than MOST_CELLS."""
    low = np.array([blocks.row.min(), blocks.col.min()])
    extent = np.array([np.ptp(blocks.row), np.ptp(blocks.col)])
    spacing = math.sqrt(float(extent[0] * extent[1]) / len(blocks.row))  # of blocks
    step = max(2 * spacing, float(extent.max()) / MOST_CELLS)
    cells = np.maximum(1, np.ceil(extent / step)).astype(int)
    start = low - (cells * step - extent) / 2
    return Basis("field", (float(start[0]), float(start[1])), step, (int(cells[0]), int(cells[1])))


def _squares(blocks: _Blocks) -> NDArray[np.int64]:
    """(n,) to which of FOLDS parts of the ground each block belongs: squares of about two by two blocks, dealt at random."""
    extent = max(1.0, float(np.ptp(blocks.row)) * float(np.ptp(blocks.col)))
    side = 2 * math.sqrt(extent / len(blocks.row)) + 1
    place = np.stack([(blocks.row - blocks.row.min()) // side, (blocks.col - blocks.col.min()) // side], axis=1)
    _, square = np.unique(place, axis=0, return_inverse=True)
    square = square.ravel()
    dealt = np.random.default_rng(0).permutation(square.max() + 1)
    return np.asarray(dealt[square] % min(FOLDS, square.max() + 1))


def _by_square(values: Floats, squares: NDArray[np.int64]) -> Floats:
    return np.asarray(np.bincount(squares, weights=values, minlength=squares.max() + 1), float)


def _held_out(blocks: _Blocks, fit: _Solution, squares: NDArray[np.int64], scale: Floats) -> tuple[Floats, Floats]:
    """(n,) the loss of each block under ``fit`` made again from the other squares, and the relief's share in each of these.

    Which blocks are outliers stays as it was for all of them together.
    """
    loss, shares = _loss(blocks.seen, scale), []
    for square in range(squares.max() + 1):
        out = squares == square
        rest = fit.rows[np.repeat(~out, 2)], fit.values[np.repeat(~out, 2)]
        if (fit.keep & ~out).sum() >= 3:
            inverse = np.linalg.inv(rest[0].T @ rest[0] + fit.held)
            theta = inverse @ (rest[0].T @ rest[1])
            loss[out] = _loss((blocks.seen - fit.design @ theta)[out], scale[out])
            shares.append(theta[-1])
    return loss, np.array(shares)


def _loss(off: Floats, scale: Floats) -> Floats:
    """Squared distance in standard deviations, no further than where a block counts as an outlier."""
    return np.minimum((off**2).sum(axis=1) / scale**2, OUTLIER**2)


def _jackknife(values: Floats) -> float:
    """Standard error of what was estimated with each part of the ground left out once (Quenouille 1956)."""
    n = len(values)
    return math.sqrt((n - 1) / n * float(((values - values.mean()) ** 2).sum())) if n > 1 else math.nan


# --- one fit --------------------------------------------------------------------------------------------------------


def _solve(blocks: _Blocks, basis: Basis, relief: bool, stiffness: float, used: Mask | None = None) -> _Solution | None:
    """Weighted least squares with outliers left out; None where too few blocks agree.

    A block weighs by its own covariance and by the scatter of all; it is an outlier beyond OUTLIER standard deviations.
    Bad blocks may be a third: they first weigh little (Cauchy), and are left out once the rest agrees.
    """
    n, size = len(blocks.row), basis.size
    used = np.ones(n, bool) if used is None else used
    design, bending = _design(blocks, basis, relief)
    seen, free = blocks.seen, design.shape[2]
    least = 2 if basis.form == "constant" else 3
    if used.sum() < min(least, n):
        return None
    floor = float(np.median(blocks.sigma[used]))
    off = seen - np.median(seen[used], axis=0)
    keep = used
    for k in range(COARSE_STEPS + 15):
        scatter = 1.4826 * float(np.median(np.abs(off[keep])))
        distance = np.abs(off).max(axis=1) / np.hypot(blocks.sigma, max(scatter, floor))
        weight = used / (1 + distance**2)
        before = keep
        if k >= COARSE_STEPS:
            keep = used & (distance < OUTLIER)
            weight = keep.astype(float)
            if keep.sum() < min(least, n):
                return None
        excess = max(0.0, scatter**2 - floor**2) + LEAST_SIGMA_PX**2
        root = np.linalg.cholesky(np.linalg.inv(blocks.covariance + excess * np.eye(2)))
        root = np.swapaxes(root, 1, 2) * np.sqrt(weight)[:, None, None]
        x, y = (root @ design).reshape(2 * n, free), (root @ seen[:, :, None]).reshape(2 * n)
        normal = x.T @ x
        held = bending * stiffness * np.trace(normal[:size, :size]) / size
        held += 1e-9 * np.trace(normal) / free * np.eye(free)
        inverse = np.linalg.inv(normal + held)
        theta = inverse @ (x.T @ y)
        last, off = off, seen - design @ theta
        if k > COARSE_STEPS and (before == keep).all() and np.abs(off - last).max() < 1e-3:
            break
    share = inverse @ normal
    freedom = (float(np.trace(share)) - relief) / 2
    scatter = 1.4826 * float(np.median(np.abs(off[keep])))
    return _Solution(theta, share @ inverse, off, keep, scatter, freedom, design, x, y, held)


def _design(blocks: _Blocks, basis: Basis, relief: bool) -> tuple[Floats, Floats]:
    """(n, 2, p) what dx and dy of each block are a mixture of, and (p, p) how the mixture bends."""
    size = basis.size
    parts = basis.matrix(blocks.row, blocks.col)
    design = np.zeros((len(parts), 2, 2 * size + relief))
    design[:, 0, :size], design[:, 1, size : 2 * size] = parts, parts
    if relief and blocks.relief is not None:
        design[:, :, -1] = blocks.relief
    bending = np.zeros((design.shape[2],) * 2)
    bending[: 2 * size, : 2 * size] = np.kron(np.eye(2), basis.bending())
    return design, bending
