"""`lunargr diagnose`: what the simulation gets wrong, why, and what fixing it is worth.

data         measured pairs by site                      chain        the forward model, rendered with small changes
nominal      the model that is judged                    sampled      ... its start, from few pixels
form         ... or one of another form                  judged       pixels clear of relief that the DEM lacks
projection   texture and DEM error taken out, per pixel  columns      what effects add to images
preparing    a site's weights, texture and slopes        statistics   products per cluster of pixels
evidence     held-out gain and significance, scene-wide  images       effects with values per image
relief       a DEM's scale and smoothing                 pattern      a broad albedo pattern
plateau      highlights that are cut off                 looking      one look at all of that
naming       what deserves a name after it               refining     the values that fit best
contest      nearly equal candidates, each tried         gains        ... or what acts by image
selection    name, refine, look again                    state        what is known so far
parallel     sites side by side                          numbers      tails of distributions
unexplained  what is left, what is not seen              answer       verdict, JSON, diagnosis.h5
report       HTML
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from schemas import ArtefactError, ConfigError, atomic_path, check_output
from schemas.files.companions import companions_of
from stages.diagnose.answer import Answer, HeldOut, cause_json, held_out, parameters, write_diagnosis
from stages.diagnose.chain import Chain
from stages.diagnose.data import group_pairs, load_site, survey
from stages.diagnose.form import first_form, richer_form
from stages.diagnose.judged import LEAST, clear_and_lit
from stages.diagnose.looking import Round
from stages.diagnose.nominal import Nominal, fit, lit_mask, load_nominal
from stages.diagnose.plateau import CLEAR_OF, KEEP_BELOW, plateau, saturated
from stages.diagnose.refining import refine
from stages.diagnose.selection import enough, search
from stages.diagnose.state import Search
from stages.diagnose.unexplained import Structure, blind_effects, measure
from stages.effects import Effect, effect_names
from stages.pairs.reader import PairReader

HARM = 10.0  # percent by which unseen pairs may be predicted worse (the same texture in all images of few sites can do that)
MISFIT = 0.5  # rms residual over rms signal, beyond which the nominal model says nothing about the images


@dataclass(frozen=True)
class Config:
    """model : fitted where there is no checkpoint, in its coefficients ``free`` (() for all); most_pairs, most_sites : used for the search."""

    model: str = "M2"
    free: tuple[str, ...] = ()
    most_causes: int = 4
    most_images: int = 16
    most_pairs: int = 384
    most_sites: int = 64
    seed: int = 0


@dataclass
class Result:
    answer: Answer
    search: Search | None
    round: Round | None
    structure: Structure | None


@torch.no_grad()
def run(
    pairs: Path,
    checkpoint: Path | None = None,
    config: Config = Config(),
    output: Path | None = None,
    json_file: Path | None = None,
    report: Path | None = None,
    overwrite: bool = False,
    say: Callable[[str], None] | None = None,
    progress: Callable[[int, int, str], None] | None = None,
) -> Result:
    """Diagnose the pairs; write what is asked for. Raises ArtefactError, ConfigError, RegistryError."""
    if config.most_causes < 1 or config.most_pairs < 1 or config.most_images < 1:
        raise ConfigError("diagnose: expected counts of at least 1 for causes, images and pairs.")
    inputs = [p for p in (pairs, checkpoint) if p is not None]
    for path in (output, json_file, report):
        if path is not None:
            check_output(path, inputs, overwrite)
    with PairReader(pairs) as reader:
        result = diagnose(reader, checkpoint, config, say or (lambda _: None), progress or (lambda *_: None))
        image_ids = reader.image_ids
    with companions_of(output):
        if json_file is not None:
            with atomic_path(json_file) as partial:
                partial.write_text(json.dumps(result.answer.to_json(), indent=1))
        if report is not None:
            from stages.diagnose.report import write_report

            write_report(report, result)
    if output is not None:  # last: where it is, the others are
        write_diagnosis(output, result.answer, image_ids, inputs, overwrite)
    return result


def diagnose(reader: PairReader, checkpoint: Path | None, config: Config, say, progress) -> Result:
    """The whole decision on an open file."""
    if "sun_horizon_deg" not in reader.file:
        raise ArtefactError(
            f"{reader.path}:/sun_horizon_deg: expected the terrain horizon (without it shadows cannot be told from dark ground), "
            "found none; write the pairs again with 'lunargr project'."
        )
    nominal = load_nominal(checkpoint, config.model, reader.units, config.free)
    train, test = _split(reader)
    groups = group_pairs(reader, train, config.most_images)
    sites, used = [], 0
    for members in groups:
        if used and (used + len(members) > config.most_pairs or len(sites) >= config.most_sites):
            break
        sites.append(load_site(reader, members))
        used += len(members)
    answer = Answer("cannot_tell", config={**dataclasses.asdict(config), "checkpoint": str(checkpoint or "")})
    answer.pairs, answer.sites = used, len(sites)
    answer.images = len({int(f) for s in sites for f in s.frames})
    few = enough(sites) if sites else "no pairs to learn from"
    if few:
        answer.note, answer.blind = few, effect_names()
        return Result(answer, None, None, None)
    cut = None if reader.units == "dn" else plateau(sites)
    for site in sites if cut is not None else []:
        site.valid &= site.image < KEEP_BELOW * cut
    measured, valid = [s.image for s in sites], [s.valid for s in sites]

    def begin(nominal: Nominal) -> Search:
        """The search at its start, with this nominal model."""
        for site, image, mask in zip(sites, measured, valid, strict=True):
            site.as_read(image, mask)
        fit(nominal, sites, [], reader.units, measured, start=True)
        if cut is not None:  # leaving out by the measured value alone would keep the dark half of the noise
            for site in sites:
                site.valid = site.valid & (nominal.chain(site, []).textured < CLEAR_OF * cut)
            fit(nominal, sites, [], reader.units, measured)
        data, clear = survey(sites, len(reader.image_ids)), [s.valid for s in sites]
        has = frozenset({"sun_horizon"})
        state = Search(
            nominal, sites, data, len(reader.image_ids), reader.units, has, progress, measured=measured, valid=clear,
            replaced=bool(answer.form),
        )  # fmt: skip
        if cut is not None:
            state.causes.append(saturated(cut, data, sites))
        return state

    state = begin(nominal)
    if not config.free and (form := first_form(state)):
        say(f"{nominal.model.name} has the wrong form: {form} is fitted in its place")
        answer.form, nominal = form, load_nominal(None, form, reader.units)
        state = begin(nominal)
    clear, lit = (sum(of) for of in zip(*state.each(clear_and_lit), strict=True))
    share = clear / max(lit, 1.0)
    if share < LEAST:
        answer.blind = effect_names()
        answer.note = (
            f"the Sun is too low over this ground: {100 * share:.0f} % of the lit pixels lie in images that see most of their lit ground "
            f"clear of its own slopes, {100 * LEAST:.0f} % are needed; add images with a higher Sun"
        )
        return Result(answer, state, None, None)
    misfit = _misfit(state)
    if not misfit < MISFIT:
        answer.verdict, answer.unexplained_fraction = "unexplained", 1.0
        answer.note = (
            f"the nominal model does not fit at all: its residual has {100 * misfit:.0f} % of the images' own variation about "
            "zero; check units, Sun direction and registration before any cause is sought"
        )
        return Result(answer, state, None, None)
    seen = search(state, config.most_causes, say)
    structure = measure(seen.works)
    while form := state.form or richer_form(state, seen, _unexplained(state, structure) > 0.5):
        say(f"{nominal.model.name} has the wrong form: {form} alone explains more")
        answer.form, nominal = form, load_nominal(None, form, reader.units)
        state = begin(nominal)
        seen = search(state, config.most_causes, say)
        structure = measure(seen.works)
    state.restore()
    _decide(answer, state, seen, structure)
    hidden = [load_site(reader, g) for g in group_pairs(reader, test, config.most_images)[:64]]
    tiles = [reader.tile[s.pairs] for s in hidden]
    effects = [c.effect for c in answer.causes]
    # shifts that are ordinary, and no cause, are taken out under both models
    shifts = [] if state.aligned is None or any(e.name == state.aligned.name for e in effects) else [state.aligned]
    for site in hidden if cut is not None else []:
        site.valid &= site.image < KEEP_BELOW * cut

    def score(causes: list[Effect]) -> HeldOut:
        models = (state.reference, nominal if causes else state.reference)
        return held_out(hidden, tiles, models, (shifts, [*causes, *shifts]), state.dn, config.seed)

    answer.held_out = score(effects)
    while answer.causes and answer.held_out.high < -HARM:  # what predicts unseen ground worse explains nothing
        _withdraw_last(answer, state)
        answer.held_out = score([c.effect for c in answer.causes])
    return Result(answer, state, seen, structure)


def _split(reader: PairReader) -> tuple[np.ndarray, np.ndarray]:
    """Pairs to learn from and pairs to score: the test split, or the last of at least three sites."""
    test = np.flatnonzero(reader.split == 2)
    train = np.flatnonzero(reader.split != 2)
    if len(train) and len(test):
        return train, test
    everything = np.arange(reader.count)
    numbers = np.unique(reader.site)
    if len(numbers) >= 3:
        last = reader.site == numbers[-1]
        return everything[~last], everything[last]
    return everything, everything[:0]


def _misfit(state: Search) -> float:
    """rms residual over rms signal on fully lit pixels."""

    def of(chain: Chain) -> tuple[float, float]:
        mask, image = lit_mask(chain), chain.site.image
        level = torch.zeros(len(image))
        if state.dn:  # the free offset takes the mean: only variation counts
            level = (image * mask).sum((-2, -1)) / mask.sum((-2, -1)).clamp(min=1)
        varied = (image - level[:, None, None]) * mask
        left = (image - chain.predict()) * mask
        return float(varied.double().square().sum()), float(left.double().square().sum())

    signal, residual = (sum(x) for x in zip(*state.each(of), strict=True))
    ratio = (residual / signal) ** 0.5 if signal > 0 else float("inf")
    return ratio * (0.5 if state.dn else 1.0)  # film and texture: half of the variation may stay and say something


def _decide(answer: Answer, state: Search, seen: Round, structure: Structure) -> None:
    """The verdict from what was named, what is left and what could not be seen."""
    answer.blind = blind_effects(state, seen)
    answer.unexplained_fraction = _unexplained(state, structure)
    if answer.unexplained_fraction > 0.5:
        answer.verdict = "unexplained"
        ranked = sorted(seen.best.values(), key=lambda e: -e.gain)
        answer.closest = [c.effect.name for c in state.causes] or [e.effect for e in ranked[:1]]
    elif state.causes:
        answer.verdict = "named"
        answer.causes = list(state.causes)
    elif answer.blind:
        answer.verdict = "cannot_tell"
    else:
        answer.verdict = "nothing_significant"


def _unexplained(state: Search, structure: Structure) -> float:
    """Share of what the nominal model misses that no named cause explains; 0 where nothing more than noise is left."""
    explained = sum(c.fid**2 for c in state.causes)
    left = structure.largest**2 if structure.present else 0.0
    if structure.present and structure.largest**2 < 1e-3:
        left = 1e-3 * structure.peak
    return left / (left + explained) if left > 0 else 0.0


def _withdraw_last(answer: Answer, state: Search) -> None:
    """Take the cause named last out of the model and of the answer; what it stood for is unexplained."""
    names = [c.effect.name for c in answer.causes]
    explained = sum(c.fid**2 for c in state.causes)
    unexplained = explained * answer.unexplained_fraction / max(1 - answer.unexplained_fraction, 1e-9)
    unexplained += state.causes.pop().fid ** 2
    explained = sum(c.fid**2 for c in state.causes)
    if state.causes:
        refine(state)
    else:
        state.fit()
    state.restore()
    answer.causes = list(state.causes)
    answer.unexplained_fraction = unexplained / (unexplained + explained)
    if explained < unexplained:
        answer.verdict, answer.closest, answer.causes = "unexplained", names, []


__all__ = ["Answer", "Config", "Result", "cause_json", "diagnose", "parameters", "run"]
