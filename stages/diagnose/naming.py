"""Which effect, if any, deserves to be named after a look."""

from __future__ import annotations

import dataclasses
import math

import torch

from stages.diagnose.evidence import Evidence
from stages.diagnose.images import ImageEvidence, as_effect
from stages.diagnose.looking import Round
from stages.diagnose.pattern import PatternEvidence
from stages.diagnose.refining import start
from stages.diagnose.state import RICH, Cause, Search
from stages.effects import Effect, Survey, effect_names, get_effect
from stages.effects.echo import CLEAR_LAG
from stages.effects.penumbra import BEYOND

GATE = 0.01  # family-wise
FLOOR_FID = 0.022  # an effect smaller than this against the noise is never worth a name
EVEN = 0.18  # rms slope, as tangent, up to which that holds
FLOOR_IMAGE = 0.035  # the same for effects with values per image, which have more to fit with
FLOOR_GAIN = 12.0  # nats
FIRM = 1.25  # standard errors of a gain
AGREE = 0.95  # of the gain of an amount for each site that one amount for all must keep
AGREE_PARTLY = 0.85  # ... where a first look sees but a part of the effect, and not the same at every site
RIVAL_SHARE = 0.6  # of the gain between a scene-wide effect and one per image, above which both are tried
KEEP_SHARE = 0.8  # of a per-image effect's gain that a scene-wide effect must keep to replace it
SIMPLER = 0.93  # of a guise's gain that one with fewer coordinates must keep to replace it
NEAR = 0.9  # of the best gain: linear models of strong effects are no closer than that
RIVALS = 2
FORMS = 0.7  # of the gain, above which another form of an effect is tried as well
# effect -> share of the brightness that no sum of kernels follows, and that looks like it as well
FORM_LEAVES = {
    "azimuthal_anisotropy": 0.0025,
    "column_pattern": 0.002,
    "dark_bias": 0.0025,
    "earthshine": 0.0025,
    "interreflection": 0.0025,
    "sun_azimuth": 0.002,
    "sun_elevation": 0.0025,
}
IMPERFECT = 0.04  # of a cause's size: so much of it its model may leave, which is no further cause ...
IMPERFECT_SHIFTS = 0.06  # ... more after shifts, whose resampling blurs ...
IMPERFECT_GAINS = 0.02  # ... and less after gains, which are what they are
# effect -> share of its size that a first look may see: texture and slopes take the rest
UNDERRATED = {"psf_blur": 0.4}
MOVES_SHADOWS = ("sun_elevation", "sun_azimuth")
# effect -> share of that floor, whatever the slopes: seen in few pixels, and told from what is ordinary by its own value
FEW_PIXELS = {"penumbra": 0.7}
IN_SHADOW = ("earthshine",)  # of its three coordinates none can follow what the model of lit ground misses
STANDS_OUT = 1.4  # rms of a pattern over what the texture's spectrum foretells


def choose(state: Search, seen: Round) -> list[Cause]:
    """The next cause to name, and those that the linear model finds nearly as good; empty where there is none."""
    count = len(effect_names())
    worthy = [e for e in _no_remains(state, seen) if _worth(e, count, state.data)]
    scene = sorted(worthy, key=lambda e: -e.gain)
    image = sorted((e for e in seen.images.values() if worth_image(e, count)), key=lambda e: -e.gain)
    if image and image[0].effect == "image_gain" and not scene:
        # a scene-wide effect that does nearly as well with a few numbers as gains do with one for each image
        near = [e for e in seen.best.values() if e.gain > KEEP_SHARE * image[0].gain]
        near = [e for e in near if _worth(e, count, state.data, 5.0)]
        scene = sorted(near, key=lambda e: -e.gain)
    single = []
    if image:
        top = image[0]
        close = [e.effect for e in image[1:] if e.gain > top.gain - 2 * math.hypot(top.gain_error, e.gain_error)]
        single = [
            Cause(
                as_effect(top, None, state.data), min(1.0, top.p * count), top.gain, top.gain_error, top.fid,
                [top.effect, *close], image_evidence=top,
            )
        ]  # fmt: skip
        scene = [e for e in scene if e.gain > RIVAL_SHARE * top.gain]
        if not scene:
            return single
        if top.gain < RIVAL_SHARE * scene[0].gain:
            single = []
    if not scene:
        pattern = _pattern(state, seen.pattern, count)
        return [] if pattern is None else [pattern]
    if len(scene) > 1:  # whatever moves a shadow's edge blurs it too
        scene = [e for e in scene if e.effect != "penumbra"]
    wall = [e for e in scene if e.effect == "distant_shadow"]
    first = wall[0] if wall else scene[0]  # gross as it is, a missing shadow spoils every other estimate
    near = [] if wall else [e for e in scene if e is not first and e.gain > NEAR * first.gain]
    if first.effect == "penumbra":  # about shadow edges a wrong Sun looks like a wide one, and may show nowhere else
        near = [e for name in MOVES_SHADOWS if (e := seen.best.get(name)) is not None and e.gain > FLOOR_GAIN]
    causes = []
    for e in [first, *near[:RIVALS]]:
        group = [e.effect, *(o.effect for o in scene if o is not e and _as_good(first, o) and _as_good(e, o))]
        guises = [g for g in seen.others if g.effect == e.effect and g.candidate.size < e.candidate.size]
        simpler = max(guises, key=lambda g: g.gain, default=e)
        guise = simpler if simpler.gain > SIMPLER * e.gain else e
        for form in [guise, *_other_forms(guise, seen)]:
            effect, errors = start(form, state.data)
            causes.append(
                Cause(
                    effect,
                    family_wise(e, count, state.data),
                    e.gain,
                    e.gain_error,
                    e.fid,
                    list(group),
                    errors,
                    e.along,
                    promised=e.gain * e.moving,
                )
            )
    return causes + single


