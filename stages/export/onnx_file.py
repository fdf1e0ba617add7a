"""From checkpoint.h5 to model.onnx: elevations in, coefficients out, for maps of any size."""

from __future__ import annotations

import io
import json
import warnings
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from schemas import CHECKPOINT, ConfigError, atomic_path, open_artefact
from schemas.checks import any_text
from schemas.files.outputs import Output
from schemas.provenance import record_of
from stages.export.card import model_card
from stages.export.config import Config
from stages.network.coefficient_maps import CoefficientMaps
from stages.network.normalisation import scale_elevation
from stages.network.predictor import Predictor, load_predictor
from stages.network.unet import UNet

INPUT, OUTPUT = "elevation", "coefficients"


@dataclass(frozen=True)
class Summary:
    """What was written, for the line at the end."""

    model: str
    coefficients: tuple[str, ...]
    stride: int
    size: int
    card: Path


class _Exported(torch.nn.Module):
    """(B, H, W) m -> (B, C, H, W), as :class:`Predictor` in evaluation mode; H and W are multiples of the stride."""

    def __init__(self, predictor: Predictor) -> None:
        super().__init__()
        self.net: UNet = predictor.net
        self.maps: CoefficientMaps = predictor.maps
        self.elevation_scale = predictor.elevation_scale

    def forward(self, elevation: Tensor) -> Tensor:
        output = self.net(scale_elevation(elevation, self.elevation_scale))
        return self.maps.stack(self.maps.unbounded(output), dim=1)


def work(checkpoint: Path, output: Output, config: Config) -> Summary:
    """See :func:`stages.export.run`."""
    path = output.file
    if path.suffix.lower() != ".onnx":
        raise ConfigError(f"{path}: expected a name that ends in .onnx; choose another `output`.")
    if not 13 <= config.opset <= 20:
        raise ConfigError(f"`opset`: expected 13..20, found {config.opset}.")
    card = path.with_suffix(".md")
    predictor = load_predictor(checkpoint)
    with open_artefact(checkpoint, CHECKPOINT) as file:
        record = record_of(file)
        attributes = {
            k: any_text(file.attrs[k]) for k in ("history", "lunargr_version", "config", "inputs") if k in file.attrs
        }
        losses = {k: file[k][...] for k in ("train_loss", "validation_loss")}
        best = int(file.attrs["best_epoch"])
    data = to_onnx(predictor, config.opset, attributes)
    names = tuple(p.name for p in predictor.model.parameters)
    with atomic_path(path) as partial, atomic_path(card) as text:
        partial.write_bytes(data)
        text.write_text(model_card(path.name, checkpoint.name, predictor, record, losses, best), encoding="utf-8")
    return Summary(predictor.model.name, names, predictor.net.stride, len(data), card)


def to_onnx(predictor: Predictor, opset: int, attributes: dict[str, str]) -> bytes:
    """The network as an ONNX file, whose metadata hold what one must know to use it. Raises ConfigError.

    attributes : of the checkpoint, by name
    """
    try:
        import onnx
    except ImportError:
        raise ConfigError("export: expected the package 'onnx', found none; pip install 'lunargr[onnx]'.") from None
    stride = predictor.net.stride
    axes = {0: "batch", 1: "height", 2: "width"}
    buffer = io.BytesIO()
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter's remarks on its own age
        torch.onnx.export(
            _Exported(predictor.to(memory_format=torch.contiguous_format).eval()),  # type: ignore[call-overload]
            (torch.zeros(1, 4 * stride, 4 * stride),),
            buffer,  # type: ignore[arg-type]
            input_names=[INPUT],
            output_names=[OUTPUT],
            dynamic_axes={INPUT: axes, OUTPUT: {0: "batch", 2: "height", 3: "width"}},
            opset_version=opset,
            dynamo=False,
        )
    model = onnx.load_from_string(buffer.getvalue())
    facts = {
        "reflectance_model": predictor.model.name,
        "formula": f"I/F = {predictor.model.formula}",
        "coefficients": json.dumps([p.name for p in predictor.model.parameters]),
        "gsd_m": f"{predictor.gsd:g}",
        "height_and_width_are_multiples_of": str(stride),
        "context_px": str(predictor.net.reach),
        **{f"checkpoint_{name}": text for name, text in attributes.items()},
    }
    onnx.helper.set_model_props(model, facts)
    onnx.checker.check_model(model)
    return model.SerializeToString()
