"""The stage: load, register, look, propose, judge, confirm, report."""

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
from stages.diagnose.data.sites import Site, all_over, grounds, load_site, survey
from stages.diagnose.faults import faults
from stages.diagnose.judge.blind import blind_effects
from stages.diagnose.judge.claim import Refusal
from stages.diagnose.judge.state import State
from stages.diagnose.model.nominal import Nominal, fit, load_nominal, relative_misfit
from stages.diagnose.registration.explain import explain
from stages.diagnose.result.answer import Answer, Named
from stages.diagnose.result.budget import budget, mean_square
from stages.diagnose.result.causes import by_search, in_words
from stages.diagnose.result.files import write_diagnosis
from stages.diagnose.result.held_out import displacements, score
from stages.diagnose.settings import MISFIT
from stages.diagnose.sources.clipping import Cut, by_clipping, by_histogram
from stages.diagnose.sources.frames import by_images
from stages.diagnose.sources.ground import by_ground
from stages.diagnose.sources.measured import Measured
from stages.diagnose.sources.placed import by_registration
from stages.diagnose.sources.search import Outcome, finish, search
from stages.diagnose.sources.shadows import by_shadows
from stages.diagnose.sources.walls import hide_dark
from stages.effects import effect_names
from stages.pairs.ground import leave_out_learned
from stages.pairs.reader import PairReader

CROP = 128  # px: so large are the pairs that are counted, and of larger ones fewer are taken, for the memory that they need
HIDDEN_SITES = 64  # of the test pairs that are scored


@dataclass
class Result:
    """What a run gives; ``state`` is None where nothing was searched."""

    answer: Answer
    state: State | None

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


def diagnose(reader: PairReader, checkpoint: Path | None, config: Config, say: Say, progress: Progress) -> Result:
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
    sites = load(reader, train, config)
    hidden = load(reader, test, dataclasses.replace(config, most_sites=HIDDEN_SITES))
    answer = Answer("cannot_tell", config={**dataclasses.asdict(config), "checkpoint": str(checkpoint or "")})
    answer.pairs, answer.sites = sum(s.count for s in sites), len(sites)
    answer.images = len({int(f) for s in sites for f in s.frames})
    if not sites:
        answer.note, answer.blind = "too few pixels of the pairs show lit ground", effect_names()
        return Result(answer, None)
    cut = by_histogram(sites)
    state = start(nominal, sites, hidden, reader, config, say, progress)
    before = mean_square(state)
    if not before > 0:
        answer.note, answer.blind = "too few pixels of the pairs show fully lit ground", effect_names()
        return Result(answer, state)
    progress(1, 4, "registration")
    register(state)
    varied = reader.units == "dn"
    misfit = relative_misfit(nominal, sites, varied=varied, whole=True) * (0.5 if varied else 1.0)
    if not misfit < MISFIT:
        answer.verdict, answer.unexplained_fraction = "unexplained", 1.0
        answer.note = (
            f"the nominal model does not fit at all: its residual has {100 * misfit:.0f} % of the images' own signal; "
            "check units, Sun direction and registration before any cause is sought"
        )
        return Result(answer, state)
    progress(2, 4, "search")
    outcome = search(state, config.most_causes)
    if state.named and state.registration is not None and state.registration.displaced:
        register(state)  # what looked like a displacement may have been a cause that is named by now
        finish(state, outcome)
    progress(3, 4, "judging")
    judge(answer, state, outcome, cut, before)
    return Result(answer, state)


def start(
    nominal: Nominal,
    sites: list[Site],
    hidden: list[Site],
    reader: PairReader,
    config: Config,
    say: Say,
    progress: Progress,
) -> State:
    """The nominal model fitted to the images where they were read, without ground that a wall beyond the DEM darkens."""
    frames, units = len(reader.image_ids), reader.units
    read = [s.read for s in sites]
    fit(nominal, sites, [], units, read, start=True)
    if not config.law_known:
        nominal.open_law(sites)
        fit(nominal, sites, [], units, read, law=True)
    data, has = survey(sites, frames, units), frozenset({"sun_horizon"})
    state = State(nominal, sites, data, frames, units, has, config.seed, hidden, say=say, progress=progress)
    state.leave_out_rare_images()
    hide_dark(state)
    return state


