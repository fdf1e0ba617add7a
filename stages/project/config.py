"""The settings of project."""

from __future__ import annotations

from dataclasses import dataclass

from schemas.errors import ConfigError


@dataclass(frozen=True)
class Config:
    """scene : in place of the one that crops.h5 names; register : the freest form of displacement that may be taken off
    ('constant', 'affine', 'field'), None for no registration; max_shift : px, largest that is searched; exact : write
    float32 instead of packed 16-bit numbers.
    """

    scene: str | None = None
    shard: tuple[int, int] = (0, 1)
    register: str | None = None
    max_shift: float = 8.0
    exact: bool = False

    def check(self) -> None:
        """Raises ConfigError."""
        from stages.physics.images.displacement import FORMS

        if self.register not in (None, *FORMS):
            raise ConfigError(f"`register`: expected 'constant', 'affine' or 'field', found '{self.register}'.")
        if not 1.0 <= self.max_shift <= 32.0:
            raise ConfigError(f"`max_shift`: expected 1 to 32 px, found {self.max_shift:g}.")
