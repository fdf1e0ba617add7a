"""What is matched: crops of pairs rendered through a checkpoint, crops kept by evaluate, or image files."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from schemas import EVALUATION, SPLITS, ArtefactError, ConfigError, open_artefact, read_kind, read_strings
from schemas.errors import InputError
from stages.common.progress import Say
from stages.match.config import Config
from stages.match.pictures import read_picture
from stages.network.predictor import choose_device, load_predictor
from stages.pairs.ground import leave_out_learned
from stages.pairs.reader import PairReader
from stages.physics.formation.chain import form
from stages.physics.formation.radiometry import match_crops
from stages.physics.photometry import get_model

SHOWN = ("learned", "hapke_minmax", "terrain", "albedo")  # the first two as in the paper's table


@dataclass
class Comparison:
    """One measured picture and the renderings of it: (H, W) float32, NaN where not known.

    common_scale : the renderings have the measured picture's units, so that one stretch serves all
    ground : number of the piece of ground that it shows; pictures of one tile are no independent witnesses
    """

    label: str
    measured: np.ndarray
    rendered: dict[str, np.ndarray]
    common_scale: bool
    ground: int = 0


def is_artefact(path: Path) -> bool:
    """Whether a file's name is that of an artefact, not of a picture."""
    return path.suffix.lower() in (".h5", ".hdf5", ".nc")


def comparisons(files: list[Path], config: Config, note: Say) -> tuple[int, Iterator[Comparison]]:
    """How many comparisons the files hold, and the comparisons; which kind they are follows from the files. Raises LunargrError.

    note : is told which pairs are left out
    """
    first, *others = files
    if not is_artefact(first):
        return 1, iter([from_images(first, others)])
    if others and is_artefact(others[0]):
        return from_pairs(first, others[0], config, note)
    if others:
        raise ConfigError(f"{others[0]}: expected a checkpoint after {first.name}, found an image file.")
    return from_evaluation(first, config.count, config.seed)


def from_images(measured: Path, rendered: list[Path]) -> Comparison:
    """Image files of equal size; each is stretched by itself, because their units may differ."""
    if not rendered:
        raise ConfigError(f"{measured}: expected at least one rendered image to match it with, found none.")
    picture = read_picture(measured)
    others = {}
    for number, path in enumerate(rendered):
        if path in rendered[:number]:
            raise ConfigError(f"{path}: expected each rendered image once, found it twice; name it once.")
        image = read_picture(path)
        if image.shape != picture.shape:
            raise InputError(
                f"{path}: expected {picture.shape[1]} x {picture.shape[0]} px as in {measured.name}, "
                f"found {image.shape[1]} x {image.shape[0]}; render it on the same grid."
            )
        others[path.stem if [p.stem for p in rendered].count(path.stem) == 1 else str(path)] = image
    return Comparison(measured.stem, picture, others, common_scale=False)


def choose(fraction_known: np.ndarray, tile: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Up to ``count`` random crops among those that are known (nearly) everywhere, or the best known ones; sorted indices.

    As many from every ground tile as from any other, as far as they go: intervals live on the number of tiles.
    fraction_known, tile : (N,), of every crop
    """
    whole = np.flatnonzero(fraction_known >= 0.99)
    if len(whole) < count:
        return np.sort(np.argsort(-fraction_known, kind="stable")[:count])
    drawn = np.random.default_rng(seed).permutation(whole)
    drawn_before = np.zeros(len(drawn), int)  # of its tile
    for name in np.unique(tile[drawn]):
        mine = tile[drawn] == name
        drawn_before[mine] = np.arange(mine.sum())
    return np.sort(drawn[np.argsort(drawn_before, kind="stable")[:count]])


def from_evaluation(path: Path, count: int, seed: int) -> tuple[int, Iterator[Comparison]]:
    """Crops that `lunargr evaluate` kept."""
    kind = read_kind(path)
    if kind.name == "pairs":
        raise ConfigError(
            f"{path}: expected a checkpoint after the pairs, found none; 'lunargr match PAIRS CHECKPOINT'."
        )
    with open_artefact(path, EVALUATION) as file:
        if "rendered" not in file:
            raise ArtefactError(
                f"{path}:/rendered: expected rendered crops, found none; run 'lunargr evaluate' with `renderings`, "
                "or 'lunargr match PAIRS CHECKPOINT'."
            )
        pixels = file["valid_pixels"][...] / np.prod(file["measured"].shape[1:])
        tile = file["tile"][...]
    chosen = choose(pixels, tile, count, seed)

    def read() -> Iterator[Comparison]:
        with open_artefact(path, EVALUATION) as file:
            names = read_strings(file, "model_name")
            for k in chosen:
                rendered = {n: file["rendered"][names.index(n), k] for n in SHOWN if n in names}
                label = f"pair {file['pair_index'][k]}"
                yield Comparison(label, file["measured"][k], rendered, common_scale=True, ground=int(tile[k]))

    return len(chosen), read()


def from_pairs(pairs: Path, checkpoint: Path, config: Config, note: Say) -> tuple[int, Iterator[Comparison]]:
    """Crops of a split, rendered with the learned reflectance and with Hapke matched as in the paper."""
    split = config.split
    if split not in dict(SPLITS):
        raise ConfigError(f"`split`: expected one of {', '.join(dict(SPLITS))}, found '{split}'.")
    predictor = load_predictor(checkpoint, choose_device(config.device))
    on_device = next(predictor.parameters()).device
    with PairReader(pairs) as reader:
        indices = reader.indices(split)
        if not len(indices):
            raise ArtefactError(f"{pairs}:/split: expected '{split}' pairs to match, found none; sample more crops.")
        indices, notes = leave_out_learned(reader, indices, checkpoint, split)
        for sentence in notes:
            note(sentence)
        known = np.array([float(reader.valid([k]).float().mean()) for k in indices])
        units, tile = reader.units, reader.tile
    chosen = indices[choose(known, tile[indices], config.count, config.seed)]
    hapke = get_model("hapke")
    defaults = torch.tensor([[p.default for p in hapke.parameters]])[:, :, None, None]

    def render() -> Iterator[Comparison]:
        with PairReader(pairs) as reader, torch.no_grad():
            for k in chosen:
                observation, valid = reader.observation([k]), reader.valid([k])
                measured = reader.image([k])
                learned = form(
                    observation,
                    predictor.model,
                    predictor.coefficients(observation.elevation.to(on_device)).float().cpu(),
                )
                if units == "dn":  # unknown gain and offset: the crop's own, for both alike
                    learned = match_crops(learned, measured, valid, "gain_offset")
                baseline = match_crops(form(observation, hapke, defaults), measured, valid, "minmax")
                mask = valid[0].numpy()
                pictures = [np.where(mask, t[0].numpy(), np.nan) for t in (measured, learned, baseline)]
                rendered = dict(zip(SHOWN[:2], pictures[1:], strict=True))
                yield Comparison(f"pair {k}", pictures[0], rendered, common_scale=True, ground=int(tile[k]))

    return len(chosen), render()
