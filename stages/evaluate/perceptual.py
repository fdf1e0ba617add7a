"""LPIPS (Zhang et al. 2018), where its network and weights are installed; otherwise the reason why not."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

BACKBONE = "alexnet-owt-7be5be79.pth"


class Perceptual:
    """The LPIPS distance of crops, or ``reason`` why it is not available. Never fetches anything from the network."""

    def __init__(self) -> None:
        self.metric: Any = None
        self.reason = ""
        weights = Path(torch.hub.get_dir()) / "checkpoints" / BACKBONE
        try:
            import torchvision  # noqa: F401
            from torchmetrics.image.lpip import LearnedPerceptualImagePatchSimilarity
        except ImportError as error:
            self.reason = f"the package '{error.name}' is not installed (extra 'lpips')"
            return
        if not weights.is_file():
            self.reason = f"the backbone's weights '{BACKBONE}' are not in torch's cache (TORCH_HOME/hub/checkpoints)"
            return
        self.metric = LearnedPerceptualImagePatchSimilarity(net_type="alex", normalize=True).eval()

    @property
    def available(self) -> bool:
        """Whether LPIPS can be had here."""
        return self.metric is not None

    @torch.no_grad()
    def distance(self, measured: np.ndarray, rendered: np.ndarray, valid: np.ndarray) -> float:
        """LPIPS of one crop stretched to the measured crop's range; invalid pixels are equal in both. (H, W) each."""
        if not valid.any():
            return float("nan")
        low, high = float(measured[valid].min()), float(measured[valid].max())
        if not high > low:
            return float("nan")

        def stretch(image: np.ndarray) -> torch.Tensor:
            scaled = np.clip((np.where(valid, image, low) - low) / (high - low), 0, 1).astype(np.float32)
            return torch.from_numpy(scaled)[None, None].expand(1, 3, -1, -1)

        return float(self.metric(stretch(measured), stretch(rendered)))
