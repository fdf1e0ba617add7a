"""What an effect is: a small parametric extension of the forward model, with a null value at which it does nothing."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar

import torch
from torch import Tensor

from schemas.errors import ConfigError, RegistryError
from stages.physics.formation.chain import SLOTS, State
from stages.physics.photometry import Parameter

SCOPES = ("scene", "image", "site", "pair")
Values = dict[str, Any]  # coordinate -> float (scene), or tensor (frames,), (sites,) or (frames, sites)


@dataclass
class Survey:
    """What the effects need to know about a data set as a whole; filled once, stored with the extended model.

    The means and standard deviations are over valid pixels of all crops; brightness is that of the measured I/F.
    """

    crop_px: int = 128
    gsd: float = 1.0
    brightness: float = 0.05
    brightness_quantiles: tuple[float, float, float, float] = (0.07, 0.08, 0.09, 0.1)  # .9 .97 .99 .998
    slope: tuple[float, float] = (0.0, 1.0)  # mean, std of the slope, as tangent
    elevation: tuple[float, float] = (0.0, 1.0)  # of the height, m
    curvature: tuple[float, float] = (0.0, 1.0)  # of the Laplacian after a 2 px blur, 1/m
    relief: float = 100.0  # largest range of heights in a crop, m
    columns: tuple[float, float] = (0.0, 127.0)  # first and last detector sample
    sun_cotangent: float = 1.0  # of the Sun's elevation, mean over the images
    lean_px: float = 0.0  # rms of h tan(emission), heights from their mean
    units: str = "iof"
    has_detector: bool = False
    frames: int = 1
    sites: int = 1

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Survey:
        values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in data.items()}
        return cls(**values)


@dataclass(frozen=True)
class Trial:
    """One way an effect may look: ``fixed`` coordinates, and the columns that are fitted together.

    Every column is a displacement from the null value: coordinate -> value at which the effect is realistic.
    """

    columns: tuple[Mapping[str, float], ...]
    fixed: Mapping[str, float] = field(default_factory=dict)


class Effect(ABC):
    """Base of every effect. Subclasses fill the class attributes and ``apply``; the default trial is one per parameter.

    slot            where in the chain it acts: geometry, illumination, reflectance, radiance or sensor
    scope           'scene': one set of values; 'image': one per source image; 'site': one per ground site; 'pair': one per
                    image of a site
    parameters      what the report gives; ``default`` is the null value
    coordinates     what is fitted, where that is not the parameters themselves
    strong          coordinate -> a size that anybody would want to be told about: data that cannot show it are blind to the effect
    tried           coordinate -> the size at which the default trial stands; ``strong`` where it is not named
    tolerance       coordinate -> a size that every data set has: smaller effects are no cause
    displaces       whether it moves images against the ground: what is known of it is taken out of the measurement
    relative        whether its values per image are known beside those of the other images only: what all share is the ground's
    lights_shadows  whether it brings light into deep shadow; one kind of light is told from another there
    linear          whether the image is linear in the coordinates: a first estimate beyond their bounds stays there
    law_error       coordinate -> its standard error where the law of the ground is not known, whose form passes for it
    of_law          whether another reflectance law could do the same: it is a cause only where no other law has anything to add
    in_simulation   coordinate -> what is added to it in the extended model: `diagnose` judges with slopes of fourth order, while the
                    simulation's smooth the ground by about a quarter of a squared pixel themselves
    shaped          coordinates that say what the effect looks like, not how strong it is: they are stepped through, and fitted once it is named
    always          standard deviation of values per image that every data set has, in multiples of ``strong``; 0: none
    scatters        whether that standard deviation is estimated from the data instead
    about_mean      whether values per image are factors, less one, of which only those about their mean are told from the nominal model
    judged_apart    whether a step of its own judges it, not the search: registration, or a histogram of all pixels
    leans           of those that displace: relief by its height, not images as a whole
    along_lines     of those that displace: the lines of an image against each other
    edges_tell      whether shadow edges alone tell it, not lit ground or deep shadow
    raises_horizon  whether it is terrain that the DEM has not
    listed          whether it is in the catalogue: of others, which are in none, `diagnose` tells by their title what they leave
    keep_below      of a level that was read off a histogram: what is brighter than this times the level says nothing more
    one_sided       a fixed coordinate; the effect acts on one side of a pixel only, and by its sign it is told from what acts on both
    shadow_error    how far its first coordinate may be off where shadows alone tell it, since the DEM's horizons are
    possible        in words, what ``plausible`` asks of the values
    largest         coordinate -> the size from which on it is nothing real, where no more is asked
    table           (variable, second dimension or None) of diagnosis.h5 for values per image or site; without it they stand in
                    `frame_values` or `site_values`
    """

    name: ClassVar[str]
    slot: ClassVar[str]
    title: ClassVar[str]
    mechanism: ClassVar[str]
    reference: ClassVar[str]
    confused_with: ClassVar[tuple[str, ...]] = ()
    separate: ClassVar[str] = ""
    scope: ClassVar[str] = "scene"
    parameters: ClassVar[tuple[Parameter, ...]]
    coordinates: ClassVar[tuple[Parameter, ...]] = ()
    strong: ClassVar[Mapping[str, float]] = {}
    tried: ClassVar[Mapping[str, float]] = {}
    tolerance: ClassVar[Mapping[str, float]] = {}
    displaces: ClassVar[bool] = False
    relative: ClassVar[bool] = False
    lights_shadows: ClassVar[bool] = False
    linear: ClassVar[bool] = False
    in_simulation: ClassVar[Mapping[str, float]] = {}
    shaped: ClassVar[tuple[str, ...]] = ()
    always: ClassVar[float] = 0.0
    scatters: ClassVar[bool] = False
    about_mean: ClassVar[bool] = False
    judged_apart: ClassVar[bool] = False
    leans: ClassVar[bool] = False
    along_lines: ClassVar[bool] = False
    one_sided: ClassVar[str] = ""
    listed: ClassVar[bool] = True
    edges_tell: ClassVar[bool] = False
    raises_horizon: ClassVar[bool] = False
    law_error: ClassVar[Mapping[str, float]] = {}
    of_law: ClassVar[bool] = False
    shadow_error: ClassVar[float] = 0.0
    keep_below: ClassVar[float] = 1.0
    possible: ClassVar[str] = ""
    largest: ClassVar[Mapping[str, float]] = {}
    table: ClassVar[tuple[str, str | None] | None] = None

    def __init__(self, values: Mapping[str, Any] | None = None, survey: Survey | None = None) -> None:
        self.values: Values = {**self.null(), **(values or {})}
        self.survey = survey or Survey()
        self.held: tuple[str, ...] = ()  # coordinates that a fit leaves alone
        self.of_model = False  # whether it acts on what is rendered alone, and takes nothing from the measured image
        for name in self.values:
            if name not in self.null():
                raise RegistryError.unknown(f"parameter of effect {self.name}", name, self.null())

    @classmethod
    def fitted(cls) -> tuple[Parameter, ...]:
        return cls.coordinates or cls.parameters

    @classmethod
    def null(cls) -> dict[str, float]:
        """The values at which the effect does nothing."""
        return {p.name: p.default for p in cls.fitted()}

    @classmethod
    def trials(cls, survey: Survey) -> Sequence[Trial]:
        """Alternative templates; the default is one joint trial with a column per coordinate at its size ``tried``."""
        sizes = {**cls.strong, **cls.tried}
        return [Trial(tuple({p.name: sizes[p.name]} for p in cls.fitted()))]

    @classmethod
    def shadow_trials(cls, survey: Survey) -> Sequence[Trial]:
        """Values at which shadows are compared, in order, if the effect moves or widens them."""
        return ()

    def shadow_neighbours(self, survey: Survey) -> Sequence[Trial]:
        """Values to compare beside these, once shadows have told the effect, in coordinates that ``shadow_trials`` hold fixed."""
        return ()

    @classmethod
    def shadows_ordinarily(cls, values: Mapping[str, Any]) -> bool:
        """Whether shadows of every data set look as with these values, since relief has finer detail than the DEM; with null values they do."""
        return float(values[cls.parameters[0].name]) == cls.parameters[0].default

    @classmethod
    def visible(cls, survey: Survey, has: frozenset[str]) -> bool:
        """Whether files with these optional variables can show the effect at all; beside free gains nothing is known of the law."""
        return not (cls.of_law and survey.units == "dn")

    @classmethod
    def step(cls, name: str, survey: Survey) -> float:
        """A small change of a coordinate, for finite differences: a tenth of a realistic one."""
        for trial in cls.trials(survey):
            for column in trial.columns:
                if name in column:
                    return 0.1 * abs(column[name] - cls.null()[name]) or 1e-3
        parameter = next(p for p in cls.fitted() if p.name == name)
        return max(0.05 * abs(parameter.default), 1e-3 * (parameter.upper - parameter.lower))

    @classmethod
    def ordinary(cls, trial: Trial) -> float:
        """How much of the trial every real data set has, in multiples of its columns; 0: none that is known."""
        sizes = [
            cls.tolerance[name] / abs(value - cls.null()[name])
            for column in trial.columns
            for name, value in column.items()
            if name in cls.tolerance and value != cls.null()[name]
        ]
        return max(sizes, default=0.0)

    @classmethod
    def read_off(cls, bright: Tensor) -> tuple[float, float, float] | None:
        """(value, error, nats) of an effect that shows in the histogram of all pixels itself, or None."""
        return None

    @classmethod
    def read_off_ground(cls, albedo: Tensor, seen: Tensor) -> tuple[Values, Tensor, Tensor] | None:
        """(values per site, size^2, ordinary size^2) of an effect that shows in what all images of a site have in common, or None.

        albedo, seen : (sites, H, W) relative to the prediction, and 1 where it is known; both sizes are (sites,)
        """
        return None

    @classmethod
    def read_off_image(cls, own: Tensor, seen: Tensor) -> tuple[Values, Tensor, Tensor] | None:
        """(values per image, size^2, size^2 that goes with its finer waves) of an effect that shows in what an image has of its own, or None.

        own, seen : (images, H, W) relative to the prediction, less what other images of the place show, and 1 where it is known;
            both sizes are (images,)
        """
        return None

    @classmethod
    def plausible(cls, values: Mapping[str, float], survey: Survey) -> bool:
        """Whether anything real has these values; a fit that ends elsewhere stands for something else."""
        return all(abs(values[name]) < size for name, size in cls.largest.items())

    @classmethod
    def size(cls, values: Mapping[str, Any]) -> float:
        """One number for all values: of many, the root of the mean over frames of their sum of squares."""
        table = torch.stack([torch.as_tensor(v, dtype=torch.float64) for v in values.values()])
        if table.ndim == 1:
            return float(table.square().sum().sqrt())
        seen = table.abs().sum(0) > 0
        return float(table[:, seen].square().sum(0).mean().sqrt()) if bool(seen.any()) else 0.0

    @classmethod
    def report(cls, values: Mapping[str, float], errors: Mapping[str, float]) -> dict[str, tuple[float, float]]:
        """Reported parameter -> (value, standard error), from the fitted coordinates (of scene scope)."""
        return {p.name: (values[p.name], errors.get(p.name, 0.0)) for p in cls.parameters}

    def curves(self) -> dict[str, tuple[Tensor, str]]:
        """Variable of diagnosis.h5 -> a curve that shows the effect, and its dimension."""
        return {}

    @classmethod
    def bounds(cls, name: str) -> tuple[float, float]:
        return next((p.lower, p.upper) for p in cls.fitted() if p.name == name)

    @abstractmethod
    def apply(self, state: State) -> None:
        """Change what the slot may change (see ``formation.State``), differentiable in the values."""

    def value(self, name: str, state: State) -> Tensor:
        """A coordinate ready to multiply images: scalar, or (B, 1, 1) by image, site or both; null where not known."""
        given = self.values[name]
        like = state.elevation
        if not isinstance(given, Tensor) or given.ndim == 0:
            return torch.as_tensor(given, dtype=like.dtype, device=like.device)
        numbers = {"image": ["frame"], "site": ["site"], "pair": ["frame", "site"]}[self.scope]
        indices = [i for i in (getattr(state.observation, n) for n in numbers) if i is not None]
        if len(indices) < given.ndim:
            return torch.as_tensor(self.null()[name], dtype=like.dtype, device=like.device)
        inside = [(i >= 0) & (i < count) for i, count in zip(indices, given.shape, strict=True)]
        known = torch.stack(inside).all(0)
        picked = given.to(like)[tuple(i.clamp(0, count - 1) for i, count in zip(indices, given.shape, strict=True))]
        return torch.where(known, picked, torch.full_like(picked, self.null()[name]))[:, None, None]


def telling_share(state: State) -> Tensor | float:
    """Of light that deep shadow alone tells of: 1 in a simulation; where a law is fitted to lit ground, what the Sun leaves dark, (B, H, W)."""
    return 1 - state.sun_visibility if state.law_fitted and state.sun_visibility is not None else 1.0


_EFFECTS: dict[str, type[Effect]] = {}


def register(cls: type[Effect]) -> type[Effect]:
    """Class decorator: make an effect known under its name. Raises ConfigError in one line for one that is not whole."""
    where = f"effect {getattr(cls, 'name', cls.__name__)}"
    for attribute in ("name", "slot", "title", "mechanism", "reference", "parameters"):
        if not hasattr(cls, attribute):
            raise ConfigError(
                f"{where}: expected `{attribute}` in class {cls.__name__} of {cls.__module__}, found none."
            )
    if cls.scope not in SCOPES:
        raise ConfigError(f"{where}: expected a scope out of {', '.join(SCOPES)}, found '{cls.scope}'.")
    if cls.slot not in SLOTS:
        raise ConfigError(f"effect {cls.name}: expected a slot out of {', '.join(SLOTS)}, found '{cls.slot}'.")
    _EFFECTS[cls.name] = cls
    return cls


def get_effect(name: str) -> type[Effect]:
    """The effect called ``name``. Raises RegistryError with the choices."""
    try:
        return _EFFECTS[name]
    except KeyError:
        raise RegistryError.unknown("effect", name, effect_names()) from None


def effect_names(unlisted: bool = False) -> list[str]:
    """All effects of the catalogue, in the order of their slots; and those in none."""
    names = [n for n, cls in _EFFECTS.items() if cls.listed or unlisted]
    return sorted(names, key=lambda n: (SLOTS.index(_EFFECTS[n].slot), n))
