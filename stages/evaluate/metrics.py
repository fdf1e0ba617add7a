"""Errors between measured and rendered crops, on valid pixels only."""

from __future__ import annotations

import cv2
import numpy as np

SSIM_WINDOW, SSIM_SIGMA = 11, 1.5
SSIM_K1, SSIM_K2 = 0.01, 0.03


def squared_error(measured: np.ndarray, rendered: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Sum of squared differences over the valid pixels of every crop.

    measured, rendered, valid : (B, H, W); returns (B,) float64
    """
    difference = np.where(valid, measured.astype(np.float64) - rendered, 0.0)
    return np.einsum("bij,bij->b", difference, difference)


def psnr(mse: np.ndarray | float, data_range: np.ndarray | float = 1.0) -> np.ndarray | float:
    """Peak signal-to-noise ratio, dB; infinite for a perfect rendering, NaN for a range of 0."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return 10 * np.log10(np.square(data_range) / np.asarray(mse, float))


def ssim(measured: np.ndarray, rendered: np.ndarray, valid: np.ndarray, data_range: float) -> float:
    """Mean structural similarity of one crop over the windows that hold only valid pixels.

    measured, rendered, valid : (H, W); data_range : L of the constants C1 = (0.01 L)^2 and C2 = (0.03 L)^2
    Gaussian 11 x 11 window with sigma 1.5 and its weighted (biased) moments, as in Wang, Bovik, Sheikh & Simoncelli
    (2004), IEEE Trans. Image Process. 13, 600. NaN where no window is wholly valid or the range is 0.
    """
    reach = SSIM_WINDOW // 2
    inside = cv2.erode(
        valid.astype(np.uint8), np.ones((SSIM_WINDOW, SSIM_WINDOW), np.uint8), borderType=cv2.BORDER_CONSTANT
    )
    inside[:reach] = inside[-reach:] = 0
    inside[:, :reach] = inside[:, -reach:] = 0
    if not inside.any() or not data_range > 0:
        return float("nan")
    kernel = cv2.getGaussianKernel(SSIM_WINDOW, SSIM_SIGMA, cv2.CV_64F)
    # Moments about the crop's mean: differences of large squares would lose the small variances.
    centre = float(measured[valid].mean())
    x = np.where(valid, measured.astype(np.float64) - centre, 0.0)
    y = np.where(valid, rendered.astype(np.float64) - centre, 0.0)

    def mean(field: np.ndarray) -> np.ndarray:
        return cv2.sepFilter2D(field, cv2.CV_64F, kernel, kernel)[inside > 0]

    mean_x, mean_y = mean(x), mean(y)
    variance_x = mean(x * x) - mean_x**2
    variance_y = mean(y * y) - mean_y**2
    covariance = mean(x * y) - mean_x * mean_y
    c1, c2 = (SSIM_K1 * data_range) ** 2, (SSIM_K2 * data_range) ** 2
    mean_x, mean_y = mean_x + centre, mean_y + centre
    luminance = (2 * mean_x * mean_y + c1) / (mean_x**2 + mean_y**2 + c1)
    structure = (2 * covariance + c2) / (variance_x + variance_y + c2)
    return float((luminance * structure).mean())
