"""Seen ground under an unseen image: how well maps with albedo predict photographs that had no part in their albedo.

Another claim than that of unseen ground (``stages.evaluate.stage``), and kept apart from it: here other photographs of the
same pixels made the albedo. How far the scored Sun stands from the nearest one used is part of the answer.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from numpy.typing import NDArray

from schemas import (
    EVALUATION,
    SVBRDF,
    ArtefactError,
    ArtefactWriter,
    ConfigError,
    open_artefact,
    write_json,
)
from schemas.files.outputs import Output
from schemas.provenance import sha256
from schemas.reading import read_strings
from stages.common.arrays import Floats
from stages.common.intervals import ERROR, choose_units, gain_interval, ratio_interval
from stages.common.progress import Progress
from stages.evaluate.config import HeldOutConfig, report_files
from stages.evaluate.coverage import BANDS_DEG, count_within, shares
from stages.evaluate.least_squares import FrameGram, solve_gain_offset
from stages.evaluate.metrics import ssim
from stages.evaluate.table import finite, gain_entry
from stages.pairs.ground import leave_out_learned
from stages.pairs.reader import PairReader
from stages.physics.formation.chain import form, illuminate
from stages.physics.formation.radiometry import crop_range, match_crops
from stages.physics.maps.grid import unit_vectors
from stages.physics.photometry import get_model
from stages.physics.terrain.surface import SHADOWED, AlbedoError

CLAIM = "seen ground, unseen images"
MAPS = ("terrain", "albedo", "refined")  # each with all that the one before has; the last where the maps were refined
SAME_GROUND = 0.01  # of the pairs' gsd: heights of the same pixel in map and pairs differ by rounding only
FIT_PAIRS = 64  # pairs of one image that its gain and offset are fitted on, where it is in DN


@dataclass
class AlbedoMap:
    """An open map with albedo. used : images that made it; suns : (n, 3) body-fixed unit vectors towards their Suns"""

    path: Path
    file: h5py.File
    used: list[str]
    suns: Floats
    error: AlbedoError

    @property
    def refined(self) -> bool:
        """Whether `lunargr refine` corrected its elevations."""
        return "elevation_correction" in self.file

    def render(self, reader: PairReader, k: int) -> list[torch.Tensor]:
        """I/F of pair ``k``, (1, h, w) for each of MAPS that there are, NaN where unknown; shadows are the pair's."""
        part, file = _part(reader, k), self.file
        coefficients = torch.from_numpy(file["coefficients"][:, *part])[None]
        observation, model = reader.observation([k]), get_model(str(file.attrs["model"]))
        with torch.no_grad():
            terrain = form(observation, model, coefficients).double()
            albedo = torch.from_numpy(file["albedo"][part])[None]
            if not self.refined:
                return [terrain, terrain * albedo]
            alone = torch.from_numpy(file["albedo_alone"][part])[None]
            correction = torch.from_numpy(np.nan_to_num(file["elevation_correction"][part]))[None]
            raised = form(replace(observation, elevation=observation.elevation + correction), model, coefficients)
            return [terrain, terrain * alone, raised.double() * albedo]


