"""What an extended model does on the detector, for the whole image of a camera."""

from __future__ import annotations

import numpy as np
import torch

from stages.common.arrays import Floats32
from stages.physics.formation.chain import Observation, State
from stages.physics.maps.grid import Grid
from stages.physics.terrain.shading import Light


def apply_sensor(image: Floats32, light: Light, grid: Grid) -> Floats32:
    """The sensor's own effects of an extended model, on the whole image of a camera (H, W)."""
    sensor = [e for e in light.extensions if e.slot == "sensor"]
    if not sensor:
        return image
    known = np.isfinite(image)
    tensor = torch.from_numpy(np.nan_to_num(image))[None]
    line, sample = (torch.from_numpy(v.astype(np.float32))[None] for v in np.indices(image.shape))
    zero = torch.zeros_like(tensor)
    observation = Observation(
        zero, torch.tensor([[0.0, 0.0, 1.0]]), torch.zeros(1, 3), grid.gsd, grid.radius,
        detector_sample=sample, detector_line=line, frame=torch.full((1,), -1),
    )  # fmt: skip
    state = State(observation, zero, observation.sun_direction, observation.camera_position, None)
    state.image = tensor
    with torch.no_grad():
        for effect in sensor:
            effect.apply(state)
    return np.where(known, state.image[0].numpy(), np.nan).astype(np.float32)
