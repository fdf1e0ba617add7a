"""How strong a hidden thing is in the images, and the search for a wanted strength."""

from collections.abc import Callable

import numpy as np

from .effects import EFFECTS, unit_displacement
from .faults import FAULTS
from .hidden import NOTHING, Hidden
from .randomness import generator, log_uniform
from .simulate import Simulator
from .world import LOW_SUN

SUBSET = 8  # pairs that the search looks at


def noise_rms(simulator: Simulator, pair: int, clean: np.ndarray, lit: np.ndarray) -> float:
    """Rms of an image's noise over lit pixels, I/F, without its gain error."""
    noisy = simulator.map_image(pair, NOTHING, noisy=True)
    lit = lit if lit.sum() > 100 else np.ones(clean.shape, bool)
    ratio = noisy[lit].sum() / clean[lit].sum()
    return float((noisy / ratio - clean)[lit].std())


def without_plane(field: np.ndarray, used: np.ndarray) -> np.ndarray:
    """The field less the plane that fits it best over the used pixels; NaN elsewhere."""
    if used.sum() < 100:
        return np.full(field.shape, np.nan)
    row, col = np.indices(field.shape) / field.shape[0] - 0.5
    terms = np.stack([np.ones(field.shape), row, col], -1)
    weights = np.linalg.lstsq(terms[used], field[used], rcond=None)[0]
    return np.where(used, field - terms @ weights, np.nan)


def measure(simulator: Simulator, hidden: Hidden, pairs: list[int]) -> dict[str, float]:
    """fid, fid_abs_all_pixels and rms_of_pair_gains of what is hidden, over some pairs.

    fid: rms over lit pixels of the noise-free difference, less a plane per image and the mean over images of
    each ground pixel, over the rms of the image's noise. fid_abs_all_pixels: the bare difference, all pixels.
    """
    by_site: dict[int, list[np.ndarray]] = {}
    squares, gains = [], []
    for pair in pairs:
        with_it = simulator.map_image(pair, hidden, noisy=False)
        without = simulator.map_image(pair, NOTHING, noisy=False)
        lit = simulator.lit(pair)
        difference = (with_it - without) / noise_rms(simulator, pair, without, lit)
        squares.append(float(np.mean(difference**2)))
        if lit.sum() > 100:
            gains.append(float(np.log(max(with_it[lit].sum(), 1e-9) / without[lit].sum())))
        by_site.setdefault(simulator.world.pairs[pair][0], []).append(without_plane(difference, lit))
    residuals = []
    for fields in by_site.values():
        stack = np.stack(fields)
        if len(fields) > 1:
            seen = np.isfinite(stack)
            stack = stack - np.where(seen, stack, 0).sum(0) / np.maximum(seen.sum(0), 1)
        residuals.append(stack[np.isfinite(stack)])
    rest = np.concatenate(residuals)
    return {
        "fid": float(np.sqrt(np.mean(rest**2))) if rest.size else 0.0,
        "fid_abs_all_pixels": float(np.sqrt(np.mean(squares))),
        "rms_of_pair_gains": float(np.std(gains)) if gains else 0.0,
    }


def ridge_needed(simulator: Simulator, pair: int, side_deg: float) -> float:
    """Height (map pixels) from which on a ridge beyond a side of the DEM shades the middle of a pair's crop."""
    world = simulator.world
    site, frame = world.sites[world.pairs[pair][0]], world.frames[world.pairs[pair][1]]
    shape = world.scenes[site.scene].relief.shape
    row, col = site.top + world.size / 2, site.left + world.size / 2
    across = {0: row, 90: shape[1] / world.fine - col, 180: shape[0] / world.fine - row, 270: col}[int(side_deg)]
    facing = np.cos(np.radians(frame.sun_azimuth_deg - side_deg))
    return float(across * np.tan(np.radians(frame.sun_elevation_deg)) / max(facing, 1e-3))


