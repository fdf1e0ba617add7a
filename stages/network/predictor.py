"""A trained network with all that is needed to use it, and how it is read from checkpoint.h5."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path

import h5py
import numpy as np
import torch
from torch import Tensor

from schemas.artefacts import CHECKPOINT
from schemas.errors import ArtefactError, ConfigError
from schemas.reading import open_artefact, read_config, read_strings
from stages.network.checkpoint_layout import check_finite, check_weights, read_layout
from stages.network.coefficient_maps import CoefficientMaps
from stages.network.normalisation import scale_elevation
from stages.network.unet import UNet
from stages.physics.photometry import named_model


class Predictor(torch.nn.Module):
    """Elevation -> coefficients of a reflectance model."""

    def __init__(self, net: UNet, maps: CoefficientMaps, elevation_scale: float) -> None:
        super().__init__()
        self.model = maps.model
        self.net = net
        self.maps = maps
        self.elevation_scale = elevation_scale
        self.gain: dict[str, float] = {}
        self.offset: dict[str, float] = {}
        self.image_units = "iof"
        self.gsd = float("nan")
        self.image_noise = float("nan")  # I/F, of the images, beside errors of the maps

    def forward(self, elevation: Tensor) -> Tensor:
        """(B, H, W) m -> (B, C, H, W) coefficients."""
        return self.maps.stack(self.unbounded(elevation), dim=1)

    def unbounded(self, elevation: Tensor) -> Tensor:
        """(B, H, W) m -> (B, channels, H, W), the maps before their bounds: see :class:`CoefficientMaps`."""
        x = scale_elevation(elevation, self.elevation_scale)
        if elevation.device.type == "cpu":
            x = x.to(memory_format=torch.channels_last)
        return self.maps.unbounded(self.net(x))

    def _whole_strides(self, elevation: Tensor) -> Tensor:
        stride = self.net.stride
        height, width = elevation.shape[-2:]
        pad = (0, -width % stride, 0, -height % stride)
        return torch.nn.functional.pad(elevation[:, None], pad, mode="replicate")[:, 0] if any(pad) else elevation

    @torch.no_grad()
    def coefficients(self, elevation: Tensor) -> Tensor:
        """(B, H, W) m -> (B, C, H, W), in evaluation mode. H and W need not be multiples of the network's stride."""
        return self.maps.stack(self._evaluated(elevation), dim=1)

    @torch.no_grad()
    def coefficients_and_deviations(self, elevation: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        """(B, H, W) m -> coefficients (B, C, H, W), and the standard deviations (B, H, W) of those that are maps, by name.

        ``photometry.deviation.radiance_deviation`` makes the image's of them; ``image_noise`` comes on top.
        """
        unbounded = self._evaluated(elevation)
        deviations = self.maps.deviations(unbounded, dim=1)
        return self.maps.stack(unbounded, dim=1), dict(zip(self.maps.maps, deviations.unbind(1), strict=True))

    def _evaluated(self, elevation: Tensor) -> Tensor:
        """(B, H, W) m -> :meth:`unbounded` in evaluation mode."""
        training = self.training
        self.eval()
        height, width = elevation.shape[-2:]
        out = self.unbounded(self._whole_strides(elevation))[..., :height, :width]
        self.train(training)
        return out


def choose_device(name: str) -> torch.device:
    """'auto', 'cpu', 'cuda', 'cuda:1' -> a device that exists. Raises ConfigError."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    if not re.fullmatch(r"cpu|cuda(:\d{1,3})?", name, re.ASCII):
        raise ConfigError(f"`device`: expected cpu, cuda, cuda:N or auto, found '{name}'.")
    device = torch.device(name)
    count = torch.cuda.device_count()
    if device.type == "cuda" and (device.index or 0) >= count:
        raise ConfigError(
            f"`device`: expected one of {count} CUDA devices, found '{name}'; use `device` cpu or another."
        )
    return device


def write_state(group: h5py.Group, state: Mapping[str, Tensor]) -> None:
    """A state dict as plain HDF5 arrays, no pickle.

    state : by name, tensors of any shape
    """
    for name, tensor in state.items():
        group.create_dataset(name, data=tensor.detach().cpu().numpy(), track_order=True)


def read_state(group: h5py.Group) -> dict[str, Tensor]:
    """The inverse of :func:`write_state`."""
    return {name: torch.from_numpy(np.array(data[...])) for name, data in group.items()}


def load_predictor(path: Path, device: torch.device | str = "cpu", model: str | None = None) -> Predictor:
    """Load checkpoint.h5. ``model``: the model that the caller expects. Raises ArtefactError."""
    with open_artefact(Path(path), CHECKPOINT) as file:
        name = str(file.attrs["model"])
        if model is not None and model.lower() != name.lower():
            raise ArtefactError(
                f"{path}: expected a checkpoint for model '{model}', found one for '{name}'; train again or drop `model`."
            )
        reflectance = named_model(path, file)
        names = [p.name for p in reflectance.parameters]
        found, maps = (json.loads(str(file.attrs[key])) for key in ("coefficients", "maps"))
        if found != names or not maps or not set(map(str, maps)) <= set(names):
            raise ArtefactError(
                f"{path}: expected coefficients {', '.join(names)} of '{name}', some of them in maps, "
                f"found {', '.join(map(str, found))} and maps of {', '.join(map(str, maps)) or 'none'}; train again."
            )
        widths, dropout = read_layout(path, read_config(file), name)
        start = torch.tensor([p.default for p in reflectance.parameters])
        output_scale = float(file.attrs["output_scale"])
        positive, deviations = (bool(file.attrs[key]) for key in ("positive", "deviations"))
        mapped = CoefficientMaps(reflectance, maps, start, output_scale, positive, deviations)
        check_weights(path, file.get("weights"), mapped, widths, dropout)
        net = UNet(mapped.channels, widths, dropout)
        predictor = Predictor(net, mapped, float(file.attrs["elevation_scale_m"]))
        try:
            state = read_state(file["weights"])
        except OSError as error:
            raise ArtefactError(
                f"{path}:/weights: cannot be read ({error}); the file is damaged, train again."
            ) from None
        check_finite(path, state)
        predictor.load_state_dict(state)
        ids = read_strings(file, "image_id")
        predictor.gain = dict(zip(ids, map(float, file["gain"][...]), strict=True))
        predictor.offset = dict(zip(ids, map(float, file["offset"][...]), strict=True))
        predictor.image_units = str(file.attrs["image_units"])
        predictor.gsd = float(file.attrs["gsd_m"])
        predictor.image_noise = float(file.attrs.get("image_noise", math.nan))
    predictor.to(device)
    if torch.device(device).type == "cpu":
        predictor.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return predictor.eval()
