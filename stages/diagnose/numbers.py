"""The few distribution functions that the decision needs, without SciPy."""

from __future__ import annotations

import math


def f_tail(statistic: float, first: float, second: float) -> float:
    """P(F > statistic) with ``first`` and ``second`` degrees of freedom."""
    if statistic <= 0:
        return 1.0
    if second <= 0:
        return 1.0
    return incomplete_beta(second / 2, first / 2, second / (second + first * statistic))


def incomplete_beta(a: float, b: float, x: float) -> float:
    """Regularised incomplete beta function by Lentz's continued fraction (Abramowitz & Stegun 26.5.8)."""
    if x <= 0:
        return 0.0
    if x >= 1:
        return 1.0
    if x > (a + 1) / (a + b + 2):
        return 1.0 - incomplete_beta(b, a, 1 - x)
    log_front = math.lgamma(a + b) - math.lgamma(a) - math.lgamma(b) + a * math.log(x) + b * math.log1p(-x)
    c, d, h = 1.0, 1 / _apart(1 - (a + b) * x / (a + 1)), 0.0
    h = d
    for m in range(1, 500):
        even = m * (b - m) * x / ((a + 2 * m - 1) * (a + 2 * m))
        d = 1 / _apart(1 + even * d)
        c = _apart(1 + even / c)
        h *= c * d
        odd = -(a + m) * (a + b + m) * x / ((a + 2 * m) * (a + 2 * m + 1))
        d = 1 / _apart(1 + odd * d)
        c = _apart(1 + odd / c)
        h *= c * d
        if abs(c * d - 1) < 1e-12:
            break
    return math.exp(log_front) * h / a


def chi2_quantile(p: float, dof: float) -> float:
    """The value below which a chi-square variable lies with probability ``p`` (Wilson & Hilferty 1931)."""
    z = normal_quantile(p)
    return dof * (1 - 2 / (9 * dof) + z * math.sqrt(2 / (9 * dof))) ** 3


def normal_quantile(p: float) -> float:
    """Inverse of the normal distribution, by Newton on erfc."""
    z = 0.0
    for _ in range(60):
        error = 0.5 * math.erfc(-z / math.sqrt(2)) - p
        slope = math.exp(-z * z / 2) / math.sqrt(2 * math.pi)
        step = max(min(error / max(slope, 1e-12), 1.0), -1.0)
        z -= step
        if abs(step) < 1e-12:
            break
    return z


def _apart(x: float) -> float:
    return x if abs(x) > 1e-300 else 1e-300
