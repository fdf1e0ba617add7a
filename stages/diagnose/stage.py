"""The stage: the whole decision, in the order in which the package's own text tells it."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from schemas import ArtefactError, ConfigError, atomic_path, write_json
from schemas.files.outputs import Output
from stages.common.progress import Progress, Say
from stages.common.runner.job import Job
from stages.diagnose import run
from stages.diagnose.config import Config
from stages.diagnose.likelihood.budget import budget
from stages.diagnose.model.chain import Chain
from stages.diagnose.model.form import better_form, other_laws, relative_misfit
from stages.diagnose.model.laws import LunarLaws
from stages.diagnose.model.nominal import Nominal, fit, lit_mask, load_nominal
from stages.diagnose.model.parallel import per_site
from stages.diagnose.model.sites import Site, all_over, grounds, load_site, survey
from stages.diagnose.registration.explain import explain
from stages.diagnose.registration.mimicked import mimicked_shift
from stages.diagnose.result.answer import Answer, Named
from stages.diagnose.result.files import write_diagnosis
from stages.diagnose.result.named import Cut, by_catalogue, by_histogram, by_registration, by_search, outside_catalogue
from stages.diagnose.result.score import (
    beside_shadows,
    blind_effects,
    contradiction,
    contradicts,
    displacements,
    score,
    unconfirmed,
)
from stages.diagnose.search.doubts import doubt_all
from stages.diagnose.search.frames import by_images
from stages.diagnose.search.ground import by_ground
from stages.diagnose.search.refine import settle
from stages.diagnose.search.select import Outcome, search
from stages.diagnose.search.shadows import by_shadows, contradicted
from stages.diagnose.search.state import State
from stages.diagnose.search.walls import hide_dark
from stages.diagnose.settings import MIMICKED, MISFIT, STILL
from stages.diagnose.structure.kinds import PILED, structure
from stages.effects import effect_names, get_effect
from stages.pairs.ground import leave_out_learned
from stages.pairs.reader import PairReader

CROP = 128  # px: so large are the pairs that are counted, and of larger ones fewer are taken, for the memory that they need


@dataclass
class Result:
    """What a run gives; ``state`` and ``outcome`` are None where nothing was searched."""

    answer: Answer
    state: State | None
    outcome: Outcome | None

    @property
    def report(self) -> dict[str, Any]:
        """The answer as it stands in the JSON file."""
        return self.answer.to_json()


@dataclass
class Finished:
    """The result of a run on another machine."""

    report: dict[str, Any]


@torch.no_grad()
def work(pairs: Path, checkpoint: Path | None, output: Output, config: Config, say: Say, progress: Progress) -> Result:
    """See :func:`stages.diagnose.run`."""
    if config.most_causes < 1 or config.most_pairs < 1 or config.most_images < 1:
        raise ConfigError("diagnose: expected counts of at least 1 for causes, images and pairs.")
    inputs = [p for p in (pairs, checkpoint) if p is not None]
    with PairReader(pairs) as reader:
        result = diagnose(reader, checkpoint, config, say, progress)
        image_ids = reader.image_ids
    if output.json is not None:
        write_json(output.json, result.report)
    if output.report is not None:
        from stages.diagnose.result.page import write_page

        write_page(output.report, result.answer, result.state, image_ids)
    if output.path is not None:  # last: where it is, the others are
        write_diagnosis(output.path, result.answer, image_ids, inputs)
    return result


def in_parts(job: Job, pairs: Path, checkpoint: Path | None, config: Config) -> Finished:
    """The whole diagnosis as one part, since its steps depend on each other."""
    (piece,) = job.fan("diagnosis", write_part, [{"pairs": pairs, "checkpoint": checkpoint, "config": config}])
    output = job.output
    for made, wanted in ((".json", output.json), (".html", output.report), (".h5", output.path)):
        if wanted is not None:
            with atomic_path(wanted) as partial:
                shutil.copyfile(piece.with_suffix(made), partial)
    return Finished(json.loads(piece.with_suffix(".json").read_text()))


def write_part(path: Path, pairs: Path, checkpoint: Path | None, config: Config) -> None:
    """Write diagnosis.h5, and its JSON and page beside it."""
    beside = Output(path, overwrite=True, json=path.with_suffix(".json"), report=path.with_suffix(".html"))
    run(pairs, checkpoint, beside, config)


def diagnose(reader: PairReader, checkpoint: Path | None, config: Config, say, progress) -> Result:
    """The whole decision on an open file."""
    if "sun_horizon_deg" not in reader.file:
        raise ArtefactError(
            f"{reader.path}:/sun_horizon_deg: expected the terrain horizon (without it shadows cannot be told from dark ground), "
            "found none; write the pairs again with 'lunargr project'."
        )
    nominal = load_nominal(checkpoint, config.model, reader.units, config.free)
    train, test = split(reader)
    if checkpoint is not None:
        test, notes = leave_out_learned(reader, test, checkpoint, "test")
        for note in notes:
            say(f"note: {note}")
    sites = _load(reader, train, config)
    hidden = _load(reader, test, dataclasses.replace(config, most_sites=64))
    answer = Answer("cannot_tell", config={**dataclasses.asdict(config), "checkpoint": str(checkpoint or "")})
    answer.pairs, answer.sites = sum(s.count for s in sites), len(sites)
    answer.images = len({int(f) for s in sites for f in s.frames})
    if not sites:
        answer.note, answer.blind = "too few pixels of the pairs show lit ground", effect_names()
        return Result(answer, None, None)
    frames, units = len(reader.image_ids), reader.units
    cut = by_histogram(sites, units)
    fit(nominal, sites, [], units, [s.read for s in sites], start=True)
    nominal.laws = other_laws(nominal, sites, units)
    data = survey(sites, frames, units)
    if other := better_form(nominal, sites, data):
        nominal = other
        fit(nominal, sites, [], units, [s.read for s in sites])
    state = State(
        nominal, sites, data, frames, units, frozenset({"sun_horizon"}), config.seed, hidden, say=say, progress=progress
    )
    state.leave_out_rare_images()
    if hide_dark(state):
        nominal.laws = other_laws(nominal, sites, units)
    before = _residual(state)
    if not before > 0:
        answer.note, answer.blind = "too few pixels of the pairs show fully lit ground", effect_names()
        return Result(answer, state, None)
    progress(1, 5, "registration")
    _register(state)
    misfit = relative_misfit(nominal, sites, varied=units == "dn", whole=True) * (0.5 if units == "dn" else 1.0)
    if not misfit < MISFIT:
        answer.verdict, answer.unexplained_fraction = "unexplained", 1.0
        answer.note = (
            f"the nominal model does not fit at all: its residual has {100 * misfit:.0f} % of the images' own signal; "
            "check units, Sun direction and registration before any cause is sought"
        )
        return Result(answer, state, None)
    progress(2, 5, "search")
    outcome = search(state, config.most_causes)
    doubted = unconfirmed(state) | contradicted(state)
    # what the test pairs refuse may have stood for another law
    if any(get_effect(name).of_law for name in doubted) and state.choose_law(doubted):
        outcome = search(state, config.most_causes)
        doubted = unconfirmed(state) | contradicted(state)
    if isinstance(state.nominal.model, LunarLaws):
        answer.form = state.nominal.model.title
        say(f"{config.model} is not the ground's law: {answer.form} took its place")
    _fill(answer, state, outcome, doubted, cut, before)
    return Result(answer, state, outcome)


def _fill(
    answer: Answer,
    state: State,
    outcome: Outcome,
    doubted: dict[str, tuple[float, str]],
    cut: Cut | None,
    before: float,
) -> None:
    """Doubt what the search found once more, look at what is judged apart, and write all of it into the answer.

    doubted : what was taken back already; cut : what the histogram shows; before : mean square of the residual when nothing was known
    """
    view, beside = outcome.view, outcome.beside
    assert view is not None and beside is not None
    if again := _mimics_displacement(state):  # what looked like one may have been a cause that is named by now
        _register(state)
    if doubted or again:
        settle(state, beside)
        doubted |= doubt_all(state, beside, STILL)
    after = _residual(state)
    left = outside_catalogue(state) | structure(state, view, cut[1] if cut else 0.0)
    ordinary = {c.effect.name for c in state.causes} - {c.effect.name for c in state.named}
    if ordinary:  # rendered to judge the others beside it; from here on the simulation is what is named, and no more
        before *= after / _without_ordinary(state)
        doubted |= unconfirmed(state)
    placed, refused = by_registration(state)
    clipped = cut[0](state.data, state) if cut else None  # was taken out of the images before anything was sought
    if clipped:
        left.pop(PILED, None)
    ground, shown = by_ground(state)
    fields, fields_shown = by_images(state)
    fields, more = by_catalogue(fields)
    left |= more
    shaded, extended, contrary = _by_shadows(state)
    answer.causes = placed + ([clipped] if clipped else []) + by_search(state) + [*shaded] + ground + fields
    answer.held_out = score(state, answer, extended)
    # albedo that follows relief, of which nobody is sure, looks like a shift
    if placed and contradicts(answer.held_out.high):
        refused |= {c.effect.name: (c.gain, contradiction(answer.held_out.gain, answer.held_out.high)) for c in placed}
        answer.causes = [c for c in answer.causes if c not in placed]
        answer.held_out = score(state, answer, extended)
    rejected = refused | outcome.rejected | doubted | contrary
    answer.rejected = {
        k: v for k, v in rejected.items() if k in effect_names() and k not in {c.effect.name for c in answer.causes}
    }
    if state.registration is not None:
        answer.registration = {k: (g.percent, g.low, g.high) for k, g in state.registration.gains.items()}
    # what a better law or registration took away is no cause where none is named
    answer.budget = budget(view.rows, view.model, view.grid, before if answer.causes else after, after)
    answer.structure = left
    answer.blind = blind_effects(
        state, outcome, shown | fields_shown | ordinary | {c.effect.name for c in answer.causes}
    )
    answer.unexplained_fraction = max(answer.structure.values(), default=0.0)
    if not answer.causes and outcome.sure:
        answer.unexplained_fraction = max(answer.unexplained_fraction, 0.01)
    answer.verdict = _verdict(answer)


def _register(state: State) -> None:
    """Find where the images lie beside the causes that are named so far, lay them there, and fit the nominal model."""
    state.registration = explain(state.sites, state.nominal, state.base, state.frames, state.data.elevation[0])
    placed = state.registration.displaced
    for site, known in zip(state.sites, state.registration.known, strict=True):
        site.displacement = known if placed else None
    for site, found in zip(state.hidden, displacements(state, [])[1], strict=True):
        site.displacement = found if placed else None
    state.fit()


def _mimics_displacement(state: State) -> bool:
    """Whether images are displaced and that has a part of what the named causes do."""
    if not state.named or state.registration is None or not state.registration.displaced:
        return False
    ordinary = [c.effect for c in state.causes if c.ordinary]
    without = per_site(lambda site: state.nominal.chain(site, ordinary), state.sites)
    return mimicked_shift(state.chains(), without) > MIMICKED * state.registration.shift_error


def _by_shadows(state: State) -> tuple[Sequence[Named], Nominal, dict[str, tuple[float, str]]]:
    """What shadows tell and the test pairs do not refuse, the nominal model as it is fitted beside that, and what is refused."""
    for site in state.sites:
        site.show()
    found, refused = by_shadows(state)
    return beside_shadows(state, found) if found else ([], state.nominal, refused)


def _verdict(answer: Answer) -> str:
    if answer.causes:
        return "named"
    if answer.unexplained_fraction:
        return "unexplained"
    return "cannot_tell" if answer.blind else "nothing_significant"


def _load(reader: PairReader, pairs: np.ndarray, config: Config) -> list[Site]:
    """Sites that share no ground, those that most images show first, from all over the scene."""
    sites: list[Site] = []
    used = 0
    every = grounds(reader, pairs, config.most_images)
    most_pairs = int(config.most_pairs * min(1.0, CROP**2 / math.prod(reader.size)))
    for members in all_over(every, most_pairs, config.most_sites):
        if used and (used + len(members) > most_pairs or len(sites) >= config.most_sites):
            break
        site = load_site(reader, members)
        if site is not None:
            sites.append(site)
            used += site.count
    return sites


def _residual(state: State) -> float:
    """Mean square of the relative residual in the windows."""
    from stages.diagnose.rows.patches import make_patches

    grid, pieces = state.grid()
    total, count = 0.0, 0.0
    for k, chain in enumerate(state.chains()):
        residual = (chain.site.image - chain.predict())[None]
        if (
            state.free_gains
        ):  # relative to the image as it was read: a gain that is fitted too low would blow residuals up
            residual = residual * _as_read(chain)
        for patch in make_patches(k, chain, pieces, state.free_gains):
            z, mean = patch.transform(residual, grid)
            total += float((z.real.square() + z.imag.square()).sum())
            area = patch.weight.square().sum((-2, -1))
            if not patch.free:
                total += float((mean.square() * area).sum())
            count += float(area.sum())
    return total / count if count else math.nan


def _without_ordinary(state: State) -> float:
    """Take what is ordinary out of the model, fit the nominal one again; the mean square of the residual then."""
    state.causes[:] = state.named
    state.fit()
    return _residual(state)


def _as_read(chain: Chain) -> torch.Tensor:
    """(n, 1, 1) by which a residual over the prediction's mean gets one over the read image's mean."""
    site = chain.site
    lit = lit_mask(chain).float()
    count = lit.sum((-2, -1)).clamp(min=1)
    ratio = (chain.predict() * lit).sum((-2, -1)) / count * site.gain.abs()
    return (ratio / ((site.read * lit).sum((-2, -1)) / count).clamp(min=1e-9))[:, None, None]


def split(reader: PairReader) -> tuple[np.ndarray, np.ndarray]:
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
