"""Which of several effects explains what is left: beside what it is confused with, what is ordinary, another law, light in shadows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from stages.diagnose.likelihood.found import Found, interval
from stages.diagnose.likelihood.whole import Whole
from stages.diagnose.search.doubts import ODD, ORDINARY
from stages.diagnose.settings import DISCOVERY, LIKELIER, SIMPLER
from stages.effects import get_effect

UNSURE = "which these data do not prove"


def judge(whole: Whole, found: Found) -> None:
    """Set what the effect gains on held-out ground."""
    # beside gains of every image nothing is left to gain: they know already how bright each is on other ground
    beside = whole.scattered.tolist() if found.beside else []
    without = [*whole.exclude(found.guise), *beside]
    found.gains, found.sizes = whole.held_out(whole.places(found.guise), without, found.spread), whole.sizes
    if get_effect(found.effect).lights_shadows:  # much ground has no shadow, and nothing to gain
        found.sizes = whole.power(whole.places(found.guise), found.amount)


def choose(sure: list[Found], tried: Sequence[Found] = ()) -> tuple[Found, list[str]]:
    """The best, or one with fewer values that gains nearly as much; and all that gain the same within their scatter, though these data
    be not sure of what it is confused with. tried : all that have evidence

    Values per frame can mimic what one value for all does: where the two gain the same, the one value is the cause. So it is with
    several values beside fewer of what they are confused with: light from above alone is a pedestal.
    """
    best = max(sure, key=lambda f: f.gain)
    if best.guise.per_frame:
        simple = [f for f in sure if not f.guise.per_frame and (_as_good(f, best) or stands_for(f, best))]
        best = max(simple, key=lambda f: f.gain, default=best)
    alike = get_effect(best.effect).confused_with
    fewer = [f for f in sure if f.effect in alike and not f.guise.per_frame and len(f.amount) < len(best.amount)]
    best = max((f for f in fewer if best.more_than(f)[0] <= 0), key=lambda f: f.gain, default=best)
    likely = [f for f in tried if f not in sure and f.gain > 0 and f.effect in get_effect(best.effect).confused_with]
    group = []
    for f in sorted([*sure, *likely], key=lambda f: -f.gain):
        if f is best or best.more_than(f)[0] <= 0:
            group.append(f.effect)
    group.sort(key=lambda n: n != best.effect)
    return best, group


def _as_good(found: Found, best: Found) -> bool:
    return found.gain > SIMPLER * best.gain or best.more_than(found)[0] <= 0


def stands_for(found: Found, other: Found) -> bool:
    """Whether one value for all explains the gains of the images, which other ground does not tell: they know there how bright each is."""
    cls = get_effect(other.effect)
    return found.instead and found.odds > -LIKELIER and found.p <= DISCOVERY and cls.scatters and not cls.displaces


def may_be_another(whole: Whole, found: Found, best: Mapping[str, Found], refused: Mapping[str, str]) -> str:
    """Why an effect may stand for what is ordinary, or as likely and not sure on its own, or ''. refused : effect -> why"""

    def sure(gains: np.ndarray) -> bool:
        return interval(gains, found.sizes)[0] > 0

    if found.odds < LIKELIER:
        return "values of its own for each of so few images are nearly as likely"
    for other in [best[n] for n in get_effect(found.effect).confused_with if n in refused and n in best]:
        if refused[other.effect].startswith(ORDINARY):
            if not sure(whole.gains_beside(found, other)):
                return f"an ordinary amount of {other.effect} explains as much of it"
            continue
        judge(whole, other)
        if found.guise.per_frame:  # which stands for what one value for all does, sure or not
            if found.more_than(other)[0] <= 0:
                return f"{other.effect}, {UNSURE}, explains as much of it"
        elif not other.guise.per_frame and not refused[other.effect].startswith(ODD) and other.more_than(found)[0] > 0:
            return f"{other.effect}, {UNSURE}, explains more of it"
    if (mirrored := whole.mirrored(found.guise)) and not sure(
        found.gains - whole.held_out(whole.places(mirrored), whole.exclude(mirrored))
    ):
        return (
            "the same on the other side of each pixel explains as much of it, as blur and relief finer than the DEM do"
        )
    if more := _as_another_law(whole, found, best, refused):
        return f"{more}, {UNSURE}, explains more of it"
    own = whole.ordinary_places(found.effect)
    if get_effect(found.effect).lights_shadows and (more := _other_light(found, best)):
        return f"{more}, {UNSURE}, explains more of it"
    if get_effect(found.effect).lights_shadows and not sure(whole.held_out(whole.places(found.guise), own)):
        return "ordinary amounts of other light in shadows would explain it as well"
    if found.guise.per_frame:
        for other in best.values():
            likely = not other.guise.per_frame and other.surprise >= found.surprise
            if stands_for(other, found) or (likely and not sure(whole.gains_beside(found, other))):
                return f"{other.effect}, {UNSURE}, would explain it as well"
    return ""


def _as_another_law(whole: Whole, found: Found, best: Mapping[str, Found], refused: Mapping[str, str]) -> str:
    """Of what an effect of the law is confused with, one of the camera or of relief that explains surely more, or ''.

    Effects of the law are judged without another form of it beside them, which would follow them; what passes for one has to be, too.
    """
    if not get_effect(found.effect).of_law:
        return ""
    for other in [best[n] for n in get_effect(found.effect).confused_with if n in best]:
        if other.guise.per_frame or get_effect(other.effect).of_law or refused.get(other.effect, "").startswith(ODD):
            continue
        gains = whole.held_out(whole.places(other.guise), [*whole.exclude(other.guise), *whole.form_places().tolist()])
        if interval(gains - found.gains, whole.sizes)[0] > 0:
            return other.effect
    return ""


def _other_light(found: Found, best: Mapping[str, Found]) -> str:
    """Another light in shadows of the catalogue of which there is far more evidence, though it be unsure on other ground, or ''."""
    lights = [f for f in best.values() if get_effect(f.effect).lights_shadows and get_effect(f.effect).listed]
    most = max(lights, key=lambda f: f.surprise, default=found)
    return most.effect if found.surprise < SIMPLER * most.surprise else ""


def another_law(whole: Whole, found: Found) -> str:
    """Why an effect of the reflectance law stands for another form of it, which has more to add for sure, or ''."""
    if not get_effect(found.effect).of_law:
        return ""
    if not len(whole.form_places()):
        return "the fitted law already follows it: what it would add has no other form"
    if added := whole.another_law(found.guise):
        return f"another law of the ground gains {added:.0f} nats more beside it, of which this is only a part"
    return ""


__all__ = ["another_law", "choose", "judge", "may_be_another"]