def suspected(state: Search, seen: Round) -> set[str]:
    """Effects that are there by their own errors, and too small for a name, since whatever the model leaves may look like
    them, or not quite the same at every site.
    """
    count, data = len(effect_names()), state.data
    found = [e for e in _no_remains(state, seen) if _sure(e, count, data) and not _worth(e, count, data)]
    pattern = _pattern(state, seen.pattern, 1)  # asked for alone, not as one of many
    return {e.effect for e in found} | ({pattern.effect.name} if pattern is not None else set())


def _no_remains(state: Search, seen: Round) -> list[Evidence]:
    """The best evidence for each effect, where it is more than what the models of named causes and of reflectance leave."""
    least, signal = _least(state), _signal(state, seen)
    clear = [e for e in seen.best.values() if _still(e) or e.fid > least]
    return [e for e in clear if e.fid > FORM_LEAVES.get(e.effect, 0.0) * signal]


def _least(state: Search) -> float:
    """Size against the noise of what the models of the named causes may leave behind."""
    return max((_imperfect(c) * c.fid for c in state.causes), default=0.0)


def _signal(state: Search, seen: Round) -> float:
    """Brightness over noise where the nominal model is a sum of kernels, which leaves a share of it; 0 for others.

    A form that was asked for is believed.
    """
    if state.nominal.model.name != RICH:
        return 0.0
    signal = torch.cat([(w.weight * w.site.image)[w.weight > 0][::17] for w in seen.works])
    return float(signal.median()) if len(signal) else 0.0


def _imperfect(cause: Cause) -> float:
    """Share of a cause's size against the noise that its model may leave behind."""
    if cause.effect.displaces:
        return IMPERFECT_SHIFTS
    if cause.effect.channel != "lit":
        return 0.0
    return IMPERFECT_GAINS if cause.effect.name == "image_gain" else IMPERFECT


def _still(e: Evidence) -> bool:
    """Whether it is judged in rows of its own, what stays with the ground, where the size against noise says little."""
    return get_effect(e.effect).channel in ("albedo", "relief")


def floor_fid(slope: tuple[float, float]) -> float:
    """Size against the noise, below which nothing is named: what relief within a pixel does grows with the slopes."""
    return FLOOR_FID * max(1.0, math.hypot(*slope) / EVEN)


def _other_forms(guise: Evidence, seen: Round) -> list[Evidence]:
    """Guises of the same effect in other coordinates, as many, that do nearly as well: a line does not tell them apart."""
    mine = _coordinates(guise)
    rest = [g for g in seen.others if g.effect == guise.effect and g.candidate.size == guise.candidate.size]
    return [g for g in rest if _coordinates(g) != mine and g.gain > FORMS * guise.gain][:1]


def _coordinates(guise: Evidence) -> set[str]:
    return {name for column in guise.candidate.trial.columns for name in column}


def family_wise(e: Evidence, count: int, data: Survey) -> float:
    """p after Bonferroni: over ``count`` effects, and over the guises of this one, of which the best was taken."""
    return min(1.0, e.p * count * len(get_effect(e.effect).trials(data)))


def _worth(e: Evidence, count: int, data: Survey, ease: float = 1.0) -> bool:
    """Whether the evidence is enough for a name, among ``count`` effects that were looked for."""
    return not _too_small(e, data) and _alike(e) and _sure(e, count, data, ease)


def _too_small(e: Evidence, data: Survey) -> bool:
    """Whether what the model leaves behind anyway, and the texture, may be as large."""
    firm = 0.0 if e.effect == "distant_shadow" else FIRM * e.gain_error  # a wall shades one image and spares the others
    freedom = 1 if e.effect in IN_SHADOW else e.candidate.size
    floor = FEW_PIXELS.get(e.effect, 0.0) * FLOOR_FID or floor_fid(data.slope) * math.sqrt(freedom)
    return e.gain < max(FLOOR_GAIN, firm) or (e.fid < floor and not _still(e))


def _alike(e: Evidence, agree: float = AGREE) -> bool:
    """Whether the sites agree about it, where what one shows the others must."""
    least = min(agree, AGREE_PARTLY) if e.effect in UNDERRATED else agree
    return e.agreement >= least or _still(e) or e.effect == "distant_shadow"