def _part(reader: PairReader, k: int) -> tuple[slice, slice]:
    """Rows and columns of the map that pair ``k`` shows."""
    top, left = (int(reader.file[name][k]) - size // 2 for name, size in zip(("row", "col"), reader.size, strict=True))
    return np.s_[top : top + reader.size[0], left : left + reader.size[1]]


def work(
    pairs: Path, maps: Sequence[Path], output: Output, config: HeldOutConfig, progress: Progress
) -> dict[str, Any]:
    """See :func:`stages.evaluate.run_held_out`."""
    _check_once(maps)
    with PairReader(pairs) as reader, contextlib.ExitStack() as stack:
        opened = [_open(path, reader, stack) for path in maps]
        chosen, notes = _choose(reader, opened, config.split)
        names = _names(opened)
        sizes = {"model": len(names), "pair": len(chosen), "y": reader.size[0], "x": reader.size[1]}
        with ArtefactWriter(
            output.file,
            EVALUATION,
            sizes,
            config=asdict(config),
            inputs=[pairs, *maps],
            seed=config.seed,
        ) as writer:
            scores = _score(reader, opened, chosen, writer, progress)
            result = _conclude(reader, opened, chosen, scores, config)
            result |= {"pairs_file": pairs.name, "maps": [path.name for path in maps], "warnings": notes}
            writer.write("model_name", names)
            numbers = [k for k, _ in chosen]
            writer.write("pair_index", numbers)
            writer.write("tile", reader.tile[numbers])
            writer.write("valid_pixels", scores["pixels"])
            writer.write("mse", scores["squares"] / np.maximum(scores["pixels"], 1))
            writer.write("ssim", scores["ssim"])
            writer.file.attrs["split"] = config.split
            writer.file.attrs["metrics"] = json.dumps(result)
            for report in report_files(output):
                write_json(report, result)
    return result


def _names(maps: Sequence[AlbedoMap]) -> list[str]:
    """Of the rows of results: all maps that there are, and the same with a gain and an offset per crop. Raises ArtefactError."""
    if len({m.refined for m in maps}) > 1:
        raise ArtefactError(f"{maps[0].path}: expected maps that are all refined or none, found both; name one kind.")
    names = MAPS[: 2 + maps[0].refined]
    return [*names, *(f"{name}_gain_offset" for name in names)]


def _check_once(maps: Sequence[Path]) -> None:
    """Raises ConfigError where two maps are the same, as copies or by name."""
    seen: dict[str, Path] = {}
    for path in maps:
        if path.is_file() and (before := seen.setdefault(sha256(path), path)) is not path:
            raise ConfigError(f"{path}: expected each map once, found the content of {before} again; name it once.")


def _open(path: Path, reader: PairReader, stack: contextlib.ExitStack) -> AlbedoMap:
    """A map with albedo on the ground of the pairs. Raises ArtefactError."""
    file = stack.enter_context(open_artefact(path, SVBRDF))
    if "albedo" not in file:
        raise ArtefactError(
            f"{path}:/albedo: expected a map with albedo, found none; run 'lunargr albedo' with `fold`."
        )
    suns = unit_vectors(file["albedo_subsolar_longitude_deg"][...], file["albedo_subsolar_latitude_deg"][...])
    error = AlbedoError.read(file)
    if error is None:
        raise ArtefactError(
            f"{path}: expected albedo_std and albedo_image_std beside the albedo, found none; run 'lunargr albedo' again."
        )
    for name in ("row", "col"):
        if name not in reader.file:
            raise ArtefactError(
                f"{reader.path}:/{name}: expected where on the map a pair lies, found nothing; project again."
            )
    of_map, of_pair = file["elevation"][_part(reader, 0)], reader.known_elevation([0])[0]
    if "elevation_correction" in file:
        of_map = of_map - file["elevation_correction"][_part(reader, 0)]
    same = of_map.shape == of_pair.shape
    same = same and not np.nanmax(np.abs(of_map - of_pair), initial=0.0) > SAME_GROUND * reader.gsd
    if not same or abs(float(file.attrs["gsd_m"]) - reader.gsd) > 1e-6 * reader.gsd:
        raise ArtefactError(
            f"{path}: expected a map of the scene of {reader.path}, found other ground at its first pair."
        )
    return AlbedoMap(path, file, read_strings(file, "albedo_image_id"), suns, error)


def _choose(reader: PairReader, maps: Sequence[AlbedoMap], split: str) -> tuple[list[tuple[int, int]], list[str]]:
    """(pair, map) of what may be scored, and notes on what is left out. Raises ArtefactError where nothing may be."""
    chosen: list[tuple[int, int]] = []
    wanted = reader.indices(split)
    fresh = [leave_out_learned(reader, wanted, albedo_map.path, split) for albedo_map in maps]
    unlearned = [set(pairs.tolist()) for pairs, _ in fresh]
    for k in wanted.tolist():
        name = reader.image_ids[reader.frame[k]]
        unseen = [number for number, m in enumerate(maps) if name not in m.used and k in unlearned[number]]
        chosen += [(k, number) for number in unseen[:1]]
    if not chosen:
        raise ArtefactError(
            f"{maps[0].path}: expected pairs of split '{split}' whose image did not make the albedo, found none; "
            "run 'lunargr albedo' with `fold` or `leave_out`."
        )
    return chosen, list(dict.fromkeys(note for _, notes in fresh for note in notes))


def _score(
    reader: PairReader,
    maps: Sequence[AlbedoMap],
    chosen: Sequence[tuple[int, int]],
    writer: ArtefactWriter,
    progress: Any,
) -> dict[str, NDArray]:
    """Scores of the chosen (pair, map) by name, and the measured and rendered crops into ``writer``.

    squares : (rows, pairs) sums of squared errors; ssim : (rows, pairs); pixels : (pairs,) valid ones
    sun : (pairs,) rad, from the pair's Sun to the nearest of those whose images made the albedo
    within : (3, bands, pairs), see ``coverage.count_within``
    """
    count, rows = len(chosen), len(_names(maps))
    found: dict[str, NDArray] = {
        "squares": np.zeros((rows, count)),
        "ssim": np.full((rows, count), np.nan),
        "pixels": np.zeros(count, np.int32),
        "within": np.zeros((3, len(BANDS_DEG) - 1, count)),
        "sun": np.zeros(count),
    }
    measured_out, rendered_out = writer.dataset("measured"), writer.dataset("rendered")
    scales: dict[tuple[int, int], list[tuple[float, float]]] = {}  # of images in DN, by (image, map)
    for n, (k, number) in enumerate(chosen):
        progress(n, count, "held-out crops")
        albedo_map, frame = maps[number], int(reader.frame[k])
        pictures = albedo_map.render(reader, k)
        measured, valid = reader.image([k]).double(), reader.valid([k])
        valid &= torch.isfinite(torch.stack(pictures)).all(dim=0)
        if reader.units == "dn":
            if (frame, number) not in scales:
                scales[frame, number] = _image_scales(reader, albedo_map, frame)
            pictures = [p * gain + offset for p, (gain, offset) in zip(pictures, scales[frame, number], strict=True)]
        pictures += [match_crops(torch.nan_to_num(p), measured, valid, "gain_offset") for p in pictures]
        mask = valid[0].numpy()
        found["pixels"][n], found["sun"][n] = mask.sum(), _nearest_sun(reader, albedo_map.suns, k)
        measured_out[n] = np.where(mask, measured[0].numpy(), np.nan)
        spread = float(crop_range(measured, valid)[0])
        for row, picture in enumerate(pictures):
            values = picture[0].numpy()
            rendered_out[row, n] = np.where(mask, values, np.nan)
            found["squares"][row, n] = ((values - measured[0].numpy())[mask] ** 2).sum()
            found["ssim"][row, n] = ssim(measured[0].numpy(), np.nan_to_num(values), mask, data_range=spread)
        if reader.units == "iof":
            best = pictures[rows // 2 - 1][0].numpy()
            away = np.abs(best - measured[0].numpy())
            widths, incidence = _intervals(reader, albedo_map.error, k, best)
            away[~mask] = np.nan
            found["within"][:, :, n] = count_within(away, widths, incidence)
    return found


def _intervals(reader: PairReader, error: AlbedoError, k: int, rendered: NDArray) -> tuple[list[NDArray], NDArray]:
    """Half-widths (h, w), I/F, of the 68 and 95 % intervals of an unseen image about ``rendered``; incidence (h, w), rad."""
    state = illuminate(reader.observation([k]))
    cosine = state.angles.cos_incidence[0].numpy()
    visible = np.ones_like(cosine) if state.sun_visibility is None else state.sun_visibility[0].numpy()
    shadow = np.where(cosine > 0, 1 - visible, 1) > SHADOWED
    sine = max(0.0, float(reader.file["sun_direction_enu"][k][2]))
    rows, cols = _part(reader, k)
    widths = error.half_widths(rows.start, cols.start, rendered, cosine, shadow, sine)
    return widths, np.arccos(np.clip(cosine, -1.0, 1.0))


def _image_scales(reader: PairReader, albedo_map: AlbedoMap, frame: int) -> list[tuple[float, float]]:
    """Gain and offset of an image in DN for both renderings, by least squares on its train pairs (all pairs if none)."""
    mine = np.flatnonzero(reader.frame == frame)
    train = np.intersect1d(mine, reader.indices("train"))
    fitted = train if len(train) else mine
    fitted = fitted[:: max(1, len(fitted) // FIT_PAIRS)]
    count = len(_names([albedo_map])) // 2
    gram = FrameGram(1, count)
    for k in fitted:
        pictures = torch.stack(albedo_map.render(reader, int(k)))  # (maps, 1, h, w)
        valid = reader.valid([k]) & torch.isfinite(pictures).all(dim=0)
        measured = reader.image([k]).double()
        gram.add(pictures, measured.expand(count, -1, -1), valid.expand(count, -1, -1), np.arange(count))
    gain, offset = solve_gain_offset(gram.gram, np.ones(1))
    return list(zip(gain.tolist(), offset.tolist(), strict=True))


def _nearest_sun(reader: PairReader, suns: Floats, k: int) -> float:
    """Angle between a pair's Sun and the nearest of ``suns`` (n, 3), body-fixed unit vectors; rad."""
    file = reader.file
    east, north, up = (float(v) for v in file["sun_direction_enu"][k])
    turn = math.radians(float(file["convergence_deg"][k])) if "convergence_deg" in file else 0.0
    azimuth = math.atan2(east, north) - turn
    level = math.hypot(east, north)
    lon, lat = float(file["longitude_deg"][k]), float(file["latitude_deg"][k])
    zenith = unit_vectors(lon, lat)
    to_east = unit_vectors(lon + 90.0, 0.0)
    to_north = np.cross(zenith, to_east)
    sun = up * zenith + level * (math.sin(azimuth) * to_east + math.cos(azimuth) * to_north)
    return float(np.arccos(np.clip(suns @ sun, -1.0, 1.0)).min())


def _conclude(
    reader: PairReader,
    maps: Sequence[AlbedoMap],
    chosen: Sequence[tuple[int, int]],
    scores: dict[str, NDArray],
    config: HeldOutConfig,
) -> dict[str, Any]:
    """What the JSON holds."""
    pixels = scores["pixels"].astype(float)
    if not pixels.any():
        raise ArtefactError(f"split '{config.split}': expected valid pixels under unseen images, found none.")
    numbers = np.array([k for k, _ in chosen])
    unit, unit_name = choose_units(reader.tile[numbers], reader.site[numbers])
    models = {}
    names = _names(maps)
    for k, name in enumerate(names):
        mse = ratio_interval(scores["squares"][k], pixels, unit, ERROR)
        models[name] = {"mse": mse.value, "mse_low": finite(mse.low), "mse_high": finite(mse.high)}
        models[name]["ssim"] = finite(float(np.nanmean(scores["ssim"][k])))
    gains = {}
    for ours in (k for k in range(len(names)) if k % (len(names) // 2)):
        others = [ours - 1, *([ours - 2] if ours % (len(names) // 2) == 2 else [])]
        found = {names[k]: gain_interval(scores["squares"][ours], scores["squares"][k], unit) for k in others}
        gains[names[ours]] = {name: gain_entry(gain) for name, gain in found.items()}
    suns = np.degrees(scores["sun"])
    images = []
    for frame in np.unique(reader.frame[numbers]):
        mine = reader.frame[numbers] == frame
        total = max(1.0, float(pixels[mine].sum()))
        row = {"image_id": reader.image_ids[frame], "crops": int(mine.sum())}
        row |= {"nearest_used_sun_deg": float(suns[mine].mean())}
        row |= {f"mse_{name}": float(scores["squares"][k, mine].sum() / total) for k, name in enumerate(names)}
        images.append(row)
    return {
        "claim": CLAIM,
        "split": config.split,
        "models": models,
        "gains": gains,
        "images": images,
        "pairs": len(chosen),
        "tiles": len(np.unique(reader.tile[numbers])),
        "interval_unit": unit_name,
        "valid_pixels": int(pixels.sum()),
        "image_units": reader.units,
        "nearest_used_sun_deg": {"least": float(suns.min()), "mean": float(suns.mean()), "most": float(suns.max())},
        "coverage_percent": None if reader.units == "dn" else shares(scores["within"].sum(axis=2)),
        "used_images": [albedo_map.used for albedo_map in maps],
    }


def result_lines(result: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Columns and cells of the table of rows."""
    cells = []
    for name, row in result["models"].items():
        # few units bound the error on one side only
        ends = ["-" if row[k] is None else f"{row[k]:.3e}" for k in ("mse_low", "mse_high")]
        bounds = "-" if ends == ["-", "-"] else " .. ".join(ends)
        gain = next(iter(result["gains"].get(name, {}).values()), None)
        text = "-"
        if gain is not None:
            text = f"{gain['gain_percent']:+.1f} %"
            ends = ["-" if gain[k] is None else f"{gain[k]:+.1f}" for k in ("gain_percent_low", "gain_percent_high")]
            if ends != ["-", "-"]:
                text += f" ({' .. '.join(ends)})"
        cells.append([name, f"{row['mse']:.3e}", bounds, "-" if row["ssim"] is None else f"{row['ssim']:.3f}", text])
    before = "map before" if "refined" in result["models"] else "map without albedo"
    return ["map", "MSE", "95 % interval", "SSIM", f"lower MSE than the {before} by"], cells


def image_lines(result: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Columns and cells of the table of images."""
    maps = [name for name in MAPS if name in result["models"]]
    cells = [
        [
            row["image_id"],
            str(row["crops"]),
            f"{row['nearest_used_sun_deg']:.1f}",
            *(f"{row[f'mse_{m}']:.3e}" for m in maps),
        ]
        for row in result["images"]
    ]
    titles = ("MSE terrain", "MSE with albedo", "MSE refined")
    return ["unseen image", "crops", "nearest Sun used, deg", *titles[: len(maps)]], cells
