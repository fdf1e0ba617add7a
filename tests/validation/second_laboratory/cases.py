"""Deal cases and make them: files in which an effect, a fault or nothing is hidden, each with its truth."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .effects import EFFECTS
from .faults import FAULTS
from .hidden import NOTHING, Hidden
from .pairs_file import write_pairs
from .randomness import generator
from .simulate import Simulator
from .strength import choose, measure
from .world import LAYOUTS, make_world

NULLS, PLANTED, FAULTY = 14, 22, 8  # in a hand of 44
DETAILS = {"side_deg", "shading", "axis"}  # parameters of ours that the catalogue does not name


@dataclass(frozen=True)
class Deal:
    """What a case hides: an effect, a fault or neither, in a layout."""

    layout: str
    effect: str | None = None
    fault: str | None = None
    given_law: bool = False  # the ground follows the law that `diagnose` is given


def endless(rng: np.random.Generator, names: list[str], count: int) -> list[str]:
    """Names in shuffled rounds, so that each comes equally often."""
    rounds = [rng.permutation(names) for _ in range(count // len(names) + 1)]
    return [str(name) for name in np.concatenate(rounds)[:count]]


def deal(seed: int, count: int) -> list[Deal]:
    """`count` cases in shuffled hands of 44: 14 with nothing hidden, 22 effects, 8 faults."""
    rng = generator(seed, "deal")
    hands = count // (NULLS + PLANTED + FAULTY) + 1
    effects = endless(rng, list(EFFECTS), hands * PLANTED)
    faults = endless(rng, list(FAULTS), hands * FAULTY)
    cases: list[Deal] = []
    for hand in range(hands):
        kinds: list[tuple[str | None, str | None]] = [(None, None)] * NULLS
        kinds += [(name, None) for name in effects[hand * PLANTED : (hand + 1) * PLANTED]]
        kinds += [(None, name) for name in faults[hand * FAULTY : (hand + 1) * FAULTY]]
        # Layouts go round within nulls, effects and faults apart, so that none of them is bound to a layout.
        layouts = [layout for n in (NULLS, PLANTED, FAULTY) for layout in endless(rng, list(LAYOUTS), n)]
        dealt = [Deal(layout, *kind) for layout, kind in zip(layouts, kinds, strict=True)]
        cases += [dealt[k] for k in rng.permutation(len(dealt))]
    return cases[:count]


def case_units(dealt: Deal, seed: int) -> str:
    """I/F, but uncalibrated numbers where an effect shows in nothing else, and in some nulls to match."""
    if dealt.effect == "frame_field":
        return "dn"
    plain = dealt.effect is None and dealt.fault is None
    return "dn" if plain and generator(seed, "units").uniform() < 0.1 else "1"


def make_case(number: int, dealt: Deal, seed: int, path: Path) -> dict:
    """Write the pairs file of case `number` and return its truth."""
    case_seed = int(generator(seed, "case", number).integers(2**31))
    world = make_world(case_seed, dealt.layout, dealt.effect, dealt.given_law)
    simulator = Simulator(world)
    name = dealt.effect or dealt.fault
    hidden, measured = choose(simulator, name, case_seed) if name else (NOTHING, "fid")
    if not name:
        hidden = Hidden(None, {}, case_seed)
    size = {"fid": 0.0, "fid_abs_all_pixels": 0.0, "rms_of_pair_gains": 0.0}
    if name:
        size = measure(simulator, hidden, list(range(len(world.pairs))))
    units = case_units(dealt, case_seed)
    write_pairs(simulator, hidden, Path(path), units)
    named = {key: value for key, value in hidden.values.items() if key not in DETAILS}
    return {
        "case": number,
        "seed": seed,
        "layout": dealt.layout,
        "planted": {dealt.effect: named} if dealt.effect else {},
        "fault": {dealt.fault: hidden.values["size"]} if dealt.fault else {},
        "fault_unit": FAULTS[dealt.fault].unit if dealt.fault else "",
        "details": {key: value for key, value in hidden.values.items() if key in DETAILS},
        "unknown": dealt.fault is not None,
        "law": f"{world.law.name}, parameters vary within and between sites",
        "world": world.text,
        "units": units,
        **size,
        "calibrated_on": measured,
        "images": len(world.frames),
        "ordinary": {
            "dem_sigma2_px2": float(world.dem_variance),
            "dem_scale_error": float(world.dem_scale_error),
            "blur_sigma2_px2": world.ordinary_blur(),
            "interreflection_strength": float(world.scattered),
            "image_gain_rms": float(np.std([frame.gain_error for frame in world.frames])),
        },
    }