def _sure(e: Evidence, count: int, data: Survey, ease: float = 1.0) -> bool:
    """Whether it is there by its own errors, and looks like this effect, however small it is."""
    cls = get_effect(e.effect)
    if family_wise(e, count, data) > GATE * ease or min(e.gain_image, e.gain_place) <= 0 or not _alike(e, AGREE_PARTLY):
        return False
    (name, reference), *_ = e.candidate.trial.columns[0].items()
    unit = reference - cls.null()[name]
    value = cls.null()[name] + float(e.amount[0]) * unit
    error = abs(unit) * float(e.covariance[0, 0].clamp(min=0)) ** 0.5
    low, high = cls.bounds(name)
    span = high - low
    if not low - 0.05 * span <= value <= high + 0.05 * span:
        return False
    if cls.null()[name] == 0 and low < 0 < high and not 0.9 * low < value < 0.9 * high:
        return False
    if e.effect == "echo" and (value < 0 or abs(e.candidate.trial.fixed["lag_px"]) < CLEAR_LAG):
        return False  # near ones look like an imperfect point spread function, or like soft shadow edges
    if e.effect == "penumbra":
        return value > (BEYOND * e.candidate.trial.fixed["relief_deg"]) ** 2 + error
    if e.effect == "dem_smoothing" and value < 0:  # no DEM is sharper than the ground
        return False
    if name in cls.tolerance:
        return abs(value - cls.null()[name]) - UNDERRATED.get(e.effect, 1.0) * cls.tolerance[name] > 3 * error
    if e.effect == "column_pattern" and abs(unit) * float(e.amount.norm()) < cls.tolerance["rms"]:
        return False
    if e.effect == "earthshine":  # a source above the ground, known to a third
        return float(e.amount[0]) > 3 * float(e.covariance[0, 0].clamp(min=0).sqrt())
    if e.effect in ("distant_shadow", "saturation"):  # a shadow is dark and a cut-off flat, or it is something else
        return 0.5 < float(e.amount[0]) < 2.0 and float(e.amount[0]) ** 2 > 9 * float(e.covariance[0, 0])
    return True


def worth_image(e: ImageEvidence, count: int) -> bool:
    """The same for effects with values per image."""
    if e.p * count > GATE or e.gain < max(FLOOR_GAIN, 2 * e.gain_error) or e.fid < FLOOR_IMAGE:
        return False
    cls = get_effect(e.effect)
    if e.effect == "image_gain" and e.agreement < AGREE:
        return False
    if not cls.tolerance:
        return e.fid > 2 * FLOOR_IMAGE
    return e.rms > 1.2 * cls.tolerance[cls.parameters[0].name]


def misaligned(state: Search, e: ImageEvidence) -> Cause | None:
    """The shifts that were taken out of the images as a cause, where they are more than every data set has."""
    count, effect = len(effect_names()), state.aligned
    e = with_values(e, effect)
    if not worth_image(e, count):
        return None
    return Cause(effect, min(1.0, e.p * count), e.gain, e.gain_error, e.fid, [effect.name], image_evidence=e)


def with_values(e: ImageEvidence, effect: Effect) -> ImageEvidence:
    """The evidence with the values per image that the effect has now."""
    values = torch.stack([torch.as_tensor(effect.values[p.name]) for p in effect.fitted()], 1)
    seen = values.abs().sum(1) > 0
    rms = float(values[seen].square().sum(1).mean().sqrt()) if bool(seen.any()) else 0.0
    return dataclasses.replace(e, values=values, rms=rms)


def _pattern(state: Search, e: PatternEvidence | None, count: int) -> Cause | None:
    """A broad albedo pattern: named last, since terrain, columns and the nominal model make such patterns too."""
    if e is None or e.p * count > GATE or e.gain < FLOOR_GAIN:
        return None
    cls = get_effect("albedo_map")
    whole = math.hypot(e.rms, e.texture)
    if whole < STANDS_OUT * e.texture or e.rms - cls.tolerance["per_std"] < 2 * e.rms_error:
        return None
    values = {}
    for k, parameter in enumerate(cls.fitted()):
        table = torch.zeros(max(e.numbers) + 1)
        table[e.numbers] = e.values[:, k].float()
        values[parameter.name] = table
    fid = math.sqrt(2 * e.gain / e.values.numel())
    cause = Cause(cls(values, state.data), min(1.0, e.p * count), e.gain, e.gain_error, fid, ["albedo_map"])
    cause.errors = {"per_std": e.rms_error}
    return cause


def _as_good(first: Evidence, other: Evidence) -> bool:
    """Whether the paired difference of gains is within two standard errors."""
    if len(first.share) != len(other.share):
        spread = math.hypot(first.gain_error, other.gain_error)
        return other.gain > max(first.gain - 2 * spread, 0.7 * first.gain)
    difference = first.share - other.share
    error = float(difference.std()) * math.sqrt(len(difference))
    return float(difference.sum()) < 2 * error and other.gain > 0.5 * first.gain


__all__ = [
    "FEW_PIXELS",
    "MOVES_SHADOWS",
    "SIMPLER",
    "choose",
    "floor_fid",
    "misaligned",
    "suspected",
    "with_values",
    "worth_image",
]