def register(state: State) -> None:
    """Find where the images lie beside the causes so far, lay them there, and fit the nominal model."""
    state.registration = explain(state.sites, state.nominal, state.base, state.frames, state.data.elevation[0])
    placed = state.registration.displaced
    for site, known in zip(state.sites, state.registration.known, strict=True):
        site.displacement = known if placed else None
    for site, found in zip(state.hidden, displacements(state, [])[1], strict=True):
        site.displacement = found if placed else None
    state.fit(law=True)


def judge(answer: Answer, state: State, outcome: Outcome, cut: Cut | None, before: float) -> None:
    """Decide on the claims of all sources and write everything into the answer; before : mean square of the residual when nothing was known"""
    after, view = mean_square(state), outcome.view
    if state.causes:  # where the images lie now, beside no cause
        before = max(before, mean_square(dataclasses.replace(state, causes=[], nominal=state.beside([]))))
    words = in_words(state)
    claims = [by_clipping(state, cut)] if cut else []
    claims += [*by_registration(state), *by_ground(state), *by_images(state)]
    for site in state.sites:
        site.show()
    claims += by_shadows(state)
    decided = [(claim, claim.decide()) for claim in claims]
    found = [claim.named for claim, refusal in decided if refusal is None]
    words |= {f"{c.effect.title}": c.percent[0] / 100 for c in found if not c.effect.listed}
    named, answer.ordinary = by_search(state, outcome)
    answer.causes = _in_order(named, [c for c in found if c.effect.listed])
    rejected = outcome.refused | {claim.name: refusal for claim, refusal in decided if refusal is not None}
    there = {c.effect.name for c in [*answer.causes, *answer.ordinary]}
    answer.rejected = {k: v for k, v in rejected.items() if k in effect_names() and k not in there and _tells(v)}
    if state.registration is not None:
        answer.registration = {k: (g.percent, g.low, g.high) for k, g in state.registration.gains.items()}
    answer.law = state.law
    answer.budget = budget(view.rows, view.model, view.grid, before, after)
    answer.structure = words | faults(state, view)
    if cut and not any(c.effect.name == cut.cls.name for c in answer.causes):
        answer.structure["brightness that piles up at one level"] = cut.share
    shown = there | {claim.name for claim in claims if claim.would_show()}
    answer.blind = blind_effects(state, outcome, shown)
    answer.unexplained_fraction = max(answer.structure.values(), default=0.0)
    if not answer.causes and outcome.strange:
        answer.unexplained_fraction = max(answer.unexplained_fraction, 0.01)
    answer.verdict = verdict(answer)
    answer.held_out = score(state, answer, _extended(state, [c for c, refusal in decided if refusal is None]))


def _tells(refusal: Refusal) -> bool:
    """Whether a refusal is of something that had evidence."""
    return refusal.gain > 0


def _in_order(search: Sequence[Named], others: Sequence[Named]) -> list[Named]:
    """Displacements and clipping first, which were taken out before anything was sought; then by gain."""
    first = [c for c in others if c.effect.judged_apart]
    return [*sorted(first, key=lambda c: -c.gain), *search, *(c for c in others if c not in first)]


def _extended(state: State, claims: Sequence[Measured]) -> Nominal:
    """The nominal model as it is fitted beside all named causes."""
    more = [c.named.effect for c in claims if not c.named.effect.judged_apart and c.named.effect.scope == "scene"]
    return state.beside([*(c.effect for c in state.named), *more])


def verdict(answer: Answer) -> str:
    """In one word."""
    if answer.causes:
        return "named"
    if answer.unexplained_fraction:
        return "unexplained"
    return "cannot_tell" if answer.blind else "nothing_significant"


def load(reader: PairReader, pairs: np.ndarray, config: Config) -> list[Site]:
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
