"""A trained network and all that is needed to use it, from and to checkpoint.h5."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path

import h5py
import numpy as np
import torch
from torch import Tensor

from schemas.artefacts import CHECKPOINT
from schemas.errors import ArtefactError, ConfigError
from schemas.reading import open_artefact, read_config, read_strings
from stages.network.normalisation import scale_elevation
from stages.network.unet import UNet
from stages.physics.photometry import ReflectanceModel, get_model


class Predictor(torch.nn.Module):
    """Elevation -> coefficients of a reflectance model.

    The network's raw output is scaled by ``output_scale`` and shifted by ``start`` (the raw global coefficients), so
    that training begins at the best uniform surface and moves in steps of its own size.
    """

    def __init__(
        self, model: ReflectanceModel, net: UNet, elevation_scale: float, start: Tensor, output_scale: float
    ) -> None:
        super().__init__()
        self.model = model
        self.net = net
        self.elevation_scale = elevation_scale
        self.output_scale = output_scale
        self.start: Tensor
        self.register_buffer("start", start.clone())
        self.gain: dict[str, float] = {}
        self.offset: dict[str, float] = {}
        self.image_units = "iof"
        self.gsd = float("nan")

    def forward(self, elevation: Tensor, keys: Tensor | None = None) -> Tensor:
        """(B, H, W) m -> (B, C, H, W) coefficients; ``keys`` as in :class:`UNet`."""
        x = scale_elevation(elevation, self.elevation_scale)
        if elevation.device.type == "cpu":
            x = x.to(memory_format=torch.channels_last)
        raw = self.net(x, keys).float() * self.output_scale + self.start[None, :, None, None]
        return self.model.constrain(raw, dim=1)

    def _whole_strides(self, elevation: Tensor) -> Tensor:
        stride = self.net.stride
        height, width = elevation.shape[-2:]
        pad = (0, -width % stride, 0, -height % stride)
        return torch.nn.functional.pad(elevation[:, None], pad, mode="replicate")[:, 0] if any(pad) else elevation

    @torch.no_grad()
    def coefficients(self, elevation: Tensor) -> Tensor:
        """(B, H, W) m -> (B, C, H, W), in evaluation mode. H and W need not be multiples of the network's stride."""
        was = self.training
        self.eval()
        height, width = elevation.shape[-2:]
        out = self(self._whole_strides(elevation))[..., :height, :width]
        self.train(was)
        return out


def choose_device(name: str) -> torch.device:
    """'auto', 'cpu', 'cuda', 'cuda:1' -> a device that exists. Raises ConfigError."""
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        raise ConfigError(f"--device: expected cpu, cuda, cuda:N or auto, found '{name}'.") from None
    if device.type == "cuda" and not torch.cuda.is_available():
        raise ConfigError("--device: expected a CUDA device, found none; use --device cpu.")
    return device


def write_state(group: h5py.Group, state: Mapping[str, Tensor]) -> None:
    """A state dict as plain HDF5 arrays, no pickle."""
    for name, tensor in state.items():
        group.create_dataset(name, data=tensor.detach().cpu().numpy(), track_order=True)


def read_state(group: h5py.Group) -> dict[str, Tensor]:
    """The inverse of :func:`write_state`."""
    return {name: torch.from_numpy(np.array(data[...])) for name, data in group.items()}


def first_misfit(error: BaseException) -> str:
    """What PyTorch says of the first weight that does not fit; its own first line only names a class."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()] or [type(error).__name__]
    text = lines[1] if len(lines) > 1 else lines[0]
    text = text.replace(" in state_dict", "")
    return text if len(text) <= 160 else f"{text[:157]}..."


def load_predictor(path: Path, device: torch.device | str = "cpu", model: str | None = None) -> Predictor:
    """Load checkpoint.h5. ``model``: the model that the caller expects. Raises ArtefactError."""
    with open_artefact(Path(path), CHECKPOINT) as file:
        name = str(file.attrs["model"])
        if model is not None and model.lower() != name.lower():
            raise ArtefactError(
                f"{path}: expected a checkpoint for model '{model}', found one for '{name}'; train again or drop --model."
            )
        if "weights" not in file:
            raise ArtefactError(
                f"{path}:/weights: expected the network's weights, found none; write it again with 'lunargr train'."
            )
        reflectance = get_model(name)
        found = json.loads(str(file.attrs["coefficients"]))
        expected = [p.name for p in reflectance.parameters]
        if found != expected:
            raise ArtefactError(
                f"{path}: expected coefficients {', '.join(expected)} of '{name}', found {', '.join(found)}; train again."
            )
        config = read_config(file)
        net = UNet(len(expected), config["widths"], config["dropout"])
        predictor = Predictor(
            reflectance,
            net,
            float(file.attrs["elevation_scale_m"]),
            torch.zeros(len(expected)),
            float(file.attrs["output_scale"]),
        )
        try:
            predictor.load_state_dict(read_state(file["weights"]))
        except RuntimeError as error:
            raise ArtefactError(
                f"{path}:/weights: expected those of the network that 'config' describes, found others ({first_misfit(error)}); "
                "train again, or bring back the file as 'lunargr train' wrote it."
            ) from None
        ids = read_strings(file, "image_id")
        predictor.gain = dict(zip(ids, map(float, file["gain"][...]), strict=True))
        predictor.offset = dict(zip(ids, map(float, file["offset"][...]), strict=True))
        predictor.image_units = str(file.attrs["image_units"])
        predictor.gsd = float(file.attrs["gsd_m"])
    predictor.to(device)
    if torch.device(device).type == "cpu":
        predictor.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return predictor.eval()