def search_pairs(simulator: Simulator, measured: str, low_first: Callable[[int], float] | None) -> list[int]:
    """A few pairs that stand for all: of one image each for gains, else all of a site or spread over sites.

    low_first: for what shows in shadows only; the pairs where it is least are taken.
    """
    pairs = simulator.world.pairs
    if low_first is not None:
        return sorted(range(len(pairs)), key=low_first)[:SUBSET]
    if measured == "rms_of_pair_gains":
        first = {frame: pair for pair, (_, frame) in reversed(list(enumerate(pairs)))}
        return sorted(first.values())[:12]
    if measured == "fid_abs_all_pixels" or len({site for site, _ in pairs}) == len(pairs):
        return list(range(0, len(pairs), max(1, len(pairs) // SUBSET)))[: SUBSET + 1]
    return list(range(SUBSET))


def find(value_of: Callable[[float], float], target: float, low: float, first: float, high: float) -> float:
    """The strength that gives the target, by secant steps between logarithms, kept inside a bracket."""
    below, above, strength = low, high, float(np.clip(first, low, high))
    known: list[tuple[float, float]] = []
    for _ in range(6):
        value = max(value_of(strength), 1e-9)
        known.append((float(np.log(strength)), float(np.log(value / target))))
        if abs(known[-1][1]) < 0.15:
            break
        below, above = (strength, above) if value < target else (below, strength)
        power = 1.0
        if len(known) > 1 and known[-1][0] != known[-2][0]:
            power = (known[-1][1] - known[-2][1]) / (known[-1][0] - known[-2][0])
        step = known[-1][1] / float(np.clip(power, 0.4, 3.0))
        strength = float(np.exp(known[-1][0] - np.clip(step, -2.5, 2.5)))
        if not below < strength < above:
            strength = float(np.clip(strength, low, high)) if len(known) == 1 else float(np.sqrt(below * above))
    return float(np.exp(min(known, key=lambda pair: abs(pair[1]))[0]))


def choose(simulator: Simulator, name: str, seed: int) -> tuple[Hidden, str]:
    """The named effect or fault at a strength drawn at random, and the measure that it was drawn in."""
    rng, world = generator(seed, "strength"), simulator.world
    strong = rng.uniform() < 0.25
    target = log_uniform(rng, 0.4, 1.5) if strong else log_uniform(rng, 0.06, 0.4)
    if name in FAULTS:
        fault = FAULTS[name]
        measured, low, first, high, floor = "fid", fault.lowest, fault.first, fault.highest, 0.0
    else:
        effect = EFFECTS[name]
        measured, low, first, high, floor = effect.measure, effect.lowest, effect.first, effect.highest, effect.floor
        if name == "relief_displacement":
            floor = min(floor / unit_displacement(simulator.world), 1.2)
            low, high = floor, max(high, floor)
    if measured == "rms_of_pair_gains":
        target = log_uniform(rng, 0.02, 0.08)

    def hidden(strength: float) -> Hidden:
        if name in FAULTS:
            return Hidden(name, {"size": strength}, seed)
        return Hidden(name, EFFECTS[name].values(strength, simulator.world, seed), seed)

    low_first: Callable[[int], float] | None = None
    if name == "distant_shadow":
        target *= 10  # what a shadow takes is all of a pixel's light: less than this is but a handful of pixels
        side = hidden(1.0).values["side_deg"]
        low_first = lambda pair: ridge_needed(simulator, pair, side)  # noqa: E731
    elif name in LOW_SUN:
        low_first = lambda pair: world.frames[world.pairs[pair][1]].sun_elevation_deg  # noqa: E731
    pairs = search_pairs(simulator, measured, low_first)
    share = np.sqrt(len(pairs) / len(world.pairs)) if low_first else 1.0  # the other pairs show next to nothing

    def value_of(strength: float) -> float:
        return share * measure(simulator, hidden(strength), pairs)[measured]

    if floor and value_of(floor) >= target:
        return hidden(min(floor * rng.uniform(1.0, 1.5), high)), measured
    if low == high:
        return hidden(first), measured
    return hidden(find(value_of, target, low, first, high)), measured
