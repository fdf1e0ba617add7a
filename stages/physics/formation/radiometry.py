"""Gain and offset between rendered and measured crops, and the full scale of uncalibrated images.

Every stage that compares rendered with measured images uses these.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from stages.common.arrays import Floats

MATCHINGS = ("minmax", "gain", "gain_offset")


def match_crops(rendered: Tensor, measured: Tensor, valid: Tensor, how: str) -> Tensor:
    """Rescale every rendered crop to its measured one, using valid pixels only.

    rendered, measured, valid : (B, H, W); valid is bool
    how : 'minmax': the gain that gives both the same min-max range, then the same mean (the Lunar-G2R paper's baseline);
          'gain': the least-squares gain; 'gain_offset': the least-squares gain and offset
    A crop whose rendering is constant gets gain 0 under 'minmax' and 'gain_offset', that is the measured mean.
    """
    r = torch.where(valid, rendered, 0).to(torch.float64)
    m = torch.where(valid, measured, 0).to(torch.float64)
    n, of_r, of_m, of_rr, of_rm = (t.sum(dim=(-2, -1)) for t in (valid.to(torch.float64), r, m, r * r, r * m))
    if how == "gain":
        gain, offset = _ratio(of_rm, of_rr), torch.zeros_like(n)
    elif how == "gain_offset":
        gain, offset = line_of_sums(n, of_r, of_m, of_rr, of_rm)
    elif how == "minmax":
        gain = _ratio(crop_range(measured, valid), crop_range(rendered, valid))
        offset = (of_m - gain * of_r) / n.clamp(min=1)
    else:
        raise ValueError(f"matching must be one of {MATCHINGS}, not {how!r}")
    return (rendered.to(torch.float64) * gain[:, None, None] + offset[:, None, None]).to(rendered.dtype)


def line_of_sums(count: Any, x: Any, y: Any, xx: Any, xy: Any) -> tuple[Any, Any]:
    """Least-squares gain and offset of y = gain x + offset, from sums over pixels.

    count, x, y, xx, xy : sums of 1, x, y, x^2 and x y, weighted or not; float64 arrays, tensors or numbers of one shape
    returns (gain, offset) of that shape; where x is constant the gain is 0 and the offset the mean of y
    """
    count = count + (count == 0)
    mean_x, mean_y = x / count, y / count
    variance, covariance = xx / count - mean_x * mean_x, xy / count - mean_x * mean_y
    varies = variance > 1e-12 * mean_x * mean_x
    gain = varies * covariance / (variance + (variance == 0))
    return gain, mean_y - gain * mean_x


def fit_line(expected: Floats, measured: Floats, with_offset: bool) -> tuple[float, float]:
    """Gain and offset of measured = gain x expected + offset, by Huber's weights (1.345 robust standard deviations).

    expected, measured : (n,); a gain that is not above 0 becomes the ratio of both medians, with the offset 0
    """
    weights = np.ones(len(expected))
    gain = offset = 0.0
    for _ in range(10):
        sums = [(weights * of).sum() for of in (1.0, expected, measured, expected**2, expected * measured)]
        if with_offset:
            gain, offset = line_of_sums(*sums)
        else:
            gain = sums[4] / sums[3] if sums[3] > 0 else 0.0
        if not gain > 0:
            gain, offset = max(float(np.median(measured) / np.median(expected)), 1e-12), 0.0
        residual = np.abs(measured - gain * expected - offset)
        scale = 1.4826 * float(np.median(residual))
        weights = np.minimum(1.0, 1.345 * max(scale, 1e-300) / np.maximum(residual, 1e-300))
    return gain, offset


def crop_range(image: Tensor, valid: Tensor) -> Tensor:
    """Largest minus smallest valid value of every crop, (B,) float64; 0 where nothing is valid."""
    high = torch.where(valid, image, -torch.inf).amax(dim=(-2, -1))
    low = torch.where(valid, image, torch.inf).amin(dim=(-2, -1))
    return torch.where(valid.any(dim=-1).any(dim=-1), high - low, 0).to(torch.float64)


def full_scale(largest: float) -> float:
    """The full range of images in DN from their largest value: 255 for 8 bits, else the next 2^n - 1.

    Images whose values stay within 0..1 are taken as scaled already.
    """
    if largest <= 1:
        return 1.0
    bits = 8
    while 2**bits - 0.5 < largest:  # files that keep a tenth of a count round a little over the top
        bits += 1
    return float(2**bits - 1)


def _ratio(numerator: Tensor, denominator: Tensor) -> Tensor:
    """numerator / denominator, 0 where the denominator vanishes."""
    return torch.where(denominator > 0, numerator / denominator.clamp(min=1e-300), 0)
