"""What albedo is told, and what it says of the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from schemas.errors import ConfigError

if TYPE_CHECKING:
    from stages.physics.images.table import Frame


@dataclass(frozen=True)
class Config:
    """leave_out : image ids that must not enter; fold : (k, n) leaves out every n-th image from the k-th on (0-based), None:
    all enter; register : None, or the freest form of displacement that is taken off each image before ('constant', 'affine',
    'field'), as in project; geotiff : whether the map is written as a GeoTIFF as well.
    """

    leave_out: tuple[str, ...] = ()
    fold: tuple[int, int] | None = None
    register: str | None = None
    shard: tuple[int, int] = (0, 1)
    geotiff: bool = True


@dataclass(frozen=True)
class Summary:
    """For the lines at the end. covered_share : of the map's valid pixels, those that an image saw; shared_std, prior_std :
    relative spread of the albedo that images share, and of its error where images enter, medians
    """

    images: tuple[str, ...]
    left_out: tuple[str, ...]
    covered_share: float
    mean_images: float
    albedo: tuple[float, float, float, float]  # mean, std, 1 %, 99 %
    albedo_std: float
    bands: tuple[tuple[float, float, float], ...]  # structure up to so many px, shared std, median unshared std


def used_frames(frames: Sequence[Frame], config: Config) -> list[bool]:
    """Which images enter. Raises ConfigError for unknown ids and forms of displacement, and where no image is left."""
    from stages.physics.images.displacement import FORMS

    if config.register not in (None, *FORMS):
        raise ConfigError(f"`register`: expected one of {', '.join(FORMS)}, found '{config.register}'.")
    names = [f.image_id for f in frames]
    for name in config.leave_out:
        if name not in names:
            raise ConfigError(f"`leave_out`: expected an image of the scene ({', '.join(names)}), found '{name}'.")
    used = [name not in config.leave_out for name in names]
    if config.fold is not None:
        fold, count = config.fold
        if fold >= len(names):
            raise ConfigError(
                f"`fold`: expected one of the first {len(names)} folds, since the scene has {len(names)} images, "
                f"found {fold + 1}/{count}, which leaves none out."
            )
        used = [u and k % count != fold for k, u in enumerate(used)]
    if not any(used):
        raise ConfigError("`leave_out`, `fold`: expected to leave at least one image, found none; leave out fewer.")
    return used
